"""Attempts to break gcar: fuzz, faults, determinism, mutation, soak.

``python -m tests.battery VERB``; every verb prints its counts and ends with 1 on a finding.
"""
