"""Checks of two streams that agree, on one clock and in one unit of length: faults that leave
little of the motion unexplained and yet spoil the extrinsic.
"""

from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.moved import SIGNIFICANT, MountChange, find_change
from hand_eye_calib.checks.findings import Finding, Severity, finding
from hand_eye_calib.checks.response import Fitted, Regression, delays, response
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.motion_pairs import MotionPairs, pairs_between, pairs_over
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.park import align_rotation_vectors
from hand_eye_calib.stats import median, quantile
from hand_eye_calib.text import angle, length, listing

#: X (4, 4) and its standard deviations (6,), (rho, phi).
Known: TypeAlias = tuple[FloatArray, FloatArray]

# The share of the squared residuals that something explains, and its finding if it is significant.
_Suspect: TypeAlias = tuple[float, Finding | None]

_STREAMS = ("child", "parent")

# Significance that a fault of the response needs, in standard deviations: a delay, which is most of
# a lever arm at constant speed, needs less; smoothing, whose sigma does not contain noise of the
# columns, needs more. How many times it must exceed what noise may make of it.
_SIGMAS, _LATE_SIGMAS, _SMOOTHING_SIGMAS, _BIASES = 6.0, 5.0, 8.0, 2.0

# Two frames are one if they are this close (m, rad), within their standard deviations. That of the
# rotation must not be larger than this.
_SAME_M, _SAME_RAD = 0.005, float(np.radians(0.3))
_MAX_SIGMA_RAD, _WITHIN = float(np.radians(0.5)), 3.0

# Upper bounds of the lever arm (m; so many standard deviations above its length). Hardly two
# sensors fit closer than the second; of other orientations, none are closer than the first.
_SAME_POSITION_M, _NEARLY_M, _UPPER = 0.002, 0.012, 2.0

# Where a warning and an error begin: gains of rotations and of coordinates, less 1; worlds that are
# turned (rad); shifts of positions by a delay or smoothing (m); of the mount (m, rad).
_GAINS, _AXIS_GAINS = (0.003, 0.03), (0.015, 0.05)
_TURNED = (float(np.radians(0.5)), float(np.radians(1.5)))
_SHIFTS_M = (0.008, 0.05)
_MOVED_M, _MOVED_RAD = (0.005, 0.02), (float(np.radians(0.2)), float(np.radians(1.0)))

# An axis whose root mean square rotation is below this share of the main axis's has no gain.
_LITTLE = 0.1

# Rotation vectors near half a turn may point either way.
_MAX_ROTATION = 2.8

# A coordinate explains why streams disagree if it takes away this share of the squared residuals;
# with less than the second it may be jumps of a clean recording, and is no error.
_MOST, _SOME = 0.3, 0.1

# Delays and smoothing are looked for in motions over this time (s), so many at most, and speeds are
# over it, so that noise is no speed. Smallest delay (s), and smoothing (s^2), that count; that of
# interpolation is a share of the squared interval.
_SHORT_S, _MOST_SHORT = 0.5, 6000
_DELAY_S = 0.003
_SMOOTHING_S2, _OF_INTERVAL = {"positions": 0.003, "orientations": 0.002}, 0.1

# A world moves if it does so at this share of the sensor's speed: its direction is then off by half
# the usual target of a rotation.
_MOVING = 0.003

# Orientations are copies if they agree to this angle, several times better than any two sensors of
# the recordings at hand, and so many times better than each stream is rough: slow motion is smooth,
# and a slow stream of fast motion is rough without noise. Noise of both streams that is the same
# shows a copy as well: roughness grows with each further difference as that of white noise does
# (by 1.9), and what remains is so many times smaller.
_AGREE_RAD, _BELOW_ROUGHNESS = float(np.radians(0.008)), 50.0
_AGREE_NOISE_RAD, _WHITE, _BELOW_NOISE = float(np.radians(0.02)), 1.6, 15.0

# This share of the poses must agree: the rest may be jumps.
_SHARE = 0.9

