"""Checks of two streams that agree, on one clock and in one unit of length: faults that leave
little of the motion unexplained and yet spoil the extrinsic.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.covariance import FLOOR_TRAVEL_S, usual_speed
from hand_eye_calib.core.assessment.moved import SIGNIFICANT, MountChange, find_change
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median, quantile
from hand_eye_calib.core.base.text import angle, length, listing
from hand_eye_calib.core.checks.findings import LIMITS, Finding, Severity, finding, graded
from hand_eye_calib.core.checks.hypotheses import MAX_ROTATION_RAD, MIN_PAIRS
from hand_eye_calib.core.checks.response import Regression, delays, response
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs, pairs_over
from hand_eye_calib.core.solvers.all_pairs import align_rotation_vectors

#: X (4, 4) and its standard deviations (6,), (rho, phi).
Known: TypeAlias = tuple[FloatArray, FloatArray]

# The share of the squared residuals that something explains, and its finding if it is significant.
Suspect: TypeAlias = tuple[float, Finding | None]

_STREAMS = ("child", "parent")

# How many times a fault of the response must exceed what noise of its columns may make of it.
BIASES = 2.0

# An odometry may drift along one axis by this share of the distance: on a flat floor that alone
# is its motion along z, and the other stream knows nothing of it.
_DRIFT = 0.02

# Two frames are one if they are this close (m, rad), within so many standard deviations; that of
# the rotation must not be larger than the third.
_SAME_M = 0.005
SAME_RAD = float(np.radians(0.3))
MAX_SIGMA_RAD = float(np.radians(0.5))
_WITHIN = 3.0

# Upper bounds of the lever arm (m; two standard deviations above its length). Hardly two sensors
# fit closer than the second, or, with axes that are parallel by no accident, than the third; of
# other orientations, none are closer than the first.
_SAME_POSITION_M = 0.002
_NEARLY_M = 0.012
_PARALLEL_M = 0.03

# A recording is split at these shares of its poses. A part is sound if its own rotation leaves
# less than the first share of its rotations. It has other axes if the rotation of the other part
# leaves more than the second.
_SPLITS = (0.5, 0.25, 0.75)
_SOUND_PART = 0.25
_OTHER_PART = 0.5

# An axis whose root mean square rotation is below this share of the main axis's has no gain.
_LITTLE = 0.1

# Smallest factor of a coordinate whose inverse is stated: less is noise.
_LEAST_FACTOR = 1e-3

# A coordinate explains why streams disagree if it takes away this share of the squared residuals;
# with less than the second it may be jumps of a clean recording, and is no error.
_MOST = 0.3
_SOME = 0.1

# Delays and smoothing are looked for in motions over this time (s), so many at most. Vehicles whose
# streams are as they should be are off by some milliseconds: a delay counts from the second line on
# (s), and is an error from so many times that; the offset of the clocks is shown by so much of the
# evidence. Smallest smoothing (s^2); that of interpolation is a share of the squared interval.
SHORT_S = 1.0
MOST_SHORT = 6000
_DELAY_S = 2.5 * FLOOR_TRAVEL_S
_GRAVE = 2.0
_EXPECTED = 2.0 / 3.0
# A delay above this time (s) and so many standard deviations is an error whatever explains it, if
# its shift is; or with this shift (m) and this share of the evidence. The largest delays in 81
# clean recordings are 33 ms, 38 mm and a share of 0.06 (EuRoC).
_PLAIN_S = 0.04
_PLAIN_SIGMAS = 8.0
_PLAIN_SHIFT_M = 0.02
_PLAIN_SHARE = 0.35
# Of the size from which on a finding is an error: just above.
_ERROR = 1.001

_SMOOTHING_S2 = {"positions": 0.003, "orientations": 0.002}
_OF_INTERVAL = 0.25


def check_agreement(
    pose_pairs: PosePairs, motions: MotionPairs, X: FloatArray, known: Known, offset_s: float
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
    X : (4, 4) array
        By a fit to these motions.
    known : ((4, 4) array, (6,) array)
        X as well as it is known, and its standard deviations.
    offset_s : float
        By which the clocks differed, by the orientations.
    """
    if same := check_same(*known):
        return same
    change = find_change(pose_pairs, X)
    slow, axes = response(pose_pairs, motions, X, change.at_ns if change else None)
    speed = usual_speed(pose_pairs.stamps_ns, pose_pairs.Ts_pw_p[:, :3, 3])
    tried: dict[str, Callable[[], Finding | None]] = {
        "drift": lambda: _world_drift(slow, pose_pairs, speed),
        "gain": lambda: rotation_gain(slow, axes),
        **{f"turned_{each}": partial(_turned, slow, each) for each in (*_STREAMS, "both")},
        **{f"axes_{each}": partial(axis_gain, slow, each) for each in _STREAMS},
    }
    if change:
        tried["moved"] = lambda: moved_mount(change, int(pose_pairs.stamps_ns[0]))
    most = max(tried, key=slow.share)
    # Streams that are turned explain about the same: one of them may be significant.
    alike = [each for each in tried if each[:6] == most[:6] == "turned"] or [most]
    suspects: list[Suspect] = [(slow.share(each), tried[each]()) for each in alike]
    motions = pairs_over(pose_pairs, SHORT_S, MOST_SHORT)
    if fast := delays(pose_pairs, motions, X):
        suspects += delay_suspects(fast, pose_pairs, speed, offset_s)
        interval_s = median(np.diff(pose_pairs.stamps_ns)) * 1e-9
        suspects += smoothing_suspects(fast, interval_s, speed)
    found = [(share, each) for share, each in suspects if each and share > 0.0]
    return [max(found, key=lambda each: each[0])[1]] if found else []


