"""What can be said about a stream of poses by looking at it alone, and about the stamps of two."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.checks.findings import Confidence, Finding, Severity
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.leaps import find_leap


@dataclass(frozen=True)
class StreamSummary:
    """A stream in numbers: poses, seconds, poses per second, longest interval (s), way (m) and
    turning (rad).
    """

    poses: int
    duration_s: float
    rate_hz: float
    longest_interval_s: float
    way_m: float
    turned_rad: float


# Poses are compared over at least this long, so that the way is not that of the noise.
_WAY_STEP_S = 0.2

# An interval is a gap when it is longer than the limit and than so many usual ones.
_GAP_INTERVALS = 5.0

# A step is a jump when it differs from the steps around it by this many times the usual difference,
# and by so many times the usual step.
_JUMP_SIGMAS, _JUMP_STEPS = 12.0, 3.0
_JUMPS_MATTER = 0.002

# A stream is frozen where its pose is repeated to the last digits for this long (s) and at least so
# many times, while the other moves.
_FROZEN_S, _FROZEN_POSES = 1.0, 10
_SAME_POSE = 1e-12
_MOVES_RAD, _MOVES_M = 0.02, 0.02

# Stamps in nanoseconds of a date lie around 1.7e18; read in another unit they are powers of a
# thousand away.
_STAMP_UNITS = {1e3: "microseconds", 1e6: "milliseconds", 1e9: "seconds"}
_SAME_TIME = 0.2
_DATE_NS = 1e17


def summarise(trajectory):
    """StreamSummary of a trajectory of at least two poses."""
    intervals_s = np.diff(trajectory.stamps_ns) * 1e-9
    coarse = coarse_poses(trajectory, max(_WAY_STEP_S, float(np.median(intervals_s))))
    steps = np.linalg.norm(np.diff(coarse[:, :3, 3], axis=0), axis=1)
    angles = se3.rotation_angle(np.swapaxes(coarse[:-1, :3, :3], 1, 2) @ coarse[1:, :3, :3])
    return StreamSummary(
        len(trajectory),
        trajectory.duration_s,
        float(1.0 / np.median(intervals_s)),
        float(intervals_s.max()),
        float(steps.sum()),
        float(angles.sum()),
    )


def coarse_poses(trajectory, step_s):
    """The first pose of every step of ``step_s`` seconds that has one: (M, 4, 4) array."""
    steps = (trajectory.stamps_ns - trajectory.stamps_ns[0]) // round(step_s * 1e9)
    return trajectory.poses[np.unique(steps, return_index=True)[1]]


def tidy(stamps_ns, translations, quats_xyzw, stream, **frames):
    """A Trajectory from poses in the order they came in, and findings about that order.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    translations : (N, 3) array
    quats_xyzw : (N, 4) array
    stream : str
        "parent" or "child".

    Returns
    -------
    trajectory : Trajectory
        Sorted; of poses with the same stamp the first.
    findings : list of Finding
    """
    stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
    sorted_ns, first = np.unique(stamps_ns, return_index=True)
    findings = []
    repeated, backwards = len(stamps_ns) - len(sorted_ns), int((np.diff(stamps_ns) < 0).sum())
    if repeated:
        findings.append(
            Finding(
                "duplicates", stream, Severity.NOTE, Confidence.CERTAIN,
                f"{repeated} of {len(stamps_ns)} {stream} poses repeat a stamp", "the first of each is used",
            )
        )  # fmt: skip
    if backwards:
        findings.append(
            Finding(
                "disorder", stream, Severity.NOTE, Confidence.CERTAIN,
                f"{backwards} {stream} stamps are earlier than the one before", "poses are sorted by stamp",
            )
        )  # fmt: skip
    return Trajectory.from_quat_xyzw(
        sorted_ns, np.asarray(translations)[first], np.asarray(quats_xyzw)[first], **frames
    ), findings


def check_stream(trajectory, stream, max_gap_s=CalibratorConfig.max_gap):
    """Findings about one stream: too short, a leap in time, gaps, jumps.

    Parameters
    ----------
    trajectory : Trajectory
    stream : str
        "parent" or "child".
    max_gap_s : float

    Returns
    -------
    list of Finding
    """
    if len(trajectory) < 4:
        return [
            Finding(
                "too_short", stream, Severity.ERROR, Confidence.CERTAIN,
                f"the {stream} stream has {len(trajectory)} poses", "record longer, or check the topic",
            )
        ]  # fmt: skip
    if leap := find_leap(trajectory.stamps_ns):
        return [_leap_finding(leap, stream)]
    findings = []
    intervals_s = np.diff(trajectory.stamps_ns) * 1e-9
    gaps = intervals_s > max(max_gap_s, _GAP_INTERVALS * float(np.median(intervals_s)))
    if gaps.any():
        findings.append(
            Finding(
                "gaps", stream, Severity.NOTE, Confidence.CERTAIN,
                f"the {stream} stream has {int(gaps.sum())} gaps of up to {intervals_s.max():.2f} s "
                f"({intervals_s[gaps].sum() / intervals_s.sum():.0%} of the time)",
                "nothing is paired across a gap; raise max_gap if the motion there is smooth",
            )
        )  # fmt: skip
    share = float(_jumps(trajectory).mean())
    if share > _JUMPS_MATTER:
        findings.append(
            Finding(
                "jumps", stream, Severity.WARNING, Confidence.LIKELY,
                f"{share:.1%} of the {stream} stream's steps are jumps: far from the motion before and after",
                "keep method dnlo or adaptive, which leave them out; better, repair the source",
                (("method", "dnlo"),),
            )
        )  # fmt: skip
    return findings


def _leap_finding(leap, stream):
    return Finding(
        "leap",
        stream,
        Severity.ERROR,
        Confidence.CERTAIN,
        f"the {stream} stream's {leap.what()}",
        leap.advice(),
    )


def _jumps(trajectory):
    """Mask (N - 1,) of steps that are far from those around them."""
    interval_s = np.diff(trajectory.stamps_ns) * 1e-9
    poses = trajectory.poses
    moves = np.einsum("kji,kj->ki", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    turns = se3.rotation_log(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
    jumps = np.zeros(len(interval_s), dtype=bool)
    for steps in (moves, turns):
        velocities = steps / interval_s[:, None]
        padded = np.concatenate([velocities[2:0:-1], velocities, velocities[-2:-4:-1]])
        around = np.median([padded[shift : shift + len(velocities)] for shift in range(5)], axis=0)
        excess = np.linalg.norm(velocities - around, axis=1)
        speed = np.linalg.norm(velocities, axis=1)
        jumps |= excess > np.maximum(
            _JUMP_SIGMAS * _usual(excess), _JUMP_STEPS * np.quantile(speed, 0.9)
        )
    return jumps


def _usual(values):
    return float(np.median(values)) + 1e-12


def frozen_share(trajectory, other):
    """Share of the time that a stream repeats its pose to the last digits while another one, on the
    same clock, moves.
    """
    same = np.abs(np.diff(trajectory.poses, axis=0)).max(axis=(1, 2)) < _SAME_POSE
    edges = np.flatnonzero(np.diff(np.r_[False, same, False].astype(int)))
    frozen_ns = 0
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        from_ns, until_ns = (int(trajectory.stamps_ns[index]) for index in (start, end))
        if end - start < _FROZEN_POSES or until_ns - from_ns < _FROZEN_S * 1e9:
            continue
        during = other.poses[(other.stamps_ns >= from_ns) & (other.stamps_ns <= until_ns)]
        if len(during) < 2:
            continue
        moved = np.linalg.norm(during[:, :3, 3] - during[0, :3, 3], axis=1).max()
        turned = se3.rotation_angle(during[0, :3, :3].T @ during[:, :3, :3]).max()
        if moved > _MOVES_M or turned > _MOVES_RAD:
            frozen_ns += until_ns - from_ns
    return frozen_ns * 1e-9 / max(trajectory.duration_s, 1e-9)


def check_stamps(parent_stamps_ns, child_stamps_ns):
    """Finding about stamps that are in another unit than the other stream's, or none.

    Parameters
    ----------
    parent_stamps_ns, child_stamps_ns : (N,) int64 arrays
        Stamps as they were read, taken for nanoseconds.

    Returns
    -------
    list of Finding
    """
    stamps = {
        "parent": float(np.median(parent_stamps_ns)),
        "child": float(np.median(child_stamps_ns)),
    }
    early, late = sorted(stamps, key=stamps.get)
    for factor, unit in _STAMP_UNITS.items():
        if (
            stamps[early] > 0
            and stamps[late] > _DATE_NS
            and abs(np.log10(stamps[late] / (stamps[early] * factor))) < _SAME_TIME
        ):
            return [
                Finding(
                    "stamp_unit", early, Severity.ERROR, Confidence.CERTAIN,
                    f"the {early} stream's stamps are {unit} where nanoseconds are meant: they lie {factor:g} times nearer to 1970 than the "
                    f"{late}'s",
                    f"multiply the {early} stream's stamps by {factor:g}",
                )
            ]  # fmt: skip
    return []
