"""Worker: one warm engine behind a queue, for host programs in any language."""
