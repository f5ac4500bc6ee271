"""Extras: each is a folder here and one line of EXTRAS. Delete both to do without it."""

from importlib import import_module

EXTRAS = (
    "fleet",  # several recordings: compared, together, in batches
    "detectability",  # smallest errors that a recording contradicts
    "mount",  # the monitor of the mount
    "partial",  # streams of positions, rotations or angular rates alone
    "stops",  # poses that are stops, such as the samples of an arm
    "rig",  # three sensors or more
    "sensors",  # lidar scans, images of a target, files of other programs
    "ground",  # z, roll and pitch of machines on a flat floor
    "clouds",  # clouds of both lidars in the report, merged through the result
    "viewer",  # a bag of both paths for RViz, Foxglove and Rerun
    "vehicle",  # a sensor in the frame of its vehicle, and the wheels
    "simulation",  # drives with known truth, and the demo
)


def register() -> None:
    """Register what the extras add to the layers below."""
    for name in EXTRAS:
        extra = import_module(f"{__name__}.{name}")
        extra.register()
