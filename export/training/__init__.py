"""Training: networks, data sets, losses, resumable runs."""