def check_coordinates(pose_pairs: PosePairs, motions: MotionPairs) -> list[Finding]:
    """Finding about a coordinate that explains why two streams with the same rotations disagree."""
    X = se3.from_rotation_translation(align_rotation_vectors(motions), np.zeros(3))
    slow, _ = response(pose_pairs, motions, X)
    stream = max(_STREAMS, key=lambda each: slow.share(f"axes_{each}"))
    is_most = slow.share(f"axes_{stream}") > _MOST
    return [*filter(None, [axis_gain(slow, stream)])] if is_most else []


def check_parts(pose_pairs: PosePairs) -> list[Finding]:
    """Finding about parts of a recording that agree, each by itself, on different rotations.

    A stream that starts anew with other axes leaves two sound parts. The noise model follows one
    of them, and takes the other for outliers.
    """
    motions = pairs_over(pose_pairs, SHORT_S, MOST_SHORT)
    angles = se3.rotation_angle(motions.Ts_parenti_parentj[:, :3, :3])
    motions = motions[angles < MAX_ROTATION_RAD]
    for share in _SPLITS:
        split = int(share * len(pose_pairs))
        parts = [motions[motions.j < split], motions[motions.i >= split]]
        if min(map(len, parts)) < MIN_PAIRS:
            continue
        own = [
            se3.from_rotation_translation(align_rotation_vectors(part), np.zeros(3))
            for part in parts
        ]
        shares = np.array([[_unexplained(part, X) for X in own] for part in parts])
        is_sound = shares.diagonal().max() < _SOUND_PART
        is_apart = shares[[0, 1], [1, 0]].min() > max(_OTHER_PART, 3.0 * shares.diagonal().max())
        if is_sound and is_apart:
            turned_rad = float(se3.rotation_angle(own[0][:3, :3].T @ own[1][:3, :3]))
            at_s = float(pose_pairs.stamps_ns[split] - pose_pairs.stamps_ns[0]) * 1e-9
            size = angle(turned_rad)
            return [finding("parts_turned", size=size, at_s=at_s, turned_rad=turned_rad)]
    return []


def _unexplained(motions: MotionPairs, X: FloatArray) -> float:
    """Share of the rotations that an extrinsic does not explain; those of the upper quarter."""
    turned = se3.rotation_angle(motions.Ts_parenti_parentj[:, :3, :3])
    most = turned >= quantile(turned, 0.75)
    remaining = np.linalg.norm(motions.residuals(X)[1], axis=1)
    return median(remaining[most]) / max(median(turned[most]), 1e-12)


def check_same(T_parent_child: FloatArray, sigmas: FloatArray) -> list[Finding]:
    """Finding about an extrinsic, or a translation, of zero."""
    distance_m = float(np.linalg.norm(T_parent_child[:3, 3]))
    sigma_m = float(sigmas[:3].max())
    upper_m = distance_m + 2 * sigma_m
    angle_rad = float(se3.rotation_angle(T_parent_child[:3, :3]))
    is_parallel = angle_rad < max(SAME_RAD, _WITHIN * sigmas[3:].max())
    may_be_zero = distance_m < _WITHIN * sigma_m
    near_m = _PARALLEL_M if is_parallel or may_be_zero else _NEARLY_M
    if upper_m > near_m or sigmas[3:].max() > MAX_SIGMA_RAD:
        return []
    if is_parallel:
        key = "same_frame"
        size = f"{length(distance_m)} and {angle(angle_rad)}"
        is_same = distance_m < _SAME_M or may_be_zero
    else:
        key = "same_position"
        size = f"{length(distance_m)} +/- {length(sigma_m)}"
        is_same = upper_m < _SAME_POSITION_M or may_be_zero
    severity = Severity.ERROR if is_same else Severity.WARNING
    return [finding(key, "both", severity, size=size, translation_m=distance_m)]


