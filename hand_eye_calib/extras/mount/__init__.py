"""Monitor the mount while the robot drives."""

from typing import Any

from hand_eye_calib.core.base.registry import COMPARISONS, MOUNT_MONITORS


def register() -> None:
    """Register the monitor of the mount for the node, and the comparison of its digests."""
    MOUNT_MONITORS["installed"] = _watch
    COMPARISONS["digests of the monitor"] = _compare


def _compare(arguments: Any) -> int | None:
    from hand_eye_calib.extras.mount.history import compare_digests

    return compare_digests(arguments)


def _watch(session: Any, *parts: Any) -> Any:
    from hand_eye_calib.extras.mount.monitor import LIMITS, MountWatch

    session.watch_only(LIMITS)
    return MountWatch(session, *parts)
