"""Checks of two streams that agree, on one clock and in one unit of length: faults that leave
little of the motion unexplained and yet spoil the extrinsic.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.mount_change import find_change
from hand_eye_calib.checks.findings import Confidence, Finding, Severity, finding
from hand_eye_calib.checks.response import (
    LITTLE,
    MAX_ROTATION,
    Fitted,
    Regression,
    long_response,
    short_response,
)
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.motion_pairs import MotionPairs, pairs_between
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.park import align_rotation_vectors
from hand_eye_calib.stats import median, quantile
from hand_eye_calib.text import angle, length, listing

#: X (4, 4) and its standard deviations (6,), (rho, phi).
Known = tuple[FloatArray, FloatArray]

# Significance that a fault of the response needs, in standard deviations; smoothing, whose sigma
# does not contain noise of the columns, needs more. How many times it must exceed what noise may
# make of it.
_SIGMAS, _SMOOTHING_SIGMAS, _BIASES = 6.0, 8.0, 2.0

# Two frames are one if they are this close (m, rad), within their standard deviations. That of the
# rotation must not be larger than this.
_SAME_M, _SAME_RAD = 0.005, float(np.radians(0.3))
_MAX_SIGMA_RAD, _WITHIN = float(np.radians(0.5)), 3.0

# Upper bounds of the lever arm (m; so many standard deviations above its length). Hardly two
# sensors fit closer than the second; of other orientations, none are closer than the first.
_SAME_POSITION_M, _NEARLY_M, _UPPER = 0.002, 0.012, 2.0

# Where a warning and an error begin: gains of rotations and of coordinates, less 1; worlds that are
# turned (rad).
_GAINS, _AXIS_GAINS = (0.003, 0.03), (0.015, 0.05)
_TURNED = (float(np.radians(0.5)), float(np.radians(1.5)))

# A coordinate that follows the motion by less than this share is constant.
_CONSTANT = 0.05

# A coordinate explains why streams disagree if it takes away this share of the squared residuals.
_MOST = 0.3

# Smallest delay (s), and smoothing (s^2), that count. Shifts (m) by
# either where a warning and an error begin.
_DELAY_S, _SHIFTS_M = 0.003, (0.008, 0.05)
_SMOOTHING_S2 = {"positions": 0.003, "orientations": 0.002}

# Speeds are over about this time (s), so that noise is no speed.
_SPEED_SPAN_S = 0.4

# A world moves if it does so at this share of the sensor's speed: its direction is then off by half
# the usual target of a rotation.
_MOVING = 0.003

# Shifts of the mount (m, rad) where a warning and an error begin.
_MOVED_M, _MOVED_RAD = (0.005, 0.02), (float(np.radians(0.2)), float(np.radians(1.0)))

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
    suspects = [*_of_response(pose_pairs, motions, T_parent_child)]
    # One fault shows in several groups of columns: the one that explains most is it.
    found = [max(suspects, key=lambda each: each.share).finding()] if suspects else []
    return found + _check_mount(pose_pairs, T_parent_child)


def check_coordinates(pose_pairs: PosePairs, motions: MotionPairs) -> list[Finding]:
    """Finding about a coordinate that explains why two streams with the same rotations disagree."""
    X = se3.from_rotation_translation(align_rotation_vectors(motions), np.zeros(3))
    slow = long_response(pose_pairs, motions, X)
    found = [each for each in _axis_gains(slow[0]) if each.share > _MOST] if slow else []
    return [max(found, key=lambda each: each.share).finding()] if found else []


def check_same(T_parent_child: FloatArray, sigmas: FloatArray) -> list[Finding]:
    """Finding about an extrinsic, or a translation, of zero."""
    distance_m, sigma_m = float(np.linalg.norm(T_parent_child[:3, 3])), float(sigmas[:3].max())
    upper_m = distance_m + _UPPER * sigma_m
    if upper_m > _NEARLY_M or sigmas[3:].max() > _MAX_SIGMA_RAD:
        return []
    angle_rad = float(se3.rotation_angle(T_parent_child[:3, :3]))
    if angle_rad < max(_SAME_RAD, _WITHIN * sigmas[3:].max()):
        size = f"{length(distance_m)} and {angle(angle_rad)}"
        severity = _severity(distance_m < max(_SAME_M, _WITHIN * sigma_m))
        values: dict[str, Any] = {
            "size": size,
            "translation_m": distance_m,
            "rotation_rad": angle_rad,
        }
        return [finding("same_frame", severity=severity, **values)]
    size = f"{length(distance_m)} +/- {length(sigma_m)}"
    severity = _severity(upper_m < _SAME_POSITION_M)
    values = {"translation_m": distance_m, "sigma_m": sigma_m}
    return [finding("same_position", severity=severity, size=size, **values)]


def _severity(is_error: bool | np.bool_) -> Severity:
    return Severity.ERROR if is_error else Severity.WARNING


@dataclass(frozen=True)
class _Suspect:
    """A finding by its key, and the share of the residuals that it explains."""

    share: float
    key: str
    stream: str
    is_error: bool | np.bool_
    values: dict[str, Any]

    def finding(self) -> Finding:
        return finding(self.key, self.stream, _severity(self.is_error), **self.values)


def _of_response(
    pose_pairs: PosePairs, motions: MotionPairs, T_parent_child: FloatArray
) -> Iterator[_Suspect]:
    """What is wrong with how the child's motion follows the parent's."""
    gain, speeds = np.eye(3), _speeds(pose_pairs)
    if slow := long_response(pose_pairs, motions, T_parent_child):
        yield from _rotation_gains(*slow, gain)
        yield from _turned(slow[0])
        yield from _axis_gains(slow[0])
        yield from _world_drift(slow[0], pose_pairs, speeds)
    fast = short_response(pose_pairs, T_parent_child, gain)
    if fast is not None:
        yield from _delays(*fast[:2], speeds)
        yield from _smoothing(*fast, speeds)


def _rotation_gains(slow: Regression, axes: FloatArray, gain: FloatArray) -> Iterator[_Suspect]:
    """A gain of the child's rotations about an axis, which is put into the matrix ``gain``."""
    fitted, powers = slow.fit("gain"), slow.powers("gain")
    sizes = np.abs(fitted.values)
    limits = np.maximum(_SIGMAS * fitted.sigmas, _BIASES * slow.biases("gain"))
    limits = np.maximum(_GAINS[0], limits)
    counts = (sizes > limits) & (powers > LITTLE**2 * powers[0])
    if counts.any():
        gain += (axes * np.where(counts, fitted.values, 0.0)) @ axes.T
        k = int(np.argmax(np.where(counts, sizes / limits, 0.0)))
        axis = ", ".join(f"{component:.2f}" for component in axes[:, k])
        values: dict[str, Any] = {
            "axis": axis,
            "gain": 1.0 + fitted.values[k],
            "sigma": fitted.sigmas[k],
        }
        yield _Suspect(fitted.share, "rotation_gain", "child", sizes[k] > _GAINS[1], values)


