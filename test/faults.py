"""Mistakes that people make with poses, made on purpose."""

import dataclasses

import numpy as np

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory


def reordered(stream):
    """Quaternions written w x y z and read as x y z w."""
    positions = stream.poses[:, :3, 3]
    quats_xyzw = se3.to_quat_xyzw(stream.poses)
    quats_wxyz = np.roll(quats_xyzw, 1, axis=1)
    poses = se3.from_quat_xyzw(positions, quats_wxyz)
    return Trajectory(stream.stamps_ns, poses)


def inverted(stream):
    """Poses of the world in the sensor."""
    inverse_poses = se3.inverse(stream.poses)
    return dataclasses.replace(stream, poses=inverse_poses)


def frozen(stream, share=0.6):
    """From there on the last pose is repeated."""
    poses = stream.poses.copy()
    start = int(share * len(stream))
    poses[start:] = poses[start]
    return dataclasses.replace(stream, poses=poses)


def with_swapped_axes(stream, order=(1, 0, 2)):
    """Positions in other axes than the orientations."""
    poses = stream.poses.copy()
    poses[:, :3, 3] = poses[:, order, 3]
    return dataclasses.replace(stream, poses=poses)


def mirrored(stream):
    """Left-handed axes for positions and orientations alike."""
    mirror = np.diag([1.0, -1.0, 1.0])
    rotations = stream.poses[:, :3, :3]
    positions = stream.poses[:, :3, 3]
    poses = stream.poses.copy()
    poses[:, :3, :3] = mirror @ rotations @ mirror
    poses[:, :3, 3] = positions @ mirror
    return dataclasses.replace(stream, poses=poses)


# Fault: what is done to (parent, child, some other drive's child), and the code of the finding that
# names it.
FAULTS = {
    "offset 0.2 s": (
        lambda parent, child, other: (parent, child.shifted(-0.2)),
        "time_offset",
    ),
    "offset 500 s": (
        lambda parent, child, other: (parent, child.shifted(-500.0)),
        "time_offset",
    ),
    "wxyz": (
        lambda parent, child, other: (parent, reordered(child)),
        "quaternion_order",
    ),
    "inverse child": (
        lambda parent, child, other: (parent, inverted(child)),
        "inverse",
    ),
    "inverse both": (
        lambda parent, child, other: (inverted(parent), inverted(child)),
        "inverse_both",
    ),
    "millimetres": (
        lambda parent, child, other: (parent, child.scaled(1000.0)),
        "units",
    ),
    "scale 1.05": (
        lambda parent, child, other: (parent, child.scaled(1.05)),
        "scale",
    ),
    "frozen child": (
        lambda parent, child, other: (parent, frozen(child)),
        "frozen",
    ),
    "swapped axes": (
        lambda parent, child, other: (parent, with_swapped_axes(child)),
        "axes",
    ),
    "unrelated": (lambda parent, child, other: (parent, other), "unrelated"),
}
