"""Checks of two streams that agree, on one clock and in one unit of length: faults that leave
little of the motion unexplained and yet spoil the extrinsic.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.mount_change import find_change
from hand_eye_calib.checks import findings as wording
from hand_eye_calib.checks.findings import Confidence, Finding, Severity
from hand_eye_calib.checks.response import MAX_ROTATION, Smoothing, find_smoothing, rotation_gains
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.gls import estimator
from hand_eye_calib.gls.extras import PartDelay
from hand_eye_calib.gls.solution import AdaptiveSolution
from hand_eye_calib.pairing.motion_pairs import MotionPairs, pairs_between
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.park import align_rotation_vectors
from hand_eye_calib.stats import median, quantile
from hand_eye_calib.text import angle, length, listing

# Significance that every one of these findings needs, in standard deviations, and how many times it
# must exceed what noise may make of it.
_SIGMAS, _SMOOTHING_SIGMAS, _BIASES = 6.0, 8.0, 2.0

# Two frames are one if they are this close (m, rad), within their standard deviations. That of the
# rotation must not be larger than this.
_SAME_M, _SAME_RAD = 0.005, float(np.radians(0.3))
_MAX_SIGMA_RAD, _WITHIN = float(np.radians(0.5)), 3.0

# Upper bounds of the lever arm (m; so many standard deviations above its length). Hardly two
# sensors fit closer than the second; of other orientations, none are closer than the first.
_SAME_POSITION_M, _NEARLY_M, _UPPER = 0.002, 0.012, 2.0

# Gains of rotations, less 1, from which on there is a warning, an error.
_GAIN_WARNING, _GAIN_ERROR = 0.003, 0.03

# Delays of positions against orientations (s, standard deviations), and smoothing (s^2, squared
# intervals of the poses), from which on they count.
_DELAY_S, _DELAY_SIGMAS = 0.003, 4.5
_SMOOTHING_S2, _SMOOTHING_INTERVALS2 = {"position": 0.004, "rotation": 0.002}, 0.1

# Poses that the estimator solves for a check: at most, at least.
_MOST_POSES, _FEWEST_POSES = 400, 60

# What the estimator adds to a time offset that was estimated before, from which on it counts (s).
_SETTLED_S = 0.002

# Speeds are over about this time (s), so that noise is no speed.
_SPEED_SPAN_S = 0.4

# Shifts (m) by a delay or by smoothing from which on they count, and from which on a result is
# unusable.
_SHIFT_M, _SHIFT_ERROR_M = 0.008, 0.05

# A world moves if it does so at this share of the sensor's speed: its direction is then off by half
# the usual target of a rotation.
_MOVING = 0.003

# Shifts of the mount (m, rad) from which on they count, and from which on a result is unusable.
_MOVED_M, _MOVED_RAD = 0.005, float(np.radians(0.2))
_MOVED_ERROR_M, _MOVED_ERROR_RAD = 0.02, float(np.radians(1.0))


# Orientations are copies if they agree to this angle, several times better than any two sensors of
# the recordings at hand, and so many times better than each stream is rough. Neither is enough:
# slow motion is smooth, and a slow stream of fast motion is rough without noise.
_AGREE_RAD, _BELOW_ROUGHNESS = float(np.radians(0.005)), 50.0

# This share of the poses must agree: the rest may be jumps.
_SHARE = 0.9

# Interpolation adds errors of its own, so that the instants nearest to a pose of both streams are
# compared: this share of them, at least and at most so many.
_NEAREST, _FEWEST, _MOST = 0.01, 40, 1000


@dataclass(frozen=True, kw_only=True)
class Aligned:
    """Two streams that agree.

    Attributes
    ----------
    pose_pairs : PosePairs
        On one clock, in one unit of length.
    motions : MotionPairs
        Over some seconds.
    T_parent_child : (4, 4) array
        X.
    covariance : (6, 6) array
        Of (rho, phi) in ``X exp(rho, phi)``.
    solution : AdaptiveSolution or None
        Of the adaptive estimator, if it has settled.
    is_of_result : bool
        The solution's time offset is in the streams already.
    """

    pose_pairs: PosePairs
    motions: MotionPairs
    T_parent_child: FloatArray
    covariance: FloatArray
    solution: AdaptiveSolution | None
    is_of_result: bool

    def refined(self, offset: TimeOffset) -> TimeOffset:
        """The time offset that aligned the streams, with what the estimator adds to it: under its
        noise model, the standard deviation is right even if noise is large.
        """
        found = self.solution
        if found is None or abs(found.time_offset_s) < _SETTLED_S:
            return offset
        seconds = 0.0 if self.is_of_result else offset.seconds + found.time_offset_s
        return replace(offset, seconds=seconds, sigma_s=found.time_offset_sigma_s)

    @property
    def best_known(self) -> tuple[FloatArray, FloatArray]:
        """X and its standard deviations (6,), by the estimator if that is surer of it."""
        by_fit = self.T_parent_child, np.sqrt(np.diag(self.covariance))
        if self.solution is None or self.solution.unseen.size:
            return by_fit
        sigmas = np.sqrt(np.diag(self.solution.cov_parent_child_in_child))
        return min(
            by_fit, (self.solution.T_parent_child, sigmas), key=lambda known: known[1][:3].max()
        )

    @cached_property
    def rms_speed(self) -> float:
        """Root mean square speed of the parent, m/s: without jumps."""
        stamps_s = self.pose_pairs.stamps_ns * 1e-9
        n = round(_SPEED_SPAN_S / median(np.diff(stamps_s)))
        n = min(max(n, 1), len(stamps_s) - 1)
        positions = self.pose_pairs.Ts_pw_p[:, :3, 3]
        steps = np.linalg.norm(positions[n:] - positions[:-n], axis=1)
        speeds = steps / (stamps_s[n:] - stamps_s[:-n])
        return float(np.sqrt(np.mean(np.minimum(speeds, 3 * median(speeds)) ** 2)))


def solved(pose_pairs: PosePairs) -> AdaptiveSolution | None:
    """Answer of the adaptive estimator from some of the poses, with a free clock; None if they are
    too few.
    """
    poses = pose_pairs[:: -(-len(pose_pairs) // _MOST_POSES)]
    if len(poses) < _FEWEST_POSES:
        return None
    return estimator.solve(
        poses.stamps_ns, poses.Ts_pw_p, poses.Ts_cw_c, is_clock_free=True, with_extras=True
    )


def check_aligned(aligned: Aligned) -> list[Finding]:
    """Findings about two streams that agree."""
    if same := check_same(aligned):
        return same
    gains, gain_findings = _check_gains(aligned)
    found = find_smoothing(aligned.pose_pairs, aligned.T_parent_child, gains)
    return [
        *gain_findings,
        *(_check_delays(aligned) or (_check_smoothing(*found, aligned.rms_speed) if found else [])),
        *_check_world(aligned),
        *_check_mount(aligned),
    ]


def check_same(aligned: Aligned) -> list[Finding]:
    """Finding about an extrinsic, or a translation, of zero."""
    T, sigmas = aligned.best_known
    distance_m, sigma_m = float(np.linalg.norm(T[:3, 3])), float(sigmas[:3].max())
    upper_m = distance_m + _UPPER * sigma_m
    if upper_m > _NEARLY_M or sigmas[3:].max() > _MAX_SIGMA_RAD:
        return []
    angle_rad = float(se3.rotation_angle(T[:3, :3]))
    if angle_rad < max(_SAME_RAD, _WITHIN * sigmas[3:].max()):
        is_exact = distance_m < max(_SAME_M, _WITHIN * sigma_m)
        severity = Severity.ERROR if is_exact else Severity.WARNING
        size = f"{length(distance_m)} and {angle(angle_rad)}"
        return [
            wording.finding(
                "same_frame",
                severity=severity,
                size=size,
                translation_m=distance_m,
                rotation_rad=angle_rad,
            )
        ]
    severity = Severity.ERROR if upper_m < _SAME_POSITION_M else Severity.WARNING
    size = f"{length(distance_m)} +/- {length(sigma_m)}"
    return [
        wording.finding(
            "same_position", severity=severity, size=size, translation_m=distance_m, sigma_m=sigma_m
        )
    ]


def _check_gains(aligned: Aligned) -> tuple[FloatArray, list[Finding]]:
    """Gain of the child's rotations, as a matrix, and findings about it."""
    gains, axes = rotation_gains(aligned.motions, aligned.T_parent_child[:3, :3])
    findings: list[Finding] = []
    matrix = np.eye(3)
    for gain, axis in zip(gains, axes.T, strict=True):
        off = abs(gain.value - 1.0)
        if off < max(_GAIN_WARNING, _SIGMAS * gain.sigma, _BIASES * gain.bias):
            continue
        matrix += (gain.value - 1.0) * np.outer(axis, axis)
        if not findings:
            severity = Severity.ERROR if off > _GAIN_ERROR else Severity.WARNING
            direction = ", ".join(f"{component:.2f}" for component in axis)
            found = wording.finding(
                "rotation_gain",
                "child",
                severity,
                axis=direction,
                gain=gain.value,
                sigma=gain.sigma,
            )
            findings.append(found)
    return matrix, findings


