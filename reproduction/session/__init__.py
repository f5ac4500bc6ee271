"""Studies of docs/measurements.md: end of a session, several recordings, mount monitor."""
