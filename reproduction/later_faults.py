"""Faults that were built after the limits of the checks had been set."""

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.changed_streams import (
    Random,
    at_stamps,
    delayed,
    filtered,
    filtered_rotations,
    higher,
    posed,
    positions_of,
    seconds_of,
    upright,
    with_parts,
)
from reproduction.fault_cases import late_positions, loosened
from reproduction.fault_entry import (
    SECONDS,
    THREE,
    Streams,
    both,
    child_alone,
    group,
)

# Time between two world jumps, and between the stamps of poses that arrive together (s).
_BETWEEN_JUMPS_S = 20.0
_TOGETHER_S = 0.001


@child_alone(
    code="U4",
    what="child restarted half-way",
    severities=(0.0, 1.0, 10.0),
    unit="s gap",
)
def restarted(child: Trajectory, gap_s: float, _: Random) -> Trajectory:
    """Restart the child in the middle: a gap, then a new world that begins at its pose."""
    half = len(child) // 2
    poses = child.poses.copy()
    poses[half:] = se3.inverse(poses[half]) @ poses[half:]
    since_ns = child.stamps_ns - child.stamps_ns[half]
    is_gone = (since_ns > 0) & (since_ns < gap_s * 1e9)
    is_kept = ~is_gone
    return Trajectory(child.stamps_ns[is_kept], poses[is_kept])


@both(
    code="U7",
    what="parent's orientations smoothed",
    severities=SECONDS,
    unit="s",
    named="smoothed_orientations position_clock",
)
def smooth_parent(
    parent: Trajectory, child: Trajectory, tau_s: float, _: Random
) -> Streams:
    """Low-pass the parent's orientations, and shift them back by the delay of the filter."""
    smooth = with_parts(parent, filtered_rotations(parent, tau_s))
    poses = delayed(smooth, -tau_s)
    return with_parts(parent, poses[:, :3, :3]), child