# Interpolation adds errors of its own, so that the instants nearest to a pose of both streams are
# compared: this share of them, at least and at most so many.
_NEAREST, _FEWEST_NEAR, _MOST_NEAR = 0.01, 40, 1000


def check_agreement(
    pose_pairs: PosePairs, motions: MotionPairs, T_parent_child: FloatArray, known: Known
) -> list[Finding]:
    """Findings about two streams that agree.

    One fault shows in several groups of columns: the one that explains most is it, or none if that
    is not significant. Odometries drift against each other, and a drift looks a little like a shift
    of the mount, worlds that are turned or a scale by axis.

    Parameters
    ----------
    pose_pairs : PosePairs
        On one clock, in one unit of length.
    motions : MotionPairs
        Over some seconds.
    T_parent_child : (4, 4) array
        X by a fit to these motions.
    known : ((4, 4) array, (6,) array)
        X as well as it is known, and its standard deviations.
    """
    if same := check_same(*known):
        return same
    change = find_change(pose_pairs, T_parent_child)
    slow, axes = response(pose_pairs, motions, T_parent_child, change.at_ns if change else None)
    speeds = _speeds(pose_pairs)
    drift = slow.fit("drift")
    tried = [(drift.share, _world_drift(drift, pose_pairs, speeds))]
    tried += [_rotation_gain(slow.fit("gain"), axes)]
    tried += [_turned(slow, stream) for stream in (*_STREAMS, "both")]
    tried += [_axis_gain(slow, stream) for stream in _STREAMS]
    if change:
        tried += [_moved_mount(slow, change, int(pose_pairs.stamps_ns[0]))]
    suspects = [max(tried, key=lambda each: each[0])]
    motions = pairs_over(pose_pairs, _SHORT_S, _MOST_SHORT)
    if fast := delays(pose_pairs, motions, T_parent_child):
        suspects += _delays(fast, speeds)
        interval_s = median(np.diff(pose_pairs.stamps_ns)) * 1e-9
        suspects += _smoothing(fast, _OF_INTERVAL * interval_s**2, speeds)
    return _likeliest(suspects)


def check_coordinates(pose_pairs: PosePairs, motions: MotionPairs) -> list[Finding]:
    """Finding about a coordinate that explains why two streams with the same rotations disagree."""
    X = se3.from_rotation_translation(align_rotation_vectors(motions), np.zeros(3))
    slow, _ = response(pose_pairs, motions, X)
    tried = [_axis_gain(slow, stream) for stream in _STREAMS]
    return _likeliest([each for each in tried if each[0] > _MOST])


def _likeliest(suspects: list[_Suspect]) -> list[Finding]:
    found = [(share, each) for share, each in suspects if each]
    return [max(found, key=lambda each: each[0])[1]] if found else []


def check_same(T_parent_child: FloatArray, sigmas: FloatArray) -> list[Finding]:
    """Finding about an extrinsic, or a translation, of zero."""
    distance_m, sigma_m = float(np.linalg.norm(T_parent_child[:3, 3])), float(sigmas[:3].max())
    upper_m = distance_m + _UPPER * sigma_m
    if upper_m > _NEARLY_M or sigmas[3:].max() > _MAX_SIGMA_RAD:
        return []
    angle_rad = float(se3.rotation_angle(T_parent_child[:3, :3]))
    if angle_rad < max(_SAME_RAD, _WITHIN * sigmas[3:].max()):
        size = f"{length(distance_m)} and {angle(angle_rad)}"
        is_same = distance_m < max(_SAME_M, _WITHIN * sigma_m)
        return [_found("same_frame", "both", is_same, size=size, translation_m=distance_m)]
    size = f"{length(distance_m)} +/- {length(sigma_m)}"
    is_same = upper_m < _SAME_POSITION_M
    return [_found("same_position", "both", is_same, size=size, translation_m=distance_m)]


