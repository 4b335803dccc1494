"""Where the views stand to each other: pairwise, joint, from the tree, from landmarks."""
