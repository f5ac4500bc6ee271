"""The live node for a person: one view, on a terminal and in a browser."""
