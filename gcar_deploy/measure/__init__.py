"""What is measured of a tree: lumen, stenosis, names, angles, accuracy against a truth."""
