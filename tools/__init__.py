"""Tools of the repository; not part of any package."""
