"""The studies of docs/session.md: when to stop, whether the mount has moved, what has moved."""
