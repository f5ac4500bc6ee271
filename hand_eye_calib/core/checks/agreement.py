"""Checks of two streams that agree, on one clock and in one unit of length.

They detect faults that explain little of the motion and yet bias the extrinsic.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.covariance import FLOOR_TRAVEL_S, usual_speed
from hand_eye_calib.core.assessment.moved import SIGNIFICANT, MountChange, find_change
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median, quantile
from hand_eye_calib.core.base.text import angle, length, listing
from hand_eye_calib.core.checks.findings import LIMITS, Finding, Severity, finding, graded
from hand_eye_calib.core.checks.response import Regression, delays, response
from hand_eye_calib.core.checks.stream_pair import MAX_ROTATION_RAD, MIN_PAIRS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs, pairs_over
from hand_eye_calib.core.solvers.all_pairs import align_rotation_vectors

#: X (4, 4) and its standard deviations (6,), (rho, phi).
Known: TypeAlias = tuple[FloatArray, FloatArray]

# Share of the squared residuals that a fault explains, and its finding if it is significant.
Suspect: TypeAlias = tuple[float, Finding | None]

_STREAMS = ("child", "parent")

# A fault that a Regression estimates (a gain, for example) is reported only if it exceeds this
# multiple of the bias that noise of its regressors may cause.
BIASES = 2.0

# Drift of an odometry along one axis, as a share of the distance. On a flat floor this drift is
# the whole motion along z, and the other stream does not contain it.
_DRIFT = 0.02

# Two frames are one frame if their distance is below this (m) or within its noise.
_SAME_M = 0.005
# Largest angle (rad) of axes that are parallel, unless its noise is larger.
SAME_RAD = float(np.radians(0.3))
# Largest standard deviation of the rotation (rad) with which frames are compared.
MAX_SIGMA_RAD = float(np.radians(0.5))
# Standard deviations within which a distance or an angle may be zero.
_WITHIN = 3.0

# Upper bounds of a lever arm (m), two standard deviations above its length. No two sensors with
# different orientations are closer than this:
_SAME_POSITION_M = 0.002
# Hardly two sensors are mounted closer than this:
_NEARLY_M = 0.012
# The same if their axes are parallel, which is no accident:
_PARALLEL_M = 0.03

# A recording is split at these shares of its poses.
_SPLITS = (0.5, 0.25, 0.75)
# A part of it is sound if its own rotation leaves less than this share of its rotations.
_SOUND_PART = 0.25
# The part has other axes if the rotation of the other part leaves more than this share.
_OTHER_PART = 0.5

# Fewest rotation about an axis, root mean square, relative to the main axis, for which a gain is
# estimated.
_LITTLE = 0.1

# Smallest factor of a coordinate whose inverse is stated. Smaller ones are noise.
_LEAST_FACTOR = 1e-3

# A coordinate explains why streams disagree if it removes this share of the squared residuals.
_MOST = 0.3
# Below this share jumps of a clean recording may be the cause, and the finding is no error.
_SOME = 0.1

# Duration (s) and largest number of motions in which delays and smoothing are estimated.
SHORT_S = 1.0
MOST_SHORT = 6000
# Smallest delay (s): streams of vehicles without faults differ by some milliseconds.
_DELAY_S = 2.5 * FLOOR_TRAVEL_S
# A delay is an error from this multiple of the smallest one on.
_GRAVE = 2.0
# Share of the significance that a delay needs if it equals the clock offset.
_EXPECTED = 2.0 / 3.0
# A delay is an error, whatever explains it, above this time (s) and this many standard deviations,
# if its shift is an error or exceeds this distance (m) and this share of the evidence. The largest
# delays in 81 clean recordings are 33 ms, 38 mm and a share of 0.06 (EuRoC).
_PLAIN_S = 0.04
_PLAIN_SIGMAS = 8.0
_PLAIN_SHIFT_M = 0.02
_PLAIN_SHARE = 0.35
# Factor that lifts a size just above the limit of an error.
_ERROR = 1.001

# Smallest smoothing (s^2) of each part of the poses.
_SMOOTHING_S2 = {"positions": 0.003, "orientations": 0.002}
# Smoothing by interpolation, as a share of the squared interval between poses.
_OF_INTERVAL = 0.25


def check_agreement(
    pose_pairs: PosePairs, motions: MotionPairs, X: FloatArray, known: Known, offset_s: float
) -> list[Finding]:
    """Return the finding about two streams that agree, or none.

    One fault affects several groups of columns. The group that explains most names the fault, if
    it is significant. Odometries drift against each other, and a drift resembles a shift of the
    mount, worlds that are turned, or a scale of one axis.

    Parameters
    ----------
    pose_pairs : PosePairs
        Poses on one clock, in one unit of length.
    motions : MotionPairs
        Motions over some seconds.
    X : (4, 4) array
        Extrinsic fitted to these motions.
    known : ((4, 4) array, (6,) array)
        Best estimate of X, and its standard deviations.
    offset_s : float
        Clock offset that the orientations have shown, s.
    """
    if same := check_same(*known):
        return same
    change = find_change(pose_pairs, X)
    slow, axes = response(pose_pairs, motions, X, change.at_ns if change else None)
    speed = usual_speed(pose_pairs.stamps_ns, se3.translation_of(pose_pairs.Ts_pw_p))
    tried: dict[str, Callable[[], Finding | None]] = {
        "drift": lambda: _world_drift(slow, pose_pairs, speed),
        "gain": lambda: rotation_gain(slow, axes),
        "turned_child": lambda: _turned(slow, "child"),
        "turned_parent": lambda: _turned(slow, "parent"),
        "turned_both": lambda: _turned(slow, "both"),
        "axes_child": lambda: axis_gain(slow, "child"),
        "axes_parent": lambda: axis_gain(slow, "parent"),
    }
    if change:
        tried["moved"] = lambda: moved_mount(change, int(pose_pairs.stamps_ns[0]))
    groups = [max(tried, key=slow.share)]
    if groups[0].startswith("turned"):
        # Streams that are turned explain about the same: any of them may be significant.
        groups = ["turned_child", "turned_parent", "turned_both"]
    suspects: list[Suspect] = [(slow.share(group), tried[group]()) for group in groups]
    motions = pairs_over(pose_pairs, SHORT_S, MOST_SHORT)
    if fast := delays(pose_pairs, motions, X):
        suspects += delay_suspects(fast, pose_pairs, speed, offset_s)
        interval_s = median(np.diff(pose_pairs.stamps_ns)) * 1e-9
        suspects += smoothing_suspects(fast, interval_s, speed)
    largest_share = 0.0
    findings: list[Finding] = []
    for share, suspect in suspects:
        if suspect and share > largest_share:
            largest_share = share
            findings = [suspect]
    return findings


def check_coordinates(pose_pairs: PosePairs, motions: MotionPairs) -> list[Finding]:
    """Return the finding about a coordinate that explains why two streams disagree, or none.

    Both streams have the same rotations.
    """
    X = se3.from_rotation_translation(align_rotation_vectors(motions), np.zeros(3))
    slow, _ = response(pose_pairs, motions, X)
    stream = max(_STREAMS, key=lambda name: slow.share(f"axes_{name}"))
    if slow.share(f"axes_{stream}") <= _MOST:
        return []
    gain = axis_gain(slow, stream)
    return [gain] if gain else []


def check_parts(pose_pairs: PosePairs) -> list[Finding]:
    """Return the finding about parts of a recording whose extrinsic rotations differ, or none.

    A stream that starts anew with other axes leaves two sound parts. The noise model follows one
    of them and rejects the other as outliers.
    """
    motions = pairs_over(pose_pairs, SHORT_S, MOST_SHORT)
    angles = se3.rotation_angle(se3.rotation_of(motions.Ts_parenti_parentj))
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
        of_own = shares.diagonal().max()
        of_other = min(shares[0, 1], shares[1, 0])
        if of_own < _SOUND_PART and of_other > max(_OTHER_PART, 3.0 * of_own):
            turned_rad = float(
                se3.rotation_angle(se3.rotation_of(own[0]).T @ se3.rotation_of(own[1]))
            )
            at_s = float(pose_pairs.stamps_ns[split] - pose_pairs.stamps_ns[0]) * 1e-9
            size = angle(turned_rad)
            return [finding("parts_turned", size=size, at_s=at_s, turned_rad=turned_rad)]
    return []


def _unexplained(motions: MotionPairs, X: FloatArray) -> float:
    """Return the share that an extrinsic X (4, 4) does not explain of the largest rotations.

    The largest rotations are the upper quarter.
    """
    angles = se3.rotation_angle(se3.rotation_of(motions.Ts_parenti_parentj))
    are_large = angles >= quantile(angles, 0.75)
    _, residuals = motions.residuals(X)
    remaining = np.linalg.norm(residuals[are_large], axis=1)
    return median(remaining) / max(median(angles[are_large]), 1e-12)


def check_same(T_parent_child: FloatArray, sigmas: FloatArray) -> list[Finding]:
    """Return the finding about an extrinsic (4, 4), or its translation, of zero, or none.

    ``sigmas`` (6,) are its standard deviations, m and rad.
    """
    distance_m = float(np.linalg.norm(se3.translation_of(T_parent_child)))
    sigma_m = float(sigmas[:3].max())
    upper_m = distance_m + 2 * sigma_m
    angle_rad = float(se3.rotation_angle(se3.rotation_of(T_parent_child)))
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
    """Return the finding about a gain of the child's rotations about an axis, or None.

    Parameters
    ----------
    slow : Regression
        Regression with the columns "gain".
    axes : (3, 3) array
        Principal axes of rotation in the parent sensor's frame, one a column, the main axis first.
    inverse : bool
        Whether the gains are those of the parent's rotations.
    """
    gains, sigmas = slow.fit("gain")
    biases = slow.biases("gain")
    limits = LIMITS["rotation_gain"]
    noise = np.maximum(limits.sigmas * sigmas, BIASES * biases)
    ratios = np.abs(gains) / np.maximum(noise, limits.note)
    # A bias is in inverse proportion to the squared rotation about its axis. Axes with less than
    # _LITTLE of the rotation about the main axis (the first) are skipped.
    ratios = np.where(biases < biases[0] / _LITTLE**2, ratios, 0.0)
    k = int(np.argmax(ratios))
    if ratios[k] < 1.0:
        return None
    axis = ", ".join(f"{component:.2f}" for component in axes[:, k])
    gain = 1.0 / (1.0 + gains[k]) - 1.0 if inverse else gains[k]
    values = {"axis": axis, "gain": 1.0 + gain, "sigma": sigmas[k]}
    return graded("rotation_gain", "child", gain, **values)


def _turned(slow: Regression, stream: str) -> Finding | None:
    """Return the finding about positions turned against the orientations of a stream, or None."""
    turns, sigmas = slow.fit(f"turned_{stream}")
    sizes = np.abs(turns)
    limits = LIMITS["worlds_turned"]
    noise = np.hypot(limits.sigmas * sigmas, BIASES * slow.biases(f"turned_{stream}"))
    if (sizes < noise).all() or sizes.max() < limits.note:
        return None
    turned_rad = float(np.linalg.norm(sizes))
    values = {"axis": "xyz"[int(np.argmax(sizes))], "turned_deg": float(np.degrees(turned_rad))}
    return graded("worlds_turned", stream, turned_rad, **values)


class _Deviation(NamedTuple):
    """Deviation of the value on one of three axes from the mean of the others."""

    axis: int
    size: float
    sigma: float


def largest_deviation(values: FloatArray, sigmas: FloatArray) -> _Deviation:
    """Return the most significant deviation among three values (3,) that should be equal."""
    largest = _Deviation(0, 0.0, 1.0)
    weights = 1.0 / np.maximum(sigmas, 1e-9) ** 2
    for axis in range(3):
        others = np.arange(3) != axis
        total_weight = weights[others].sum()
        mean = float(weights[others] @ values[others] / total_weight)
        sigma = float(np.hypot(sigmas[axis], 1.0 / np.sqrt(total_weight)))
        deviation = _Deviation(axis, float(values[axis]) - mean, sigma)
        if abs(deviation.size) / sigma > abs(largest.size) / largest.sigma:
            largest = deviation
    return largest


def axis_gain(slow: Regression, columns_of: str, stream: str = "") -> Finding | None:
    """Return the finding about a coordinate with another scale than the others, or None.

    Parameters
    ----------
    slow : Regression
    columns_of : str
        The stream ("parent" or "child") whose coordinates the columns scale.
    stream : str
        The stream that the finding names, if it is the other one. Its factor is the inverse.
    """
    group = f"axes_{columns_of}"
    gain = largest_deviation(*slow.fit(group))
    of_noise = slow.biases(group)[gain.axis]
    of_drift = _DRIFT**2 * of_noise / slow.biases("scale")[0]
    if abs(gain.size) < BIASES * (of_noise + of_drift):
        return None
    size = gain.size
    if slow.share(group) <= _SOME:
        size = min(abs(size), LIMITS["axis_scale"].error)
    factor = 1.0 + gain.size
    if stream not in ("", columns_of):
        factor = 1.0 / max(factor, _LEAST_FACTOR)
    values = {"axis": "xyz"[gain.axis], "factor": factor, "sigma": gain.sigma}
    return graded("axis_scale", stream or columns_of, size, gain.sigma, **values)


def moved_mount(change: MountChange, start_ns: int) -> Finding | None:
    """Return the finding about a mount that has moved, or None if the change is not significant.

    ``start_ns`` is the first stamp of the recording.
    """
    if change.log_ratio < SIGNIFICANT:
        return None
    sigmas = np.sqrt(np.diag(change.covariance))
    significant = np.where(np.abs(change.xi) > 2.0 * sigmas, change.xi, 0.0)
    moved_m = float(np.linalg.norm(significant[:3]))
    moved_rad = float(np.linalg.norm(significant[3:]))
    size = max(moved_m, moved_rad)
    if change.log_ratio < 2.0 * SIGNIFICANT:
        size = min(size, LIMITS["mount_moved"].error)
    sizes = []
    if moved_m > 0:
        sizes.append(length(moved_m))
    if moved_rad > 0:
        sizes.append(angle(moved_rad))
    at_s = (change.at_ns - start_ns) * 1e-9
    return graded("mount_moved", "both", size, size=listing(sizes), at_s=at_s)


def _world_drift(slow: Regression, pose_pairs: PosePairs, speed_m_s: float) -> Finding | None:
    """Return the finding about a world that moves against the other, or None.

    ``speed_m_s`` is the usual speed of the sensors.
    """
    drift, sigmas = slow.fit("drift")
    if (np.abs(drift) < LIMITS["world_drift"].sigmas * sigmas).all():
        return None
    positions = se3.translation_of(pose_pairs.Ts_cw_c)
    turning = np.cross(drift[3:], positions - positions.mean(axis=0))
    moving = np.sqrt(((drift[:3] + turning) ** 2).sum(axis=1).mean())
    share = float(moving) / max(speed_m_s, 1e-9)
    rad_per_minute = 60 * float(np.linalg.norm(drift[3:]))
    values = {
        "deg_per_minute": float(np.degrees(rad_per_minute)),
        "m_per_minute": 60 * float(np.linalg.norm(drift[:3])),
        "percent": 100 * share,
    }
    return graded("world_drift", "both", share, **values)


@dataclass(frozen=True)
class _Delay:
    """Delay of some coordinates of a stream against the others.

    Attributes
    ----------
    code : str
        Code of the finding.
    part, others : str
        The coordinates that are late, and those that are not, in words.
    size_s, sigma_s : float
        Delay and its standard deviation, s.
    speed_m_s : float
        Usual speed along these coordinates.
    share : float
        Share of the squared residuals that the delay explains.
    """

    code: str
    part: str
    others: str
    size_s: float
    sigma_s: float
    speed_m_s: float
    share: float

    def finding(self, stream: str, offset_s: float) -> Finding | None:
        """Return the finding, or None if the delay is too small.

        Weaker evidence suffices if the delay equals the clock offset ``offset_s`` (s).
        """
        shift_m = self.size_s * self.speed_m_s
        size_m = shift_m
        sigma_m = self.sigma_s * self.speed_m_s
        is_expected = abs(self.size_s / abs(offset_s or 1.0) - 1.0) < 1.0 - _EXPECTED
        if is_expected:
            sigma_m *= _EXPECTED
        error_m = LIMITS["late"].error
        if self._is_clear(shift_m):
            size_m = max(shift_m, _ERROR * error_m)
        elif is_expected or self.size_s < _GRAVE * _DELAY_S or self.share < _SOME:
            # No error: the shift and its noise are scaled to the limit of errors.
            factor = min(1.0, error_m / max(shift_m, 1e-9))
            size_m = factor * shift_m
            sigma_m = factor * sigma_m
        values = {
            "delay_s": self.size_s,
            "sigma_s": self.sigma_s,
            "shift_m": shift_m,
            "code": self.code,
            "part": self.part,
            "others": self.others,
        }
        return graded("late", stream, size_m, sigma_m, **values)

    def _is_clear(self, shift_m: float) -> bool:
        """Return whether the delay is an error whatever may explain it."""
        if self.size_s <= max(_PLAIN_S, _PLAIN_SIGMAS * self.sigma_s):
            return False
        return shift_m > LIMITS["late"].error or (
            shift_m > _PLAIN_SHIFT_M and self.share > _PLAIN_SHARE
        )


def delay_suspects(
    fast: Regression, pairs: PosePairs, speed_m_s: float, offset_s: float
) -> Iterator[Suspect]:
    """Yield suspects for positions with a delay against the orientations of their stream.

    The delay is that of all positions, or of those along one axis of the stream's world.

    Parameters
    ----------
    fast : Regression
        Regression with the columns of delays.
    pairs : PosePairs
    speed_m_s : float
        Usual speed of the sensors.
    offset_s : float
        Clock offset between the streams.
    """
    for stream, poses in (("child", pairs.Ts_cw_c), ("parent", pairs.Ts_pw_p)):
        smoothing = [f"{part}_{stream}" for part in _SMOOTHING_S2]
        of_all = f"late_{stream}"
        of_axes = f"late_axes_{stream}"
        delays_s, sigmas_s = fast.fit(of_all, *smoothing)
        delay_s = float(delays_s[0])
        late = _Delay(
            code="position_clock",
            part="positions" if delay_s > 0 else "orientations",
            others="orientations" if delay_s > 0 else "positions",
            size_s=abs(delay_s),
            sigma_s=sigmas_s[0],
            speed_m_s=speed_m_s,
            share=fast.share(of_all, *smoothing),
        )
        # The other stream's coordinate cannot be early: negative delays are skipped.
        deviation = largest_deviation(*fast.fit(of_axes, *smoothing))
        late_axis = _Delay(
            code="axis_lag",
            part=f"{'xyz'[deviation.axis]} coordinates",
            others="others",
            size_s=deviation.size,
            sigma_s=deviation.sigma,
            speed_m_s=usual_speed(pairs.stamps_ns, poses[:, [deviation.axis], 3]),
            share=fast.share(of_axes, *smoothing),
        )
        for delay in (late, late_axis):
            if delay.size_s > _DELAY_S:
                yield delay.share, delay.finding(stream, offset_s)


def smoothing_suspects(fast: Regression, interval_s: float, speed_m_s: float) -> Iterator[Suspect]:
    """Yield suspects for one part of the poses that is smoothed.

    A smoothing is an error by the distance that it displaces poses, and a warning by its time at
    the usual speed.

    Parameters
    ----------
    fast : Regression
        Regression with the columns of smoothing.
    interval_s : float
        Interval between poses.
    speed_m_s : float
        Usual speed of the sensors.
    """
    of_interpolation_s2 = _OF_INTERVAL * interval_s**2
    limits = LIMITS["smoothed"]
    for part, smallest_s2 in _SMOOTHING_S2.items():
        for stream in _STREAMS:
            group = f"{part}_{stream}"
            delay = f"late_{stream}"
            values, sigmas = fast.fit(group, delay)
            smoothing_s2 = float(values[0])
            noise_s2 = limits.sigmas * float(sigmas[0])
            if smoothing_s2 < max(smallest_s2 + of_interpolation_s2, noise_s2):
                continue
            smoothing_s = smoothing_s2**0.5
            displaced_m = smoothing_s2 * float(fast.displaced(group)[0])
            shift_m = max(displaced_m, min(smoothing_s * speed_m_s, limits.error))
            smoothed = graded(
                "smoothed",
                stream,
                shift_m,
                part=part,
                smoothing_s=smoothing_s,
                shift_m=displaced_m,
            )
            yield fast.share(group, delay), smoothed