def rotation_gain(slow: Regression, axes: FloatArray, inverse: bool = False) -> Finding | None:
    """A gain of the child's rotations about an axis; ``inverse`` if the parent's are fitted."""
    gains, sigmas = slow.fit("gain")
    biases = slow.biases("gain")
    limits = LIMITS["rotation_gain"]
    noise = np.maximum(limits.sigmas * sigmas, BIASES * biases)
    ratios = np.abs(gains) / np.maximum(noise, limits.note)
    ratios = np.where(biases < biases[0] / _LITTLE**2, ratios, 0.0)
    k = int(np.argmax(ratios))
    if ratios[k] < 1.0:
        return None
    axis = ", ".join(f"{component:.2f}" for component in axes[:, k])
    gain = 1.0 / (1.0 + gains[k]) - 1.0 if inverse else gains[k]
    values = {"axis": axis, "gain": 1.0 + gain, "sigma": sigmas[k]}
    return graded("rotation_gain", "child", gain, **values)


def _turned(slow: Regression, stream: str) -> Finding | None:
    """Positions of a stream that are turned against its orientations."""
    turns, sigmas = slow.fit(f"turned_{stream}")
    sizes = np.abs(turns)
    limits = LIMITS["worlds_turned"]
    noise = np.hypot(limits.sigmas * sigmas, BIASES * slow.biases(f"turned_{stream}"))
    if (sizes < noise).all() or sizes.max() < limits.note:
        return None
    turned_rad = float(np.linalg.norm(sizes))
    values = {"axis": "xyz"[int(np.argmax(sizes))], "turned_deg": float(np.degrees(turned_rad))}
    return graded("worlds_turned", stream, turned_rad, **values)


def _odd_one(values: FloatArray, sigmas: FloatArray) -> tuple[int, float, float]:
    """The index of the value that differs most from the others, of three that should be one; by how
    much, and the standard deviation of that.
    """
    best = (0, 0.0, 1.0)
    weights = 1.0 / np.maximum(sigmas, 1e-9) ** 2
    for k in range(3):
        rest = np.arange(3) != k
        mean = float(weights[rest] @ values[rest] / weights[rest].sum())
        sigma = float(np.hypot(sigmas[k], 1.0 / np.sqrt(weights[rest].sum())))
        off = float(values[k]) - mean
        if abs(off) / sigma > abs(best[1]) / best[2]:
            best = k, off, sigma
    return best


def axis_gain(slow: Regression, columns_of: str, stream: str = "") -> Finding | None:
    """A coordinate of a stream that has another scale than the others.

    The finding names the stream that the columns are of, or ``stream``, which then has the
    inverse factor.
    """
    group = f"axes_{columns_of}"
    is_inverse = stream not in ("", columns_of)
    k, off, sigma = _odd_one(*slow.fit(group))
    of_noise = slow.biases(group)[k]
    of_drift = _DRIFT**2 * of_noise / slow.biases("scale")[0]
    if abs(off) < BIASES * (of_noise + of_drift):
        return None
    size = off if slow.share(group) > _SOME else min(abs(off), LIMITS["axis_scale"].error)
    factor = 1.0 / max(1.0 + off, _LEAST_FACTOR) if is_inverse else 1.0 + off
    values = {"axis": "xyz"[k], "factor": factor, "sigma": sigma}
    return graded("axis_scale", stream or columns_of, size, sigma, **values)


def moved_mount(change: MountChange, start_ns: int) -> Finding | None:
    """A mount that has moved."""
    sigmas = np.sqrt(np.diag(change.covariance))
    known = np.where(np.abs(change.xi) > 2.0 * sigmas, change.xi, 0.0)
    moved_m, moved_rad = (float(np.linalg.norm(part)) for part in np.split(known, 2))
    if change.log_ratio < SIGNIFICANT:
        return None
    most = LIMITS["mount_moved"].error if change.log_ratio < 2.0 * SIGNIFICANT else np.inf
    told = listing([length(moved_m)] * (moved_m > 0) + [angle(moved_rad)] * (moved_rad > 0))
    values = {"size": told, "at_s": (change.at_ns - start_ns) * 1e-9}
    return graded("mount_moved", "both", min(max(moved_m, moved_rad), most), **values)


