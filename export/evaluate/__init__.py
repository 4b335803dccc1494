"""Evaluation of methods side by side: protocols, jobs, scores, tables, report."""
