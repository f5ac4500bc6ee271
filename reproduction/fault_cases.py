"""Deliberate faults of two streams that make the extrinsic wrong although its sigma is small.

The limits of the checks were set with these faults.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.changed_streams import (
    Random,
    beside,
    delayed,
    filtered,
    filtered_positions,
    filtered_rotations,
    higher,
    moved_at,
    noisy,
    posed,
    positions_of,
    upright,
    with_parts,
    with_quats,
)
from reproduction.fault_entry import (
    SECONDS,
    THREE,
    Streams,
    both,
    child_alone,
    group,
)

# Codes of the findings for positions that are filtered or late.
_POSITIONS = "smoothed_positions position_clock"


@both(
    code="S1",
    what="child is the parent's own frame",
    severities=(0.01, 0.003, 0.0),
    unit="m noise",
    named="same_frame",
)
def copied(
    parent: Trajectory, child: Trajectory, noise: float, random: Random
) -> Streams:
    world = se3.exp(random.standard_normal(6))
    copy = Trajectory(parent.stamps_ns, world @ parent.poses)
    return parent, noisy(copy, noise, random)


@both(
    code="S2",
    what="child positions from the parent",
    severities=(0.01, 0.003, 0.0),
    unit="m noise",
    named="same_position same_frame",
)
def fused(
    parent: Trajectory, child: Trajectory, noise: float, random: Random
) -> Streams:
    """Replace the child's positions by those of the parent.

    The orientations of both streams give the rotation between their worlds.
    """
    is_shared = child.stamps_ns >= parent.stamps_ns[0]
    is_shared &= child.stamps_ns <= parent.stamps_ns[-1]
    child = child[is_shared]
    at_child = parent.at(child.stamps_ns)
    parent_rotations = se3.rotation_of(at_child)
    child_rotations = se3.rotation_of(child.poses)
    parent_steps = _rotation_steps(parent_rotations[::10])
    child_steps = _rotation_steps(child_rotations[::10])
    aligned, _ = Rotation.align_vectors(parent_steps, child_steps)
    R_parent_child = aligned.as_matrix()

    # Rotation from the parent's world to the child's world; both worlds get the same origin.
    R_cw_c = child_rotations[0]
    R_pw_p = parent_rotations[0]
    R_cw_pw = R_cw_c @ R_parent_child.T @ R_pw_p.T
    parent_positions = se3.translation_of(at_child)
    travelled = parent_positions - parent_positions[0]
    positions = travelled @ R_cw_pw.T
    positions += noise * random.standard_normal(positions.shape)
    return parent, with_parts(child, positions=positions)


def _rotation_steps(rotations: FloatArray) -> FloatArray:
    """Return the rotation vectors (N-1, 3) between successive rotations (N, 3, 3)."""
    return se3.rotations_between(rotations[:-1], rotations[1:])


@child_alone(
    code="S3",
    what="two sensors, one world",
    severities=(0.03, 0.1, 0.3),
    unit="m",
    named="interleaved",
)
def interleaved(child: Trajectory, metres: float, _: Random) -> Trajectory:
    return moved_at(child, slice(1, None, 2), beside(metres))


@child_alone(
    code="S3b",
    what="two sensors, two worlds",
    severities=(0.1, 0.3, 3.0),
    unit="m",
    named="interleaved",
)
def in_two_worlds(child: Trajectory, metres: float, _: Random) -> Trajectory:
    poses = child.poses.copy()
    world = se3.exp(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.2]))
    poses[1::2] = world @ poses[1::2] @ beside(metres)
    return posed(child, poses)


@child_alone(
    code="S4",
    what="positions low-passed",
    severities=SECONDS,
    unit="s",
    named=_POSITIONS,
)
def low_passed(child: Trajectory, tau_s: float, _: Random) -> Trajectory:
    return with_parts(child, positions=filtered_positions(child, tau_s))


@child_alone(
    code="S4b",
    what="positions late",
    severities=SECONDS,
    unit="s",
    named=_POSITIONS,
)
def late_positions(child: Trajectory, delay_s: float, _: Random) -> Trajectory:
    poses = delayed(child, delay_s)
    return with_parts(child, positions=poses[:, :3, 3])


@child_alone(
    code="S5",
    what="positions smoothed, no delay",
    severities=SECONDS,
    unit="s",
    named=_POSITIONS,
)
def smoothed(child: Trajectory, tau_s: float, _: Random) -> Trajectory:
    ahead = filtered_positions(child, tau_s)
    backwards_ns = -child.stamps_ns[::-1]
    back = filtered(ahead[::-1], backwards_ns, tau_s)
    return with_parts(child, positions=back[::-1])


child_alone(
    code="S6",
    what="all low-passed",
    severities=SECONDS,
    unit="s",
    named=f"smoothed_orientations {_POSITIONS}",
    time_offset="estimate",
)(
    lambda child, s, _: with_parts(
        child, filtered_rotations(child, s), filtered_positions(child, s)
    )
)


@child_alone(
    code="S7",
    what="yaw gain",
    severities=(0.005, 0.01, 0.02),
    named="rotation_gain",
)
def yaw_gain(child: Trajectory, gain: float, _: Random) -> Trajectory:
    """Multiply rotations about the vertical by ``1 + gain``.

    The vertical is the main axis of rotation in the child's frame.
    """
    steps = se3.inverse(child.poses[:-1]) @ child.poses[1:]
    vectors = se3.rotation_log(se3.rotation_of(steps))
    moments = vectors.T @ vectors
    axes = np.linalg.eigh(moments).eigenvectors
    axis = axes[:, -1]
    about_axis = np.outer(vectors @ axis, axis)
    steps[:, :3, :3] = se3.rotation_exp(vectors + gain * about_axis)
    poses = [child.poses[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return posed(child, np.array(poses))


@child_alone(
    code="S8",
    what="mount loosened half-way",
    severities=(0.5, 1.0, 2.0),
    unit="deg",
    named="mount_moved",
)
def loosened(child: Trajectory, degrees: float, random: Random) -> Trajectory:
    """Turn and shift the mount half-way: by ``degrees``, and by 2.5 cm per degree."""
    axes = random.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    translation = 0.025 * degrees * axes[0]
    rotation = np.radians(degrees) * axes[1]
    shift = se3.exp(np.concatenate([translation, rotation]))
    return moved_at(child, slice(len(child) // 2, None), shift)


child_alone(
    code="S9",
    what="scale",
    severities=(0.005, 0.01, 0.02),
    named="scale",
)(lambda child, excess, _: child.scaled(1.0 + excess))


@child_alone(
    code="S10",
    what="mirrored axis",
    severities=THREE,
    unit="(axis)",
    named="axes left_handed",
)
def mirrored(child: Trajectory, axis: float, _: Random) -> Trajectory:
    is_mirrored = np.arange(3) == int(axis)
    signs = np.where(is_mirrored, -1.0, 1.0)
    return with_parts(child, positions=positions_of(child) * signs)


child_alone(
    code="S10b",
    what="child in 2D",
    severities=(0.5, 0.8, 1.0),
    unit="share",
    named="flat unrelated noisy",
)(lambda child, share, _: higher(upright(child, share), 1.0 - share))


@both(
    code="S11",
    what="float32 positions",
    severities=(2e3, 5e4, 5e5),
    unit="m east",
    named="coarse_positions",
)
def as_float32(
    parent: Trajectory, child: Trajectory, metres: float, _: Random
) -> Streams:
    """Store the positions of both streams as float32, on a map whose origin is far away."""
    origin = np.array([metres, 9.0 * metres, 0.0])
    streams = []
    for stream in (parent, child):
        on_map = (positions_of(stream) + origin).astype(np.float32)
        streams.append(with_parts(stream, positions=on_map.astype(float)))
    return streams[0], streams[1]


@both(
    code="S12",
    what="both scalar first",
    severities=(0.0,),
    named="quaternion_order",
)
def scalar_first(
    parent: Trajectory, child: Trajectory, _: float, random: Random
) -> Streams:
    streams = []
    for stream in (parent, child):
        quats_wxyz = np.roll(se3.to_quat_xyzw(stream.poses), 1, axis=1)
        streams.append(with_quats(stream, quats_wxyz))
    return streams[0], streams[1]


@child_alone(
    code="S13",
    what="inverse poses under noise",
    severities=(0.003, 0.02, 0.05),
    unit="m noise",
    named="inverse",
)
def inverted(child: Trajectory, noise: float, random: Random) -> Trajectory:
    poses = noisy(child, noise, random).poses
    return posed(child, se3.inverse(poses))


@child_alone(
    code="S14",
    what="orientations inverted",
    severities=(0.0, 0.01, 0.03),
    unit="m noise",
    named="inverse_orientation",
)
def inverted_orientations(
    child: Trajectory, noise: float, random: Random
) -> Trajectory:
    disturbed = noisy(child, noise, random)
    rotations = se3.rotation_of(disturbed.poses)
    return with_parts(child, np.swapaxes(rotations, 1, 2))


child_alone(
    code="clock",
    what="child's clock",
    severities=(0.02, 0.05, 0.2),
    unit="s",
    named="time_offset",
)(lambda child, s, _: child.shifted(s))


@child_alone(
    code="S15",
    what="jumps",
    severities=(0.003, 0.01, 0.03),
    unit="share",
    named="jumps",
)
def jumping(child: Trajectory, share: float, random: Random) -> Trajectory:
    """Add lasting jumps of 30 cm per axis (1 sigma), at a share of the poses."""
    count = len(child)
    shifts = np.zeros((count, 3))
    rows = random.integers(count, size=round(share * count))
    shifts[rows] = 0.3 * random.standard_normal((len(rows), 3))
    lasting = np.cumsum(shifts, axis=0)
    return with_parts(child, positions=positions_of(child) + lasting)


FAULTS = group("Sc")