def _world_drift(slow: Regression, pose_pairs: PosePairs, usual: float) -> Finding | None:
    """A world that moves against the other."""
    drift, sigmas = slow.fit("drift")
    positions = pose_pairs.Ts_cw_c[:, :3, 3]
    turning = np.cross(drift[3:], positions - positions.mean(axis=0))
    moving = np.sqrt(((drift[:3] + turning) ** 2).sum(axis=1).mean())
    share = float(moving) / max(usual, 1e-9)
    if (np.abs(drift) < LIMITS["world_drift"].sigmas * sigmas).all():
        return None
    speed, rate = (60 * float(np.linalg.norm(part)) for part in np.split(drift, 2))
    values = {"deg_per_minute": float(np.degrees(rate)), "m_per_minute": speed}
    return graded("world_drift", "both", share, **values, percent=100 * share)


def delay_suspects(
    fast: Regression, pairs: PosePairs, speed: float, offset_s: float
) -> Iterator[Suspect]:
    """Positions that are late, or early, against orientations of their stream: all, or those along
    one axis of its world. Less evidence does for positions that do not share the offset of clocks.
    """
    for stream, Ts in zip(_STREAMS, (pairs.Ts_cw_c, pairs.Ts_pw_p), strict=True):
        beside = [f"{part}_{stream}" for part in _SMOOTHING_S2]
        groups = f"late_{stream}", f"late_axes_{stream}"
        delays_s, sigmas_s = fast.fit(groups[0], *beside)
        k, off_s, off_sigma_s = _odd_one(*fast.fit(groups[1], *beside))
        delay_s = float(delays_s[0])
        along = usual_speed(pairs.stamps_ns, Ts[:, [k], 3])
        parts = ("positions", "orientations")[:: 1 if delay_s > 0 else -1]
        of_axis = (f"{'xyz'[k]} coordinates", "others")
        for group, late_s, sigma_s, speed_m_s, code, (part, others) in (
            (groups[0], abs(delay_s), sigmas_s[0], speed, "position_clock", parts),
            # The other stream's coordinate cannot be early.
            (groups[1], off_s, off_sigma_s, along, "axis_lag", of_axis),
        ):
            if late_s > _DELAY_S:
                share = fast.share(group, *beside)
                shift_m = late_s * speed_m_s
                sigma_m = sigma_s * speed_m_s
                values = {"delay_s": late_s, "sigma_s": sigma_s, "shift_m": shift_m, "code": code}
                if is_expected := abs(late_s / abs(offset_s or 1.0) - 1.0) < 1.0 - _EXPECTED:
                    sigma_m *= _EXPECTED
                is_plain = late_s > max(_PLAIN_S, _PLAIN_SIGMAS * sigma_s) and (
                    shift_m > LIMITS["late"].error
                    or (shift_m > _PLAIN_SHIFT_M and share > _PLAIN_SHARE)
                )
                if is_plain:
                    shift_m = max(shift_m, _ERROR * LIMITS["late"].error)
                elif is_expected or late_s < _GRAVE * _DELAY_S or share < _SOME:
                    least = min(1.0, LIMITS["late"].error / max(shift_m, 1e-9))
                    shift_m = least * shift_m
                    sigma_m = least * sigma_m
                values |= {"part": part, "others": others}
                yield share, graded("late", stream, shift_m, sigma_m, **values)


def smoothing_suspects(fast: Regression, interval_s: float, speed: float) -> Iterator[Suspect]:
    """Smoothing of one part of the poses: an error by what it displaces, a warning by what its time
    is at this speed. Poses are ``interval_s`` apart.
    """
    more_s2 = _OF_INTERVAL * interval_s**2
    for part, least_s2 in _SMOOTHING_S2.items():
        for stream in _STREAMS:
            groups = f"{part}_{stream}", f"late_{stream}"
            value_s2, sigma_s2 = (float(each[0]) for each in fast.fit(*groups))
            if value_s2 >= max(least_s2 + more_s2, LIMITS["smoothed"].sigmas * sigma_s2):
                smoothing_s = value_s2**0.5
                displaced_m = value_s2 * float(fast.displaced(groups[0])[0])
                shift_m = max(displaced_m, min(smoothing_s * speed, LIMITS["smoothed"].error))
                values = {"part": part, "smoothing_s": smoothing_s, "shift_m": displaced_m}
                yield fast.share(*groups), graded("smoothed", stream, shift_m, **values)
