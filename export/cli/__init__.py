"""The command gcar-export."""