@both(
    code="U10",
    what="two recordings, remounted",
    severities=(1.0, 2.0, 5.0),
    unit="deg",
)
def remounted(
    parent: Trajectory, child: Trajectory, degrees: float, random: Random
) -> Streams:
    """Make two recordings a minute apart; the second has another mount and other worlds."""
    remount = loosened(child, degrees, random)
    half_ns = child.stamps_ns[len(child) // 2]
    streams = []
    for stream in (parent, remount):
        is_late = stream.stamps_ns >= half_ns
        world = se3.exp(random.standard_normal(6))
        poses = stream.poses.copy()
        poses[is_late] = world @ poses[is_late]
        stamps_ns = stream.stamps_ns + 60_000_000_000 * is_late
        streams.append(Trajectory(stamps_ns, poses))
    return streams[0], streams[1]


@child_alone(
    code="U11",
    what="poses held",
    severities=(0.1, 0.2, 0.5),
    unit="s",
)
def held(child: Trajectory, interval_s: float, _: Random) -> Trajectory:
    """Repeat a pose until the next interval, like a slow source that is published fast."""
    elapsed_s = seconds_of(child)
    intervals = (elapsed_s / interval_s).astype(int)
    first_of_interval = np.searchsorted(intervals, intervals)
    return posed(child, child.poses[first_of_interval])


@both(
    code="U12",
    what="streams exchanged",
    severities=(0.5, 0.3, 0.7),
    unit="share",
    named="exchanged",
)
def exchanged(
    parent: Trajectory, child: Trajectory, share: float, _: Random
) -> Streams:
    """Exchange the poses of the two streams after a share of the recording."""
    from_ns = child.stamps_ns[int(share * len(child))]
    streams = []
    for first, second in ((parent, child), (child, parent)):
        before = first[first.stamps_ns < from_ns]
        after = second[second.stamps_ns >= from_ns]
        stamps_ns = np.concatenate([before.stamps_ns, after.stamps_ns])
        poses = np.concatenate([before.poses, after.poses])
        streams.append(Trajectory(stamps_ns, poses))
    return streams[0], streams[1]


both(
    code="V1",
    what="parent's positions late",
    severities=(0.02, 0.05, 0.1),
    unit="s",
    named="position_clock",
)(lambda parent, child, s, random: (late_positions(parent, s, random), child))

child_alone(
    code="V2",
    what="child's orientations late",
    severities=(0.02, 0.05, 0.1),
    unit="s",
    named="position_clock",
)(lambda child, s, _: with_parts(child, delayed(child, s)[:, :3, :3]))


@child_alone(
    code="V4",
    what="heading drifts",
    severities=(1.0, 5.0, 20.0),
    unit="deg/min",
)
def heading_drift(child: Trajectory, degrees: float, _: Random) -> Trajectory:
    elapsed_ns = child.stamps_ns - child.stamps_ns[0]
    minutes = elapsed_ns / 60e9
    yaw = np.radians(degrees) * minutes
    turns = se3.rotation_exp(np.outer(yaw, [0.0, 0.0, 1.0]))
    worlds = np.tile(np.eye(4), (len(child), 1, 1))
    worlds[:, :3, :3] = turns
    return posed(child, worlds @ child.poses)


@child_alone(
    code="V6",
    what="stamps scatter",
    severities=(0.005, 0.02, 0.05),
    unit="s",
)
def jittered(child: Trajectory, sigma_s: float, random: Random) -> Trajectory:
    standard = random.standard_normal(len(child))
    jitter_ns = np.round(1e9 * sigma_s * standard)
    return at_stamps(child.stamps_ns + jitter_ns, child.poses)


@child_alone(
    code="V8",
    what="child swings on its mount",
    severities=(0.2, 1.0, 5.0),
    unit="deg",
)
def swinging(child: Trajectory, degrees: float, _: Random) -> Trajectory:
    """Turn the child about its y axis, with a period of seven seconds."""
    phases = 2 * np.pi * seconds_of(child) / 7.0
    angles = np.radians(degrees) * np.sin(phases)
    swing = se3.rotation_exp(np.outer(angles, [0.0, 1.0, 0.0]))
    rotations = child.poses[:, :3, :3]
    return with_parts(child, rotations @ swing)


@child_alone(
    code="W2",
    what="left-handed axes",
    severities=THREE,
    unit="(axis)",
)
def mirrored_world(child: Trajectory, axis: float, _: Random) -> Trajectory:
    is_mirrored = np.arange(4) == int(axis)
    mirror = np.diag(np.where(is_mirrored, -1.0, 1.0))
    return Trajectory(child.stamps_ns, mirror @ child.poses @ mirror)


@child_alone(
    code="W3",
    what="stuck half-way",
    severities=(2.0, 5.0, 15.0),
    unit="s",
)
def stuck(child: Trajectory, seconds: float, _: Random) -> Trajectory:
    """Repeat one pose for some seconds; the true poses follow."""
    first = len(child) // 2
    since_ns = child.stamps_ns - child.stamps_ns[first]
    is_stuck = (since_ns >= 0) & (since_ns < seconds * 1e9)
    poses = child.poses.copy()
    poses[is_stuck] = poses[first]
    return posed(child, poses)


@child_alone(
    code="W4",
    what="few digits",
    severities=(3.0, 2.0, 1.0),
    unit="digits",
)
def few_digits(child: Trajectory, digits: float, _: Random) -> Trajectory:
    step = 10.0 ** -int(digits)

    def rounded(values: FloatArray) -> FloatArray:
        return np.round(values / step) * step

    quats = rounded(se3.to_quat_xyzw(child.poses))
    positions = rounded(positions_of(child))
    return Trajectory(child.stamps_ns, se3.from_quat_xyzw(positions, quats))


@child_alone(
    code="W5",
    what="relocalised every 20 s",
    severities=(0.1, 0.5, 2.0),
    unit="m",
)
def relocalised(child: Trajectory, metres: float, random: Random) -> Trajectory:
    """Let the child's world jump at intervals: ``metres``, and 0.1 rad per metre, per axis."""
    elapsed_s = seconds_of(child)
    poses = child.poses.copy()
    sizes = metres * np.repeat([1.0, 0.1], 3)
    starts_s = np.arange(_BETWEEN_JUMPS_S, elapsed_s[-1], _BETWEEN_JUMPS_S)
    for start_s in starts_s:
        is_later = elapsed_s >= start_s
        jump = se3.exp(sizes * random.standard_normal(6))
        poses[is_later] = jump @ poses[is_later]
    return posed(child, poses)


@child_alone(
    code="W6",
    what="published again",
    severities=(0.005, 0.02, 0.05),
    unit="s later",
)
def republished(child: Trajectory, late_s: float, _: Random) -> Trajectory:
    late_ns = child.stamps_ns + round(late_s * 1e9)
    stamps_ns = np.concatenate([child.stamps_ns, late_ns])
    poses = np.concatenate([child.poses, child.poses])
    return at_stamps(stamps_ns, poses)


@child_alone(
    code="W7",
    what="clock too fast",
    severities=(100.0, 1000.0, 5000.0),
    unit="ppm",
)
def fast_clock(child: Trajectory, ppm: float, _: Random) -> Trajectory:
    """Let the child's clock run too fast; it is correct in the middle of the recording."""
    middle_ns = child.stamps_ns[len(child) // 2]
    since_ns = child.stamps_ns - middle_ns
    late_ns = np.round(1e-6 * ppm * since_ns).astype(np.int64)
    return Trajectory(child.stamps_ns + late_ns, child.poses)


@both(
    code="W8",
    what="heights zero",
    severities=THREE,
    unit="(which)",
)
def heightless(
    parent: Trajectory, child: Trajectory, which: float, _: Random
) -> Streams:
    """Set heights to zero: the parent's (0), both (1), or both without roll and pitch (2)."""
    flat_parent = higher(parent, 0.0)
    flat_child = higher(child, 0.0)
    if which == 0.0:
        return flat_parent, child
    if which == 1.0:
        return flat_parent, flat_child
    return upright(flat_parent), upright(flat_child)


@child_alone(
    code="W10",
    what="stamps of arrival, in bursts",
    severities=(0.1, 0.3, 1.0),
    unit="s",
)
def in_bursts(child: Trajectory, seconds: float, _: Random) -> Trajectory:
    """Stamp the poses with their arrival: those of an interval arrive together at its end."""
    start_ns = child.stamps_ns[0]
    interval_ns = round(seconds * 1e9)
    bursts = (child.stamps_ns - start_ns) // interval_ns
    ends_ns = (bursts + 1) * interval_ns
    place_in_burst = np.arange(len(child)) - np.searchsorted(bursts, bursts)
    behind_ns = np.round(place_in_burst * _TOGETHER_S * 1e9)
    arrival_ns = ends_ns + behind_ns.astype(np.int64)
    return at_stamps(start_ns + arrival_ns, child.poses)


@child_alone(
    code="X1",
    what="positions turned against orientations",
    severities=(1.5, 2.5, 4.0),
    unit="deg",
    named="worlds_turned",
)
def turned_positions(
    stream: Trajectory, degrees: float, _: Random
) -> Trajectory:
    """Turn the positions about z of the world; the orientations stay."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return with_parts(stream, positions=positions_of(stream) @ turn.T)


both(
    code="X2",
    what="the parent's turned",
    severities=(1.5, 2.5, 4.0),
    unit="deg",
    named="worlds_turned",
)(
    lambda parent, child, degrees, _: (
        turned_positions(parent, degrees, _),
        child,
    )
)

child_alone(
    code="X3",
    what="heights in another unit",
    severities=(1.02, 1.1, 3.28084),
    named="axis_scale",
)(lambda child, factor, _: higher(child, factor))


@child_alone(
    code="X4",
    what="heights of a barometer",
    severities=(0.3, 1.0, 3.0),
    unit="s",
    named="axis_lag axis_scale",
)
def late_heights(stream: Trajectory, tau_s: float, _: Random) -> Trajectory:
    positions = positions_of(stream).copy()
    heights = positions[:, 2]
    positions[:, 2] = filtered(heights, stream.stamps_ns, tau_s)
    return with_parts(stream, positions=positions)


child_alone(
    code="X5",
    what="heights constant",
    severities=(0.0,),
    named="axis_scale",
)(lambda child, factor, _: higher(child, factor))


LATER = group("UVW")
# Faults without a finding before the check estimated a parameter for them.
SILENT = group("X")
