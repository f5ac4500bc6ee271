"""Stream checks: whether the two streams are plausible, before anything is solved."""
