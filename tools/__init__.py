"""Tools of the project itself: battery, requirements, bill of materials. Not installed."""