def _turned(slow: Regression) -> Iterator[_Suspect]:
    """Positions of a stream that are turned against its orientations, or of both."""
    for stream, groups in (("child", 1), ("parent", 1), ("both", 2)):
        names = ("turned_child", "turned_parent") if groups == 2 else (f"turned_{stream}",)
        fitted = slow.fit(*names)
        k = int(np.argmax(fitted.significance))
        size_rad, sigmas = float(np.abs(fitted.values[k])), float(fitted.significance[k])
        if sigmas > _SIGMAS and size_rad > _TURNED[0]:
            part = fitted.values.reshape(-1, 3)[k // 3]
            turned_rad = float(np.linalg.norm(part))
            values: dict[str, Any] = {
                "turned_rad": turned_rad,
                "turned_deg": float(np.degrees(turned_rad)),
            }
            values |= {"axis": "xyz"[int(np.argmax(np.abs(part)))], "sigmas": sigmas}
            # Six values explain more than three.
            share = fitted.share * (0.9 if groups == 2 else 1.0)
            yield _Suspect(share, "worlds_turned", stream, size_rad > _TURNED[1], values)


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


def _axis_gains(slow: Regression) -> Iterator[_Suspect]:
    """A coordinate of a stream that has another scale than the others."""
    for stream in ("child", "parent"):
        fitted = slow.fit(f"axes_{stream}", without="scale")
        k, off, sigma = _odd_one(fitted)
        bias = float(slow.biases(f"axes_{stream}")[k])
        if abs(off) > max(_AXIS_GAINS[0], _SIGMAS * sigma, _BIASES * bias):
            key = "constant_coordinate" if 1.0 + off < _CONSTANT else "axis_scale"
            values: dict[str, Any] = {"axis": "xyz"[k], "factor": 1.0 + off, "sigma": sigma}
            yield _Suspect(fitted.share, key, stream, abs(off) > _AXIS_GAINS[1], values)


def _world_drift(slow: Regression, pose_pairs: PosePairs, speeds: FloatArray) -> Iterator[_Suspect]:
    """A world that moves against the other."""
    fitted = slow.fit("drift")
    positions = pose_pairs.Ts_cw_c[:, :3, 3]
    turning = np.cross(fitted.values[3:], positions - positions.mean(axis=0))
    speed = np.sqrt(((fitted.values[:3] + turning) ** 2).sum(axis=1).mean())
    share = float(speed) / max(_rms(speeds), 1e-9)
    if fitted.significance.max() >= _SIGMAS and share > _MOVING:
        speed, rate = (float(np.linalg.norm(part)) for part in np.split(fitted.values, 2))
        values = {"rate_rad_s": rate, "speed_m_s": speed, "share_of_speed": share}
        values |= {"deg_per_minute": float(np.degrees(60 * rate)), "m_per_minute": 60 * speed}
        values["percent"] = 100 * share
        yield _Suspect(fitted.share, "world_drift", "both", False, values)


def _delays(rotations: Regression, positions: Regression, speeds: FloatArray) -> Iterator[_Suspect]:
    """Positions that are late, or early, against orientations of their stream: all, or those along
    one axis of its world.
    """
    of_rotations, of_positions = (
        each.fit("late", without="late") for each in (rotations, positions)
    )
    delay_s = float(of_positions.values[0] - of_rotations.values[0])
    sigma_s = float(np.hypot(of_positions.sigmas[0], of_rotations.sigmas[0]))
    shift_m = abs(delay_s) * _rms(speeds)
    if abs(delay_s) > max(_DELAY_S, _SIGMAS * sigma_s) and shift_m > _SHIFTS_M[0]:
        # Which stream it is cannot be told; hardly a filter makes positions early.
        stream = "child" if delay_s > 0 else "parent"
        values = {"delay_s": delay_s, "size_s": abs(delay_s), "sigma_s": sigma_s}
        values["shift_m"] = shift_m
        share = max(of_positions.share, of_rotations.share)
        yield _Suspect(share, "position_clock", stream, shift_m > _SHIFTS_M[1], values)
    for stream, columns in (("child", 0), ("parent", 3)):
        fitted = positions.fit(f"late_axes_{stream}", without="late")
        k, off_s, sigma_s = _odd_one(fitted)
        shift_m = abs(off_s) * float(np.sqrt(np.mean(speeds[:, columns + k] ** 2)))
        # The other stream's coordinate cannot be early.
        if off_s > max(_DELAY_S, _SIGMAS * sigma_s) and shift_m > _SHIFTS_M[0]:
            of_axis = {"axis": "xyz"[k], "delay_s": off_s, "sigma_s": sigma_s, "shift_m": shift_m}
            yield _Suspect(fitted.share, "axis_lag", stream, shift_m > _SHIFTS_M[1], of_axis)


def _smoothing(
    rotations: Regression, positions: Regression, least_s2: float, speeds: FloatArray
) -> Iterator[_Suspect]:
    """Smoothing of one part of the poses."""
    for part, regression in (("positions", positions), ("orientations", rotations)):
        for stream in ("child", "parent"):
            fitted = regression.fit(f"smooth_{stream}")
            value, sigma = float(fitted.values[0]), float(fitted.sigmas[0])
            smoothing_s = float(np.sqrt(max(value, 0.0)))
            shift_m = smoothing_s * _rms(speeds)
            least = max(_SMOOTHING_S2[part] + least_s2, _SMOOTHING_SIGMAS * sigma)
            if value >= least and shift_m > _SHIFTS_M[0]:
                values: dict[str, Any] = {
                    "part": part,
                    "smoothing_s": smoothing_s,
                    "shift_m": shift_m,
                }
                values["sigmas"] = value / max(sigma, 1e-12)
                is_error = shift_m > _SHIFTS_M[1]
                yield _Suspect(fitted.share, "smoothed", stream, is_error, values)


def _speeds(pose_pairs: PosePairs) -> FloatArray:
    """Velocities (M, 6), m/s: of the child in its world, then of the parent in its own. Jumps are
    left out.
    """
    positions = np.concatenate([pose_pairs.Ts_cw_c[:, :3, 3], pose_pairs.Ts_pw_p[:, :3, 3]], axis=1)
    step = max(1, round(_SPEED_SPAN_S / max(median(np.diff(pose_pairs.stamps_ns)) * 1e-9, 1e-9)))
    seconds = (pose_pairs.stamps_ns[step:] - pose_pairs.stamps_ns[:-step]) * 1e-9
    velocities = (positions[step:] - positions[:-step]) / seconds[:, None]
    sizes = np.linalg.norm(velocities[:, 3:], axis=1)
    return np.asarray(velocities[sizes <= 3 * median(sizes)])


def _rms(speeds: FloatArray) -> float:
    """Root mean square speed of the parent."""
    return float(np.sqrt((speeds[:, 3:] ** 2).sum(axis=1).mean())) if len(speeds) else 0.0


def _check_mount(pose_pairs: PosePairs, T_parent_child: FloatArray) -> list[Finding]:
    """Finding about a mount that has moved."""
    change = find_change(pose_pairs, T_parent_child)
    if change is None or not change.is_significant:
        return []
    sigmas = np.sqrt(np.diag(change.covariance))
    moved_m, moved_rad = (
        float(np.linalg.norm(change.xi[part] * (np.abs(change.xi) > 2.0 * sigmas)[part]))
        for part in (slice(0, 3), slice(3, 6))
    )
    if moved_m < _MOVED_M[0] and moved_rad < _MOVED_RAD[0]:
        return []
    is_error = change.is_step and (moved_m > _MOVED_M[1] or moved_rad > _MOVED_RAD[1])
    at_s = (change.at_ns - pose_pairs.stamps_ns[0]) * 1e-9
    span_s = (change.latest_ns - change.earliest_ns) * 1e-9
    sizes = [length(moved_m)] if moved_m else []
    sizes += [angle(moved_rad)] if moved_rad else []
    when = f"changes {at_s:.0f} s after the start (within {max(span_s, 1.0):.0f} s)"
    why = "a mount that came loose or was knocked, or an estimator that started anew"
    if not change.is_step:
        when = "seems to change in the course of the recording"
        why = "a mount that gives way, or a sensor whose errors wander over minutes"
    return [
        finding(
            "mount_moved",
            severity=_severity(is_error),
            confidence=Confidence.LIKELY if change.is_step else Confidence.POSSIBLE,
            when=when,
            why=why,
            size=listing(sizes),
            at_s=at_s,
            at_ns=float(change.at_ns),
            translation_m=moved_m,
            rotation_rad=moved_rad,
            log_likelihood_ratio=change.log_ratio,
        )
    ]


def check_independent(parent: Trajectory, child: Trajectory, offset_s: float) -> list[Finding]:
    """Finding about streams of which one was computed from the other, or none.

    Two sensors differ by their noise, whatever the extrinsic is. Poses that were computed from
    others agree with them to the rounding of their numbers, on the transform that was used.
    Orientations alone show it: they follow from the other stream's if the poses do.

    Parameters
    ----------
    parent, child : Trajectory
    offset_s : float
        Offset that was found; the stamps as they are count as well.
    """
    (rough_p, white_p), (rough_c, white_c) = map(_roughness, (parent, child))
    limit_rad = min(_AGREE_RAD, min(rough_p, rough_c) / _BELOW_ROUGHNESS)
    if min(white_p, white_c) > _WHITE:
        limit_rad = max(limit_rad, min(_AGREE_NOISE_RAD, min(rough_p, rough_c) / _BELOW_NOISE))
    for moved in (child, child.shifted(offset_s)) if offset_s else (child,):
        # Programs interpolate at the stamps of the new stream, most of them along a straight line.
        for slow, fast in ((moved, parent), (parent, moved)):
            for straight in (True, False):
                residual_rad = _disagreement(slow, fast, straight)
                if residual_rad < limit_rad:
                    return [finding("not_independent", residual_rad=residual_rad)]
    return []


def _roughness(trajectory: Trajectory) -> tuple[float, float]:
    """Third difference of the orientations, rad, and by how much the fourth is larger."""
    rotations = trajectory.poses[:, :3, :3]
    steps = se3.rotation_log(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    third, fourth = (_size(np.diff(steps, n=n, axis=0)) for n in (2, 3))
    return third, fourth / max(third, 1e-300)


def _disagreement(slow: Trajectory, fast: Trajectory, straight: bool) -> float:
    """Angle (rad) that remains between the rotations of two streams, one of them interpolated at
    stamps of the other; infinite if they have too few in common.
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
    between = fast.at(slow.stamps_ns[indices], straight=straight)
    start = np.arange(len(indices) - 1)
    pairs = pairs_between(between, slow.poses[indices], start, start + 1)
    pairs = pairs[se3.rotation_angle(pairs.Ts_parenti_parentj[:, :3, :3]) < MAX_ROTATION]
    if len(pairs) < 3:
        return np.inf
    X = se3.from_rotation_translation(align_rotation_vectors(pairs), np.zeros(3))
    return _size(pairs.rotation_residuals(X))


def _size(vectors: FloatArray) -> float:
    return quantile(np.linalg.norm(vectors, axis=1), _SHARE)
