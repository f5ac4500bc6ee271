"""Checks of two streams that agree, on one clock and in one unit of length.

They detect faults that explain little of the motion but bias the extrinsic X. The size of a fault
is a coefficient of a regression in :mod:`~hand_eye_calib.core.checks.fault_regression`. The same
module defines the words regressor, group and bias. There are two regressions:

- ``slow``, over motions of some seconds: scales, gains, turned or drifting worlds;
- ``fast``, over motions of one second: delays and smoothing.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.common_mode import (
    FLOOR_TRAVEL_S,
    usual_speed,
)
from hand_eye_calib.core.assessment.moved import (
    SIGNIFICANT,
    MountChange,
    find_change,
)
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.base.text import angle, length, listing
from hand_eye_calib.core.checks.fault_regression import (
    Regression,
    delay_regression,
    motion_regression,
)
from hand_eye_calib.core.checks.findings import (
    LIMITS,
    Finding,
    Severity,
    finding,
    graded,
)
from hand_eye_calib.core.checks.open_delay import (
    NO_DELAY,
    OpenDelay,
    open_delay,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    pairs_over,
)
from hand_eye_calib.core.solvers.all_pairs import align_rotation_vectors

_STREAMS = ("child", "parent")

# A gain, for example, is reported only if it exceeds the bias by this factor. The bias is the error
# that noise of the regressors may cause (:meth:`Regression.biases`).
BIASES = 2.0

# Drift of an odometry along one axis, as a share of the distance travelled. On a flat floor the
# whole motion along z is drift, and the other stream does not contain this drift.
DRIFT_SHARE = 0.02

# Two frames count as one frame if their distance (m) is below this limit, or within its noise.
_SAME_M = 0.005
# Axes count as parallel below this angle (rad), or if the angle is within its noise.
SAME_RAD = float(np.radians(0.3))
# Frames are compared only if the standard deviation of their rotation (rad) is at most this.
MAX_SIGMA_RAD = float(np.radians(0.5))
# Below this number of standard deviations, a distance or an angle may be zero.
ZERO_SIGMAS = 3.0

# The next three limits are compared with the length of the lever arm plus two standard deviations.
# Two sensors with different orientations are an error below this length (m): no two sensors are so
# close.
_SAME_POSITION_M = 0.002
# Two sensors with different orientations are a warning below this length (m).
_NEARLY_M = 0.012
# Two streams with parallel axes are suspicious below this length (m). Two real sensors are hardly
# parallel to 0.3 deg, so both streams probably describe one frame.
_PARALLEL_M = 0.03

# A gain about an axis is estimated only if the rotation about this axis (root mean square) is at
# least this share of the rotation about the main axis.
_MIN_ROTATION_SHARE = 0.1

# Smallest share of the squared residuals that a wrong coordinate must explain if the streams
# disagree.
_EXPLAINING_SHARE = 0.3
# A fault is at most a warning if it explains less than this share of the squared residuals: jumps
# of a clean recording may explain as much.
_ERROR_SHARE = 0.1

# Duration (s) of the short motions from which delays and smoothing are estimated.
SHORT_S = 1.0
# Largest number of such motions.
MAX_SHORT_MOTIONS = 6000
# Smallest delay (s) that is reported. Without a fault, the streams of vehicles differ by
# milliseconds.
_MIN_DELAY_S = 2.5 * FLOOR_TRAVEL_S
# Smallest delay (s) that is an error.
_ERROR_DELAY_S = 2.0 * _MIN_DELAY_S
# The standard deviation of a delay is multiplied by this factor if the delay equals the clock
# offset: such a delay is expected, and needs less evidence.
_EXPECTED_SIGMA_SHARE = 2.0 / 3.0
# A delay is always an error if it exceeds this time (s), this number of standard deviations, and
# either the error limit of the shift, or the shift (m) and the explained share below. The largest
# delays in 81 clean recordings are 33 ms, 38 mm and a share of 0.06 (EuRoC).
_ALWAYS_ERROR_S = 0.04
_ALWAYS_ERROR_SIGMAS = 8.0
_ALWAYS_ERROR_SHIFT_M = 0.02
_ALWAYS_ERROR_SHARE = 0.35
# Size of a fault that must be an error, as a multiple of the error limit: just above the limit.
_JUST_ABOVE = 1.001

# Smallest smoothing (s^2) that is reported. For the definition see the module fault_regression.
_MIN_SMOOTHING_S2 = {"positions": 0.003, "orientations": 0.002}
# Smoothing by the interpolation of poses, as a share of the squared interval between poses.
_INTERPOLATION_SHARE = 0.25


class ExtrinsicEstimate(NamedTuple):
    """Extrinsic X (4, 4), and its standard deviations (6,): translation in m, rotation in rad."""

    T_parent_child: FloatArray
    sigmas: FloatArray


class Suspect(NamedTuple):
    """A possible fault: the share of the squared residuals that it explains, and its finding.

    The finding is None if the fault is not significant.
    """

    explained_share: float
    finding: Finding | None


class Agreement(NamedTuple):
    """Findings about two streams that agree, and a delay of positions that remains open."""

    findings: list[Finding]
    delay: OpenDelay = NO_DELAY


def check_agreement(
    pose_pairs: PosePairs,
    motions: MotionPairs,
    X: FloatArray,
    best: ExtrinsicEstimate,
    offset_s: float,
) -> Agreement:
    """Return the finding about a fault of two agreeing streams, or none, and the open delay.

    One fault changes the residuals of several groups. Therefore only the group that explains most
    of the residuals is reported, if it is significant. If a drift between the odometries explains
    most, three faults that resemble a drift are not reported: a moved mount, turned worlds, and
    another scale on one axis.

    Parameters
    ----------
    pose_pairs : PosePairs
        Poses on one clock, in one unit of length.
    motions : MotionPairs
        Motions over some seconds.
    X : (4, 4) array
        Extrinsic fitted to these motions.
    best : ExtrinsicEstimate
        Most certain estimate of X, from any source.
    offset_s : float
        Clock offset of the orientations, s.
    """
    if same := check_same(best):
        return Agreement(same)
    speed_m_s = usual_speed(
        pose_pairs.stamps_ns, se3.translation_of(pose_pairs.Ts_pw_p)
    )
    suspects = slow_suspects(pose_pairs, motions, X, speed_m_s)
    short_motions = pairs_over(pose_pairs, SHORT_S, MAX_SHORT_MOTIONS)
    delay = NO_DELAY
    if fast := delay_regression(pose_pairs, short_motions, X):
        delay = open_delay(fast, X)
        suspects += delay_suspects(fast, pose_pairs, speed_m_s, offset_s)
        interval_s = median(np.diff(pose_pairs.stamps_ns)) * 1e-9
        suspects += smoothing_suspects(fast, interval_s, speed_m_s)
    largest_share = 0.0
    findings: list[Finding] = []
    for suspect in suspects:
        if suspect.finding and suspect.explained_share > largest_share:
            largest_share = suspect.explained_share
            findings = [suspect.finding]
    return Agreement(findings, delay)


def slow_suspects(
    pose_pairs: PosePairs, motions: MotionPairs, X: FloatArray, speed_m_s: float
) -> list[Suspect]:
    """Return the fault that explains most of the motions over some seconds.

    If this fault is a rotation between positions and orientations, all three faults of this kind
    are returned: of the child, the parent, or both. They explain about the same share, and any of
    them may be significant.
    """
    change = find_change(pose_pairs, X)
    slow, axes = motion_regression(
        pose_pairs, motions, X, change.at_ns if change else None
    )
    checks: dict[str, Callable[[], Finding | None]] = {
        "drift": lambda: _world_drift(slow, pose_pairs, speed_m_s),
        "gain": lambda: rotation_gain(slow, axes),
        "turned_child": lambda: _turned_world(slow, "child"),
        "turned_parent": lambda: _turned_world(slow, "parent"),
        "turned_both": lambda: _turned_world(slow, "both"),
        "axes_child": lambda: axis_gain(slow, "child"),
        "axes_parent": lambda: axis_gain(slow, "parent"),
    }
    if change:
        checks["moved"] = lambda: moved_mount(
            change, int(pose_pairs.stamps_ns[0])
        )
    groups = [max(checks, key=slow.explained_share)]
    if groups[0].startswith("turned"):
        groups = ["turned_child", "turned_parent", "turned_both"]
    return [
        Suspect(slow.explained_share(group), checks[group]())
        for group in groups
    ]


def check_coordinates(
    pose_pairs: PosePairs, motions: MotionPairs
) -> list[Finding]:
    """Return the finding that the scale of one coordinate makes two streams disagree, or none.

    The rotations of both streams must agree.
    """
    X = se3.from_rotation_translation(
        align_rotation_vectors(motions), np.zeros(3)
    )
    slow, _ = motion_regression(pose_pairs, motions, X)
    stream = max(
        _STREAMS, key=lambda name: slow.explained_share(f"axes_{name}")
    )
    if slow.explained_share(f"axes_{stream}") <= _EXPLAINING_SHARE:
        return []
    gain = axis_gain(slow, stream)
    return [gain] if gain else []


def check_same(extrinsic: ExtrinsicEstimate) -> list[Finding]:
    """Return the finding that an extrinsic, or its translation, is zero; otherwise none."""
    sigma_m = float(extrinsic.sigmas[:3].max())
    sigma_rad = float(extrinsic.sigmas[3:].max())
    distance_m = float(
        np.linalg.norm(se3.translation_of(extrinsic.T_parent_child))
    )
    upper_m = distance_m + 2 * sigma_m
    angle_rad = float(
        se3.rotation_angle(se3.rotation_of(extrinsic.T_parent_child))
    )
    is_parallel = angle_rad < max(SAME_RAD, ZERO_SIGMAS * sigma_rad)
    may_be_zero = distance_m < ZERO_SIGMAS * sigma_m
    near_m = _PARALLEL_M if is_parallel or may_be_zero else _NEARLY_M
    if upper_m > near_m or sigma_rad > MAX_SIGMA_RAD:
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


def rotation_gain(slow: Regression, axes: FloatArray) -> Finding | None:
    """Return the finding about a wrong gain of the child's rotations about an axis, or None.

    ``axes`` (3, 3) has the principal axes of rotation as columns, in the parent sensor's frame. The
    main axis is the first column.
    """
    gains, sigmas = slow.fit("gain")
    biases = slow.biases("gain")
    limits = LIMITS["rotation_gain"]
    noise = np.maximum(limits.sigmas * sigmas, BIASES * biases)
    ratios = np.abs(gains) / np.maximum(noise, limits.note)
    # The bias is in inverse proportion to the mean square rotation about its axis. Skip axes with
    # too little rotation, compared with the main axis (the first).
    ratios = np.where(biases < biases[0] / _MIN_ROTATION_SHARE**2, ratios, 0.0)
    k = int(np.argmax(ratios))
    if ratios[k] < 1.0:
        return None
    axis = ", ".join(f"{component:.2f}" for component in axes[:, k])
    values = {"axis": axis, "gain": 1.0 + gains[k], "sigma": sigmas[k]}
    return graded("rotation_gain", "child", gains[k], **values)


def _turned_world(slow: Regression, stream: str) -> Finding | None:
    """Return the finding about positions turned against the orientations of a stream, or None."""
    rotation_vector, sigmas = slow.fit(f"turned_{stream}")
    angles_rad = np.abs(rotation_vector)
    limits = LIMITS["worlds_turned"]
    noise = np.hypot(
        limits.sigmas * sigmas, BIASES * slow.biases(f"turned_{stream}")
    )
    if (angles_rad < noise).all() or angles_rad.max() < limits.note:
        return None
    turned_rad = float(np.linalg.norm(angles_rad))
    axis = "xyz"[int(np.argmax(angles_rad))]
    turned_deg = float(np.degrees(turned_rad))
    return graded(
        "worlds_turned", stream, turned_rad, axis=axis, turned_deg=turned_deg
    )


class _Deviation(NamedTuple):
    """The axis whose value deviates most from the mean of the values on the two other axes."""

    axis: int
    size: float
    sigma: float


def largest_deviation(values: FloatArray, sigmas: FloatArray) -> _Deviation:
    """Return the axis whose value deviates most significantly from the two other values (3,).

    ``sigmas`` (3,) are the standard deviations of the values.
    """
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


def axis_gain(slow: Regression, stream: str) -> Finding | None:
    """Return the finding that one coordinate has another scale than the other two, or None.

    ``stream`` ("parent" or "child") has this coordinate.
    """
    group = f"axes_{stream}"
    gain = largest_deviation(*slow.fit(group))
    of_noise = slow.biases(group)[gain.axis]
    of_drift = DRIFT_SHARE**2 * of_noise / slow.biases("scale")[0]
    if abs(gain.size) < BIASES * (of_noise + of_drift):
        return None
    size = gain.size
    if slow.explained_share(group) <= _ERROR_SHARE:
        size = min(abs(size), LIMITS["axis_scale"].error)
    values = {
        "axis": "xyz"[gain.axis],
        "factor": 1.0 + gain.size,
        "sigma": gain.sigma,
    }
    return graded("axis_scale", stream, size, gain.sigma, **values)


def moved_mount(change: MountChange, start_ns: int) -> Finding | None:
    """Return the finding that the mount has moved, or None if the change is not significant.

    ``start_ns`` is the first stamp of the recording.
    """
    if change.log_ratio < SIGNIFICANT:
        return None
    sigmas = np.sqrt(np.diag(change.covariance))
    significant = np.where(np.abs(change.xi) > 2.0 * sigmas, change.xi, 0.0)
    moved_m = float(np.linalg.norm(significant[:3]))
    moved_rad = float(np.linalg.norm(significant[3:]))
    # A rotation by 1 rad moves a point 1 m from the sensor by about 1 m.
    size = max(moved_m, moved_rad)
    if change.log_ratio < 2.0 * SIGNIFICANT:
        # The evidence is too weak for an error.
        size = min(size, LIMITS["mount_moved"].error)
    sizes = []
    if moved_m > 0:
        sizes.append(length(moved_m))
    if moved_rad > 0:
        sizes.append(angle(moved_rad))
    at_s = (change.at_ns - start_ns) * 1e-9
    return graded("mount_moved", "both", size, size=listing(sizes), at_s=at_s)


def _world_drift(
    slow: Regression, pose_pairs: PosePairs, speed_m_s: float
) -> Finding | None:
    """Return the finding that the child's world moves in the parent's world, or None.

    The drift is graded as a share of the usual speed of the sensors, ``speed_m_s``.
    """
    drift, sigmas = slow.fit("drift")
    if (np.abs(drift) < LIMITS["world_drift"].sigmas * sigmas).all():
        return None
    positions = se3.translation_of(pose_pairs.Ts_cw_c)
    by_rotation = np.cross(drift[3:], positions - positions.mean(axis=0))
    drift_m_s = np.sqrt(((drift[:3] + by_rotation) ** 2).sum(axis=1).mean())
    share = float(drift_m_s) / max(speed_m_s, 1e-9)
    rad_per_minute = 60 * float(np.linalg.norm(drift[3:]))
    values = {
        "deg_per_minute": float(np.degrees(rad_per_minute)),
        "m_per_minute": 60 * float(np.linalg.norm(drift[:3])),
        "percent": 100 * share,
    }
    return graded("world_drift", "both", share, **values)


@dataclass(frozen=True)
class _Delay:
    """Delay of some quantities of a stream, such as its positions, after its other quantities.

    Attributes
    ----------
    code : str
        Code of the finding.
    late, punctual : str
        The quantities that are late, and the others, in words: "positions", "z coordinates".
    size_s, sigma_s : float
        Delay and its standard deviation, s.
    speed_m_s : float
        Usual speed of the sensor; for one coordinate, the usual speed along its axis.
    explained_share : float
        Share of the squared residuals that the delay explains.
    """

    code: str
    late: str
    punctual: str
    size_s: float
    sigma_s: float
    speed_m_s: float
    explained_share: float

    def finding(self, stream: str, offset_s: float) -> Finding | None:
        """Return the finding, or None if the delay is too small.

        Weaker evidence suffices if the delay equals the clock offset ``offset_s`` (s).
        """
        shift_m = self.size_s * self.speed_m_s
        size_m = shift_m
        sigma_m = self.sigma_s * self.speed_m_s
        # Without an offset, the divisor is 1 s, far above any delay.
        ratio = self.size_s / abs(offset_s or 1.0)
        # A ratio within a third of 1 counts as equality.
        is_expected = abs(ratio - 1.0) < 1.0 - _EXPECTED_SIGMA_SHARE
        if is_expected:
            sigma_m *= _EXPECTED_SIGMA_SHARE
        error_m = LIMITS["late"].error
        is_minor = (
            self.size_s < _ERROR_DELAY_S or self.explained_share < _ERROR_SHARE
        )
        if self._is_always_error(shift_m):
            size_m = max(shift_m, _JUST_ABOVE * error_m)
        elif is_expected or is_minor:
            # Scale the shift and its noise down to the limit, so that the finding is no error.
            factor = min(1.0, error_m / max(shift_m, 1e-9))
            size_m = factor * shift_m
            sigma_m = factor * sigma_m
        values = {
            "delay_s": self.size_s,
            "sigma_s": self.sigma_s,
            "shift_m": shift_m,
            "code": self.code,
            "part": self.late,
            "others": self.punctual,
        }
        return graded("late", stream, size_m, sigma_m, **values)

    def _is_always_error(self, shift_m: float) -> bool:
        """Return whether the delay is an error in any case.

        A large shift is an error even if the delay is expected or explains little. A moderate shift
        is an error if the delay also explains enough of the residuals.
        """
        if self.size_s <= max(
            _ALWAYS_ERROR_S, _ALWAYS_ERROR_SIGMAS * self.sigma_s
        ):
            return False
        if shift_m > LIMITS["late"].error:
            return True
        return (
            shift_m > _ALWAYS_ERROR_SHIFT_M
            and self.explained_share > _ALWAYS_ERROR_SHARE
        )


def delay_suspects(
    fast: Regression, pairs: PosePairs, speed_m_s: float, offset_s: float
) -> Iterator[Suspect]:
    """Yield suspects for positions that are later than the orientations of their stream.

    The delay is estimated for all positions, and for the positions along each axis of the stream's
    world.

    Parameters
    ----------
    fast : Regression
        Regression with the groups of delays.
    pairs : PosePairs
    speed_m_s : float
        Usual speed of the sensors.
    offset_s : float
        Clock offset between the streams.
    """
    for stream, poses in (("child", pairs.Ts_cw_c), ("parent", pairs.Ts_pw_p)):
        smoothing = [f"{quantity}_{stream}" for quantity in _MIN_SMOOTHING_S2]
        all_group = f"late_{stream}"
        axis_group = f"late_axes_{stream}"
        delays_s, sigmas_s = fast.fit(all_group, *smoothing)
        delay_s = float(delays_s[0])
        late = _Delay(
            code="position_clock",
            late="positions" if delay_s > 0 else "orientations",
            punctual="orientations" if delay_s > 0 else "positions",
            size_s=abs(delay_s),
            sigma_s=sigmas_s[0],
            speed_m_s=speed_m_s,
            explained_share=fast.explained_share(all_group, *smoothing),
        )
        # A coordinate that is earlier than the others has a negative delay here, and is skipped
        # below.
        deviation = largest_deviation(*fast.fit(axis_group, *smoothing))
        late_axis = _Delay(
            code="axis_lag",
            late=f"{'xyz'[deviation.axis]} coordinates",
            punctual="others",
            size_s=deviation.size,
            sigma_s=deviation.sigma,
            speed_m_s=usual_speed(
                pairs.stamps_ns, poses[:, [deviation.axis], 3]
            ),
            explained_share=fast.explained_share(axis_group, *smoothing),
        )
        for delay in (late, late_axis):
            if delay.size_s > _MIN_DELAY_S:
                yield Suspect(
                    delay.explained_share, delay.finding(stream, offset_s)
                )


def smoothing_suspects(
    fast: Regression, interval_s: float, speed_m_s: float
) -> Iterator[Suspect]:
    """Yield suspects for a stream in which either the positions or the orientations are smoothed.

    The displacement of the poses decides whether smoothing is an error. The time constant of the
    smoothing times the usual speed decides whether smoothing is a warning.

    Parameters
    ----------
    fast : Regression
        Regression with the groups of smoothing.
    interval_s : float
        Interval between poses.
    speed_m_s : float
        Usual speed of the sensors.
    """
    interpolation_s2 = _INTERPOLATION_SHARE * interval_s**2
    limits = LIMITS["smoothed"]
    for quantity, min_smoothing_s2 in _MIN_SMOOTHING_S2.items():
        for stream in _STREAMS:
            group = f"{quantity}_{stream}"
            delay = f"late_{stream}"
            coefficients, sigmas = fast.fit(group, delay)
            smoothing_s2 = float(coefficients[0])
            noise_s2 = limits.sigmas * float(sigmas[0])
            if smoothing_s2 < max(
                min_smoothing_s2 + interpolation_s2, noise_s2
            ):
                continue
            smoothing_s = smoothing_s2**0.5
            displaced_m = smoothing_s2 * float(fast.displacements_m(group)[0])
            shift_m = max(
                displaced_m, min(smoothing_s * speed_m_s, limits.error)
            )
            smoothed = graded(
                "smoothed",
                stream,
                shift_m,
                part=quantity,
                smoothing_s=smoothing_s,
                shift_m=displaced_m,
            )
            yield Suspect(fast.explained_share(group, delay), smoothed)