def _found(key: str, stream: str, is_error: bool | np.bool_, **values: Any) -> Finding:
    return finding(key, stream, Severity.ERROR if is_error else Severity.WARNING, **values)


def _rotation_gain(fitted: Fitted, axes: FloatArray) -> _Suspect:
    """A gain of the child's rotations about an axis."""
    sizes, powers = np.abs(fitted.values), 1.0 / fitted.biases
    limits = np.maximum(_SIGMAS * fitted.sigmas, _BIASES * fitted.biases)
    ratios = sizes / np.maximum(_GAINS[0], limits)
    ratios = np.where(powers > _LITTLE**2 * powers[0], ratios, 0.0)
    k = int(np.argmax(ratios))
    if ratios[k] < 1.0:
        return fitted.share, None
    axis = ", ".join(f"{component:.2f}" for component in axes[:, k])
    values = {"axis": axis, "gain": 1.0 + fitted.values[k], "sigma": fitted.sigmas[k]}
    return fitted.share, _found("rotation_gain", "child", sizes[k] > _GAINS[1], **values)


def _turned(slow: Regression, stream: str) -> _Suspect:
    """Positions of a stream that are turned against its orientations."""
    fitted = slow.fit(f"turned_{stream}")
    significance = np.abs(fitted.values) / np.maximum(fitted.sigmas, 1e-12)
    if significance.max() < _SIGMAS or np.abs(fitted.values).max() < _TURNED[0]:
        return fitted.share, None
    turned_rad = float(np.linalg.norm(fitted.values))
    axis = "xyz"[int(np.argmax(np.abs(fitted.values)))]
    values = {"axis": axis, "turned_deg": float(np.degrees(turned_rad))}
    return fitted.share, _found("worlds_turned", stream, turned_rad > _TURNED[1], **values)


def _odd_one(fitted: Fitted) -> tuple[int, float, float]:
    """Of three values that should be one: the index of the one that differs most from the others,
    by how much, and the standard deviation of that.
    """
    best = (0, 0.0, 1.0)
    weights = 1.0 / np.maximum(fitted.sigmas, 1e-9) ** 2
    for k in range(3):
        rest = np.arange(3) != k
        mean = float(weights[rest] @ fitted.values[rest] / weights[rest].sum())
        sigma = float(np.hypot(fitted.sigmas[k], 1.0 / np.sqrt(weights[rest].sum())))
        off = float(fitted.values[k]) - mean
        if abs(off) / sigma > abs(best[1]) / best[2]:
            best = k, off, sigma
    return best


def _axis_gain(slow: Regression, stream: str) -> _Suspect:
    """A coordinate of a stream that has another scale than the others."""
    fitted = slow.fit(f"axes_{stream}", without="scale")
    k, off, sigma = _odd_one(fitted)
    if abs(off) < max(_AXIS_GAINS[0], _SIGMAS * sigma, _BIASES * fitted.biases[k]):
        return fitted.share, None
    values = {"axis": "xyz"[k], "factor": 1.0 + off, "sigma": sigma}
    is_error = abs(off) > _AXIS_GAINS[1] and fitted.share > _SOME
    return fitted.share, _found("axis_scale", stream, is_error, **values)


def _moved_mount(slow: Regression, change: MountChange, start_ns: int) -> _Suspect:
    """A mount that has moved."""
    share, sigmas = slow.fit("moved").share, np.sqrt(np.diag(change.covariance))
    known = np.where(np.abs(change.xi) > 2.0 * sigmas, change.xi, 0.0)
    moved_m, moved_rad = (float(np.linalg.norm(part)) for part in np.split(known, 2))
    if change.log_ratio < SIGNIFICANT or (moved_m < _MOVED_M[0] and moved_rad < _MOVED_RAD[0]):
        return share, None
    is_large = moved_m > _MOVED_M[1] or moved_rad > _MOVED_RAD[1]
    size = listing([length(moved_m)] * (moved_m > 0) + [angle(moved_rad)] * (moved_rad > 0))
    values = {"size": size, "at_s": (change.at_ns - start_ns) * 1e-9}
    is_error = is_large and change.log_ratio > 2.0 * SIGNIFICANT
    return share, _found("mount_moved", "both", is_error, **values)


