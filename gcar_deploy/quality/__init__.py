"""Quality: whether a tree can honestly be made, and how far to trust it."""
