"""The studies of docs/measurements.md: when to stop, whether and what has moved."""
