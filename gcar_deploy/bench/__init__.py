"""Speed against error, and seconds per stage."""
