"""The command line: one command per file, over the same engine as the node."""
