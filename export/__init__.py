"""Workshop: simulate, train, export, evaluate. Imports the runtime, never the reverse."""
