"""Scenes: trees, label volumes, exact projections and generated angiograms."""
