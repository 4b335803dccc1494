"""Which frames of cine runs go together: contrast, stillness, heart phase."""
