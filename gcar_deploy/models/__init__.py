"""Models: read, guarded and checked before anything of them runs."""
