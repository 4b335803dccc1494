"""The default refinement: a tree of tubes fitted to the pictures, its sigma and its volume."""