def _world_drift(drift: Fitted, pose_pairs: PosePairs, speeds: FloatArray) -> Finding | None:
    """A world that moves against the other."""
    positions = pose_pairs.Ts_cw_c[:, :3, 3]
    turning = np.cross(drift.values[3:], positions - positions.mean(axis=0))
    moving = np.sqrt(((drift.values[:3] + turning) ** 2).sum(axis=1).mean())
    share = float(moving) / max(_rms(speeds), 1e-9)
    if (np.abs(drift.values) < _SIGMAS * drift.sigmas).all() or share < _MOVING:
        return None
    speed, rate = (60 * float(np.linalg.norm(part)) for part in np.split(drift.values, 2))
    values = {"deg_per_minute": float(np.degrees(rate)), "m_per_minute": speed}
    return _found("world_drift", "both", False, percent=100 * share, **values)


def _delays(fast: Regression, speeds: FloatArray) -> Iterator[_Suspect]:
    """Positions that are late, or early, against orientations of their stream: all, or those along
    one axis of its world.
    """
    for stream, columns in (("child", 0), ("parent", 3)):
        whole, by_axis = fast.fit(f"late_{stream}"), fast.fit(f"late_axes_{stream}")
        k, off_s, off_sigma_s = _odd_one(by_axis)
        delay_s, along = float(whole.values[0]), speeds[:, columns + k]
        parts = ("positions", "orientations")[:: 1 if delay_s > 0 else -1]
        for fitted, late_s, sigma_s, speed, code, names in (
            (whole, abs(delay_s), float(whole.sigmas[0]), _rms(speeds), "position_clock", parts),
            # The other stream's coordinate cannot be early.
            (
                by_axis,
                off_s,
                off_sigma_s,
                float(np.sqrt(np.mean(along**2))),
                "axis_lag",
                (f"{'xyz'[k]} coordinates", "others"),
            ),
        ):
            shift_m = late_s * speed
            if late_s > max(_DELAY_S, _LATE_SIGMAS * sigma_s) and shift_m > _SHIFTS_M[0]:
                values = {"delay_s": late_s, "sigma_s": sigma_s, "shift_m": shift_m, "code": code}
                told = {"part": names[0], "others": names[1]}
                is_error = shift_m > _SHIFTS_M[1]
                yield fitted.share, _found("late", stream, is_error, **values, **told)


def _smoothing(fast: Regression, more_s2: float, speeds: FloatArray) -> Iterator[_Suspect]:
    """Smoothing of one part of the poses."""
    for part, least_s2 in _SMOOTHING_S2.items():
        for stream in _STREAMS:
            fitted = fast.fit(f"{part}_{stream}")
            value, sigma = float(fitted.values[0]), float(fitted.sigmas[0])
            smoothing_s = float(np.sqrt(max(value, 0.0)))
            shift_m = smoothing_s * _rms(speeds)
            least = max(least_s2 + more_s2, _SMOOTHING_SIGMAS * sigma)
            if value >= least and shift_m > _SHIFTS_M[0]:
                values = {"part": part, "smoothing_s": smoothing_s, "shift_m": shift_m}
                is_error = shift_m > _SHIFTS_M[1]
                yield fitted.share, _found("smoothed", stream, is_error, **values)