def _check_delays(aligned: Aligned) -> list[Finding]:
    """Finding about positions that are late, or early, against orientations of their stream."""
    if aligned.solution is None or aligned.solution.extras is None:
        return []
    delays: dict[str, PartDelay] = dict(
        zip(("child", "parent"), aligned.solution.extras.delays, strict=True)
    )
    stream = max(delays, key=lambda name: delays[name].sigmas)
    delay = delays[stream]
    shift_m = abs(delay.seconds) * aligned.rms_speed
    if delay.sigmas < _DELAY_SIGMAS or abs(delay.seconds) < _DELAY_S or shift_m < _SHIFT_M:
        return []
    return [
        wording.finding(
            "position_clock",
            stream,
            _severity(shift_m),
            delay_s=delay.seconds,
            size_s=abs(delay.seconds),
            sigma_s=delay.sigma_s,
            late="late" if delay.seconds > 0 else "early",
            shift_m=shift_m,
        )
    ]


def _check_world(aligned: Aligned) -> list[Finding]:
    """Finding about a world that moves against the other."""
    found = aligned.solution.extras if aligned.solution else None
    if found is None or not found.world_drift.is_significant:
        return []
    drift = found.world_drift
    share = drift.speed_at(aligned.pose_pairs.Ts_cw_c[:, :3, 3]) / max(aligned.rms_speed, 1e-9)
    if share < _MOVING:
        return []
    speed, rate = (float(np.linalg.norm(part)) for part in (drift.twist[:3], drift.twist[3:]))
    return [
        wording.finding(
            "world_drift",
            evidence=drift.evidence,
            rate_rad_s=rate,
            deg_per_minute=np.degrees(60 * rate),
            speed_m_s=speed,
            m_per_minute=60 * speed,
            share_of_speed=share,
            percent=100 * share,
        )
    ]


