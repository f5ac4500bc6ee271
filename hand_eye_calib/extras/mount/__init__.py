"""Monitor that detects, while the robot drives, whether a sensor has moved on its mount."""

from typing import Any

from hand_eye_calib.core.base.registry import COMPARISONS, MOUNT_MONITORS


def register() -> None:
    """Register the monitor for the node, and the comparison of its digests for ``compare``."""
    MOUNT_MONITORS["installed"] = _watch
    COMPARISONS["digests of the monitor"] = _compare


def _compare(arguments: Any) -> int | None:
    """Compare digests and return the exit code, or None if the arguments are not digests."""
    from hand_eye_calib.extras.mount.compare import compare_digests

    return compare_digests(arguments)


def _watch(session: Any, *parts: Any) -> Any:
    """Return the monitor of a live session, and limit the poses that the session stores."""
    from hand_eye_calib.extras.mount.live import LIMITS, MountWatch

    session.watch_only(LIMITS)
    return MountWatch(session, *parts)
