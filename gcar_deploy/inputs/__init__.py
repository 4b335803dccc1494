"""What is asked for and what is given: orders, and pictures paired with their geometry."""
