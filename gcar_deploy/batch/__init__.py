"""Batch: many cases, one row each, on this machine or an existing cluster."""
