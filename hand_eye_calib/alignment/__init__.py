"""How the two streams relate before a solve: time offset and scale."""
