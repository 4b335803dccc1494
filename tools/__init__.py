"""Tools of the project itself: command reference, battery, requirements, bill of materials."""
