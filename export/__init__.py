"""Workshop: simulate, train, export, evaluate. Imports the runtime, never the reverse."""

import os

# As ``gcar`` does, and for the studies as well; heeded only before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
