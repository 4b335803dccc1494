"""gcar."""