def _speeds(pose_pairs: PosePairs) -> FloatArray:
    """Velocities (M, 6), m/s: of the child in its world, then of the parent in its own. Jumps are
    left out.
    """
    positions = np.concatenate([pose_pairs.Ts_cw_c[:, :3, 3], pose_pairs.Ts_pw_p[:, :3, 3]], axis=1)
    step = max(1, round(_SHORT_S / max(median(np.diff(pose_pairs.stamps_ns)) * 1e-9, 1e-9)))
    seconds = (pose_pairs.stamps_ns[step:] - pose_pairs.stamps_ns[:-step]) * 1e-9
    velocities = (positions[step:] - positions[:-step]) / seconds[:, None]
    sizes = np.linalg.norm(velocities[:, 3:], axis=1)
    return np.asarray(velocities[sizes <= 3 * median(sizes)])


def _rms(speeds: FloatArray) -> float:
    """Root mean square speed of the parent."""
    return float(np.sqrt((speeds[:, 3:] ** 2).sum(axis=1).mean())) if len(speeds) else 0.0


def check_independent(parent: Trajectory, child: Trajectory, aligned: Trajectory) -> list[Finding]:
    """Finding about streams of which one was computed from the other, or none.

    Two sensors differ by their noise, whatever the extrinsic is. Poses that were computed from
    others agree with them to the rounding of their numbers, on the transform that was used.
    Orientations alone show it: they follow from the other stream's if the poses do.

    Parameters
    ----------
    parent, child : Trajectory
        With their stamps as they are.
    aligned : Trajectory
        The child on the parent's clock.
    """
    (rough_p, white_p), (rough_c, white_c) = map(_roughness, (parent, child))
    limit_rad = min(_AGREE_RAD, min(rough_p, rough_c) / _BELOW_ROUGHNESS)
    if min(white_p, white_c) > _WHITE:
        limit_rad = max(limit_rad, min(_AGREE_NOISE_RAD, min(rough_p, rough_c) / _BELOW_NOISE))
    # Programs interpolate at the stamps of the new stream.
    for slow, fast in ((child, parent), (parent, child), (aligned, parent), (parent, aligned)):
        residual_rad = _disagreement(slow, fast)
        if residual_rad < limit_rad:
            return [finding("not_independent", residual_rad=residual_rad)]
    return []


def _roughness(trajectory: Trajectory) -> tuple[float, float]:
    """Third difference of the orientations, rad, and by how much the fourth is larger."""
    rotations = trajectory.poses[:, :3, :3]
    steps = se3.rotation_log(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    third, fourth = (_size(np.diff(steps, n=n, axis=0)) for n in (2, 3))
    return third, fourth / max(third, 1e-300)


def _disagreement(slow: Trajectory, fast: Trajectory) -> float:
    """Angle (rad) that remains between the rotations of two streams, one of them interpolated
    along a straight line at stamps of the other; infinite if they have too few in common.
    """
    inside = (slow.stamps_ns >= fast.stamps_ns[0]) & (slow.stamps_ns <= fast.stamps_ns[-1])
    indices = np.flatnonzero(inside)
    if len(indices) < 4:
        return np.inf
    after = np.clip(np.searchsorted(fast.stamps_ns, slow.stamps_ns[indices]), 1, len(fast) - 1)
    around = np.abs(fast.stamps_ns[[after - 1, after]] - slow.stamps_ns[indices]).min(axis=0)
    n_nearest = min(max(_FEWEST_NEAR, round(_NEAREST * len(indices))), len(indices))
    indices = indices[around <= np.partition(around, n_nearest - 1)[n_nearest - 1]]
    indices = indices[:: -(-len(indices) // _MOST_NEAR)]
    between = fast.at(slow.stamps_ns[indices], straight=True)
    start = np.arange(len(indices) - 1)
    pairs = pairs_between(between, slow.poses[indices], start, start + 1)
    pairs = pairs[se3.rotation_angle(pairs.Ts_parenti_parentj[:, :3, :3]) < _MAX_ROTATION]
    if len(pairs) < 3:
        return np.inf
    X = se3.from_rotation_translation(align_rotation_vectors(pairs), np.zeros(3))
    return _size(pairs.residuals(X)[1])


def _size(vectors: FloatArray) -> float:
    return quantile(np.linalg.norm(vectors, axis=1), _SHARE)
