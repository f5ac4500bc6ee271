"""The live node as a person sees it: one model, shown on a terminal and in a browser."""
