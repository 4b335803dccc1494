"""Other methods, each a function from path-length pictures to an occupancy volume."""
