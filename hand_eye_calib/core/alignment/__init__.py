"""Clock offset, clock rate and scale between two streams."""
