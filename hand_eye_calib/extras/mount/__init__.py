"""Monitor the mount while the robot drives."""

from typing import Any

from hand_eye_calib.core.base.registry import MOUNT_MONITORS


def register() -> None:
    """Register the monitor of the mount for the node."""
    MOUNT_MONITORS["installed"] = _watch


def _watch(session: Any, *parts: Any) -> Any:
    from hand_eye_calib.extras.mount.monitor import LIMITS, MountWatch

    session.watch_only(LIMITS)
    return MountWatch(session, *parts)
