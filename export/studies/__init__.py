"""Studies: one table or page each."""
