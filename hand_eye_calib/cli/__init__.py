"""The command line: thin commands over the engine that the node uses too."""