def _check_smoothing(found: Smoothing, interval_s: float, rms_speed: float) -> list[Finding]:
    """Findings about smoothing of one part of the poses."""
    for part, least_s2 in _SMOOTHING_S2.items():
        least = least_s2 + _SMOOTHING_INTERVALS2 * interval_s**2
        for stream in ("child", "parent"):
            quantity = found[part, stream]
            if not quantity.exceeds(least + _BIASES * quantity.bias, _SMOOTHING_SIGMAS):
                continue
            shift_m = float(np.sqrt(quantity.value)) * rms_speed
            if shift_m < _SHIFT_M:
                continue
            name = {"position": "positions", "rotation": "orientations"}[part]
            return [
                wording.finding(
                    "smoothed",
                    stream,
                    _severity(shift_m),
                    part=name,
                    smoothing_s=float(np.sqrt(quantity.value)),
                    sigmas=quantity.value / max(quantity.sigma, 1e-12),
                    shift_m=shift_m,
                )
            ]
    return []


def _severity(shift_m: float) -> Severity:
    return Severity.ERROR if shift_m > _SHIFT_ERROR_M else Severity.WARNING


def _check_mount(aligned: Aligned) -> list[Finding]:
    """Finding about a mount that has moved."""
    pose_pairs = aligned.pose_pairs
    change = find_change(pose_pairs, aligned.T_parent_child)
    if change is None or not change.is_significant:
        return []
    sigmas = np.sqrt(np.diag(change.covariance))
    moved_m, moved_rad = (
        float(np.linalg.norm(change.xi[part] * (np.abs(change.xi) > 2.0 * sigmas)[part]))
        for part in (slice(0, 3), slice(3, 6))
    )
    if moved_m < _MOVED_M and moved_rad < _MOVED_RAD:
        return []
    is_error = change.is_step and (moved_m > _MOVED_ERROR_M or moved_rad > _MOVED_ERROR_RAD)
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
        wording.finding(
            "mount_moved",
            severity=Severity.ERROR if is_error else Severity.WARNING,
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
    limit_rad = min(_AGREE_RAD, min(map(_roughness, (parent, child))) / _BELOW_ROUGHNESS)
    for moved in (child, child.shifted(offset_s)):
        # Programs interpolate at the stamps of the new stream, most of them along a straight line.
        for slow, fast in ((moved, parent), (parent, moved)):
            for straight in (True, False):
                residual_rad = _disagreement(slow, fast, straight)
                if residual_rad < limit_rad:
                    return [wording.finding("not_independent", residual_rad=residual_rad)]
    return []


def _roughness(trajectory: Trajectory) -> float:
    """Third difference of the orientations, rad."""
    rotations = trajectory.poses[:, :3, :3]
    steps = se3.rotation_log(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    return _size(np.diff(steps, n=2, axis=0))


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
    n_nearest = min(max(_FEWEST, round(_NEAREST * len(indices))), len(indices))
    indices = indices[around <= np.partition(around, n_nearest - 1)[n_nearest - 1]]
    indices = indices[:: -(-len(indices) // _MOST)]
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
