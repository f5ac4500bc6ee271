"""Checks of rotations or angular rates of two sensors.

The regression of :mod:`~hand_eye_calib.extras.partial.rotation_columns` detects wrong gains,
misaligned axes and smoothing. Other checks detect wrong conventions, copies, a moved mount, and
rates that are clipped, coarse, or have a bias that drifts.
"""

from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.covariance import BLOCKS
from hand_eye_calib.core.assessment.moved import find_change
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.base.text import angle
from hand_eye_calib.core.checks import agreement
from hand_eye_calib.core.checks.findings import (
    Finding,
    Severity,
    finding,
    graded,
)
from hand_eye_calib.core.checks.stream_pair import MAX_ROTATION_RAD, MIN_PAIRS
from hand_eye_calib.core.checks.streams import check_flat
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.noise.increments import without_rate_bias
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    pairs_over,
    synchronise,
)
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.solvers.all_pairs import align_rotation_vectors
from hand_eye_calib.extras.partial.copies import COPIED_SHARE, as_errors, copied
from hand_eye_calib.extras.partial.rotation_columns import (
    PLANES,
    RotationFit,
    fit_pairs,
)
from hand_eye_calib.extras.partial.suspects import Suspect, most_significant

# Rotations with a smaller median residual (rad) were computed from those of the other stream. It
# corresponds to quaternions with five digits.
_COPIED_RAD = 2e-5

# Rates were computed from the orientations if the residual of a window (rad) is below this. Copies
# have 7e-5; the most accurate odometries and gyroscopes in the study of faults have 5e-4.
_COPIED_RATES_RAD = 1e-4

# Largest number of compared motions. It limits the time.
_MOST_MOTIONS = 3000

# Rates have left-handed axes if the residual after the best reflection is below this share of the
# residual after the best rotation. For noise alone, both are about equal.
_MIRRORED = 0.5
# For left-handed axes, the residual of the best rotation must exceed this share of the rotation
# vectors. If all motion is about one axis, a reflection only changes the sign of the noise about
# the other axes.
_UNMIRRORED = 0.06
# Duration (s) of the motions with these rotation vectors. Only short rotation vectors are mirrored
# as rates are. Rotation vectors of motions of 1 s are too long.
_MIRRORED_S = 0.5

# Orientations are inverted only if the inversion leaves at most this share of the rotation
# unexplained.
_MAX_UNEXPLAINED = 0.1
# Smallest ratio of the unexplained shares: without the inversion, divided by with the inversion.
_DECISIVE = 3.0

# Largest relative deviation from 57.3 of a ratio of rates whose units are degrees and radians.
_UNIT_WITHIN = 0.2
#: Quantile of the rates or rotation angles that is compared. It is high, because a sensor may rest
#: for a long time.
TURNING = 0.75

# Smoothing is clear above this number of standard deviations. A jackknife of at most 16 blocks
# estimates them, so the ratio has heavy tails.
_CLEAR_SIGMAS = 4.0
# Smallest smoothing (s^2) that is reported: the effect of a filter of 63 ms. Without a filter,
# EuRoC, KITTI and machines simulated with seeds 77 and 78 have up to 0.0012.
_SMOOTHING_S2 = 0.004

# Rates are coarse if the number of different values, divided by the number of rates, is below this.
_FEW_LEVELS = 0.1
# A sensor that turns has at least this number of different rates.
_LEAST_LEVELS = 5
# Rounding of integrated rates (rad/s).
_ROUNDING_RAD_S = 1e-9
# Smallest step of coarse rates (rad/s). A gyroscope with 16 bits has steps of 0.001.
_STEP_RAD_S = 0.005

# Rounding (deg) of angles that are computed from rotation matrices.
_ROUNDING_DEG = 1e-6
# Smallest step (deg) of coarse orientations.
_STEP_DEG = 0.2

# Fewest clipped rates. A clipped rate equals the largest rate.
_LEAST_CLIPPED = 20
# Rates are not clipped if more rates than the clipped ones are below the largest rate by at most
# this share.
_NEAR_LIMIT = 0.02

# Largest usual standard deviation (rad/s) of the bias between parts of a recording. Rates against
# monocular odometries of EuRoC have up to 0.14 deg/s.
_BIAS_DRIFT_RAD_S = float(np.radians(0.15))


class _Streams(NamedTuple):
    """Streams of rotations, each on its own clock, and their pairs on a common clock.

    Attributes
    ----------
    parent, child : Trajectory
    pairs : PosePairs
    name : {"parent", "child"}
        The stream to which faults are attributed: the stream with rates, if there is one.
    has_rates : bool
        Whether this stream has rates.
    are_exact : bool
        Whether the user declared both streams as exact. Exact streams may agree up to rounding.
    """

    parent: Trajectory
    child: Trajectory
    pairs: PosePairs
    name: str
    has_rates: bool
    are_exact: bool

    @property
    def measured(self) -> Trajectory:
        """The stream to which faults are attributed."""
        return self.child if self.name == "child" else self.parent


def measured_stream(parent_measures: str, child_measures: str) -> str:
    """Return the stream to which faults are attributed: the one with fewer measured quantities.

    In the node, a stream whose option is ``auto`` has poses.
    """
    order = ("rates", "rotations", "poses", "auto")
    is_parent = order.index(parent_measures) < order.index(child_measures)
    return "parent" if is_parent else "child"


def check_solved(
    parent: Trajectory,
    child: Trajectory,
    calibration: Calibration,
    config: CalibratorConfig,
    is_unrelated: bool = False,
) -> list[Finding]:
    """Check rotations or rates against their result. Return the findings of the first failed check.

    Parameters
    ----------
    parent, child : Trajectory
        Streams, each on its own clock.
    calibration : Calibration
        The result from both streams.
    config : CalibratorConfig
        The options of that result.
    is_unrelated : bool
        Whether one stream does not explain the other.

    Returns
    -------
    list of Finding
    """
    pairs = synchronise(
        parent, child.shifted(calibration.time_offset_s), config.max_gap
    )
    if len(pairs) < MIN_PAIRS:
        return []
    name = measured_stream(parent.measures, child.measures)
    has_rates = "rates" in (parent.measures, child.measures)
    are_exact = config.parent_kind == config.child_kind == "exact"
    streams = _Streams(parent, child, pairs, name, has_rates, are_exact)
    findings = _check_reading(streams)
    if findings or is_unrelated:
        return findings or _check_handedness(streams)
    rotation = se3.rotation_of(calibration.T_parent_child)
    sigmas = calibration.sigmas_measured[3:]
    parallel = check_rotation(rotation, sigmas, {*config.prior()}, has_rates)
    if copy := _copied_rotations(pairs, rotation):
        return as_errors(parallel) or copy
    findings = parallel or _check_handedness(streams) or _check_levels(streams)
    if findings:
        return findings
    streams = streams._replace(pairs=_without_bias(pairs, calibration))
    return _check_mount(streams.pairs, rotation) or _check_response(
        streams, rotation
    )


def _check_reading(streams: _Streams) -> list[Finding]:
    """Detect streams with another convention or unit than assumed, or with yaw only."""
    flat = check_flat(streams.parent.scaled(0.0), streams.child.scaled(0.0))
    return flat or _check_unit(streams) or _check_conventions(streams)


def _without_bias(pairs: PosePairs, calibration: Calibration) -> PosePairs:
    """Remove the estimated gyroscope bias from pose pairs."""
    rate_bias = calibration.parts.get("rate_bias")
    if not rate_bias:
        return pairs
    bias = np.array(rate_bias.rad_per_s)
    if rate_bias.of == "parent":
        return replace(
            pairs,
            Ts_pw_p=without_rate_bias(pairs.stamps_ns, pairs.Ts_pw_p, bias),
        )
    return replace(
        pairs, Ts_cw_c=without_rate_bias(pairs.stamps_ns, pairs.Ts_cw_c, bias)
    )


def check_rotation(
    rotation: FloatArray,
    sigmas: FloatArray,
    priors: Collection[str],
    has_rates: bool,
) -> list[Finding]:
    """Detect a rotation of zero, a sign that both streams come from one sensor.

    Parameters
    ----------
    rotation : (3, 3) array
    sigmas : (3,) array
        Standard deviations (rad). Unobservable axes have infinite values.
    priors : collection of str
        Axes with a prior. With a prior about any rotation, there is no check.
    has_rates : bool
        Whether a stream has rates. The finding is then an error. Otherwise it is a warning, because
        the axes of two cameras may well be parallel.
    """
    if {"roll", "pitch", "yaw"} & {*priors}:
        return []
    # The standard deviations must be small on all axes. If two level sensors turn only about the
    # vertical, yaw is unobservable, and roll and pitch are zero for any two sensors.
    if not sigmas.max() < agreement.MAX_SIGMA_RAD:
        return []
    angles_rad = np.abs(se3.rotation_log(rotation))
    limits_rad = np.maximum(agreement.SAME_RAD, agreement.ZERO_SIGMAS * sigmas)
    if (angles_rad > limits_rad).any():
        return []
    angle_rad = float(np.linalg.norm(angles_rad))
    severity = Severity.ERROR if has_rates else Severity.WARNING
    return [
        finding(
            "parallel_axes",
            "both",
            severity,
            size=angle(angle_rad),
            angle_rad=angle_rad,
        )
    ]


def _copied_rotations(pairs: PosePairs, rotation: FloatArray) -> list[Finding]:
    """Detect rotations that were computed from the other stream: the difference is rounding."""
    of_parent, of_child = _rotation_vectors(pairs)
    if len(of_parent) < MIN_PAIRS:
        return []
    residual_rad = median(
        np.linalg.norm(of_child @ rotation.T - of_parent, axis=1)
    )
    usual_rad = median(np.linalg.norm(of_parent, axis=1))
    if residual_rad > min(_COPIED_RAD, COPIED_SHARE * usual_rad):
        return []
    return copied(
        "The rotations of both streams agree to rounding",
        residual_rad=residual_rad,
    )


def _rotation_vectors(
    pairs: PosePairs, lag_s: float = agreement.SHORT_S
) -> tuple[FloatArray, FloatArray]:
    """Return rotation vectors (K, 3) of both sensors over a time, each in its own frame."""
    return _usable_vectors(pairs_over(pairs, lag_s, _MOST_MOTIONS))


def _usable_vectors(motions: MotionPairs) -> tuple[FloatArray, FloatArray]:
    """Return rotation vectors (K, 3) of the motions of parent and child with a clear axis."""
    of_parent = se3.rotation_log(se3.rotation_of(motions.Ts_parenti_parentj))
    of_child = se3.rotation_log(se3.rotation_of(motions.Ts_childi_childj))
    angles = np.maximum(
        np.linalg.norm(of_parent, axis=1), np.linalg.norm(of_child, axis=1)
    )
    is_usable = angles < MAX_ROTATION_RAD
    return of_parent[is_usable], of_child[is_usable]


def _check_unit(streams: _Streams) -> list[Finding]:
    """Detect rates of one stream in degrees per second and of the other in radians."""
    if not streams.has_rates:
        return []
    other = streams.parent if streams.name == "child" else streams.child
    ratio = _large_rate(streams.measured) / _large_rate(other)
    degrees = float(np.degrees(1.0))
    if (
        min(abs(ratio / degrees - 1.0), abs(ratio * degrees - 1.0))
        >= _UNIT_WITHIN
    ):
        return []
    unit, read_as = ("deg/s", "rad/s") if ratio > 1.0 else ("rad/s", "deg/s")
    return [
        finding(
            "rate_unit", streams.name, ratio=ratio, unit=unit, read_as=read_as
        )
    ]


def _rates(stream: Trajectory) -> FloatArray:
    """Return the angular rates (N - 1, 3) between successive rotations of a stream, rad/s."""
    rotations = se3.rotation_of(stream.poses)
    turns = se3.rotations_between(rotations[:-1], rotations[1:])
    return turns / (np.diff(stream.stamps_ns) * 1e-9)[:, None]


def _large_rate(stream: Trajectory) -> float:
    """Return a large quantile of the angular rates of a stream, rad/s. It is above zero."""
    rates = np.linalg.norm(_rates(stream), axis=1)
    return max(float(np.quantile(rates, TURNING)), 1e-12)


def _check_conventions(streams: _Streams) -> list[Finding]:
    """Detect orientations of one stream that are inverted, or quaternions in another order.

    Rotations do not reveal which of both mistakes: w x y z that are read as x y z w invert the
    rotations and turn both frames. Without rates, they do not reveal the stream, either.
    """
    pairs = streams.pairs
    inverted = replace(
        pairs, Ts_pw_p=se3.put_right(pairs.Ts_pw_p, invert="orientations")
    )
    if streams.name == "parent":
        inverted = replace(
            pairs, Ts_cw_c=se3.put_right(pairs.Ts_cw_c, invert="orientations")
        )
    share = _unexplained(inverted)
    if share > min(_MAX_UNEXPLAINED, _unexplained(pairs) / _DECISIVE):
        return []
    if not streams.has_rates:
        return [finding("inverse_rotations", "both", name="one stream")]
    stream = "child" if streams.name == "parent" else "parent"
    return [finding("inverse_rotations", stream, name=f"the {stream}")]


def _unexplained(pairs: PosePairs) -> float:
    """Return the share of the rotations that the best extrinsic rotation leaves unexplained."""
    motions = pairs_over(pairs, agreement.SHORT_S, _MOST_MOTIONS)
    of_parent, of_child = _usable_vectors(motions)
    residuals = of_child @ align_rotation_vectors(motions).T - of_parent
    usual_rad = max(median(np.linalg.norm(of_parent, axis=1)), 1e-12)
    return median(np.linalg.norm(residuals, axis=1)) / usual_rad


def _check_handedness(streams: _Streams) -> list[Finding]:
    """Detect rates about left-handed axes: a reflection fits far better than any rotation."""
    of_parent, of_child = _rotation_vectors(streams.pairs, _MIRRORED_S)
    if len(of_parent) < BLOCKS * MIN_PAIRS:
        return []
    # The mean contains the bias. Subtract it, because a wrong rotation makes the estimate of the
    # bias wrong.
    of_parent = of_parent - of_parent.mean(axis=0)
    of_child = of_child - of_child.mean(axis=0)
    left, _, right = np.linalg.svd(of_child.T @ of_parent)
    rotating = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    mirroring = rotating * [1.0, 1.0, -1.0]
    residuals_rad = []
    for signs in (rotating, mirroring):
        errors = of_child @ left @ signs @ right - of_parent
        residuals_rad.append(median(np.linalg.norm(errors, axis=1)))
    by_rotation, by_mirror = residuals_rad
    usual = median(np.linalg.norm(of_parent, axis=1))
    is_mirrored = (
        by_mirror < _MIRRORED * by_rotation
        and by_rotation > _UNMIRRORED * usual
    )
    return [finding("mirrored_rates", streams.name)] if is_mirrored else []


def _check_levels(streams: _Streams) -> list[Finding]:
    """Detect coarse orientations, and rates that have coarse steps or are clipped at a limit."""
    if not streams.has_rates:
        return _check_coarse_orientations(streams)
    rates = _rates(streams.measured)
    for axis, column in zip("xyz", rates.T, strict=True):
        steps = _coarse_steps(column, _ROUNDING_RAD_S)
        if steps is not None:
            # A mean of two rates has half of the step.
            step_rad_s = 2.0 * median(steps)
            if step_rad_s > _STEP_RAD_S:
                return [
                    finding("coarse_rates", streams.name, step_rad_s=step_rad_s)
                ]
            continue
        sizes = np.abs(column)
        limit = sizes.max()
        n_clipped = int((sizes > limit - _ROUNDING_RAD_S).sum())
        n_near = int((sizes > (1.0 - _NEAR_LIMIT) * limit).sum()) - n_clipped
        if n_clipped >= max(_LEAST_CLIPPED, n_near):
            clipped = finding(
                "clipped_rates",
                streams.name,
                axis=axis,
                share=n_clipped / len(column),
                limit_deg_s=float(np.degrees(limit)),
            )
            return [clipped]
    return []


def _coarse_steps(values: FloatArray, rounding: float) -> FloatArray | None:
    """Return the differences between neighbouring levels of values (N,), or None.

    The result is None if the values have as many levels as a sensor with fine resolution, or so few
    that the sensor does not turn. Values that differ by less than ``rounding`` count as one level.
    """
    levels = np.unique(np.round(values / rounding)) * rounding
    if _LEAST_LEVELS <= len(levels) < _FEW_LEVELS * len(values):
        return np.diff(levels)
    return None


def _check_coarse_orientations(streams: _Streams) -> list[Finding]:
    """Detect orientations whose roll, pitch or yaw changes in coarse steps."""
    for name, stream in (("parent", streams.parent), ("child", streams.child)):
        angles_deg = np.degrees(
            se3.rotation_to_rpy(se3.rotation_of(stream.poses))
        )
        for column in angles_deg.T:
            steps_deg = _coarse_steps(column, _ROUNDING_DEG)
            if steps_deg is None:
                continue
            step_deg = median(steps_deg)
            are_equal = np.abs(steps_deg - step_deg) < 10.0 * _ROUNDING_DEG
            if step_deg > _STEP_DEG and are_equal.mean() > 0.5:
                return [finding("coarse_orientations", name, step_deg=step_deg)]
    return []


def _check_mount(pairs: PosePairs, rotation: FloatArray) -> list[Finding]:
    """Detect a mount that has moved."""
    if len(_rotation_vectors(pairs)[0]) < BLOCKS * MIN_PAIRS:
        return []
    still = np.zeros(3)
    turning = PosePairs(
        pairs.stamps_ns,
        se3.from_rotation_translation(se3.rotation_of(pairs.Ts_pw_p), still),
        se3.from_rotation_translation(se3.rotation_of(pairs.Ts_cw_c), still),
    )
    change = find_change(
        turning, se3.from_rotation_translation(rotation, still)
    )
    moved = (
        agreement.moved_mount(change, int(pairs.stamps_ns[0]))
        if change
        else None
    )
    return [moved] if moved else []


def _check_response(streams: _Streams, rotation: FloatArray) -> list[Finding]:
    """Detect the most significant fault in the regression on all faults."""
    fitted = fit_pairs(streams.pairs, rotation, streams.name, streams.has_rates)
    if not fitted:
        return [finding("unchecked_rotations", streams.name)]
    if (
        streams.has_rates
        and not streams.are_exact
        and fitted.remaining < _COPIED_RATES_RAD
    ):
        evidence = "The rates agree with the orientations of the other sensor"
        return copied(evidence, residual_rad=fitted.remaining)
    suspects = [_smoothing(fitted, streams), _gain(fitted, streams)]
    # The errors of a gyroscope are about its own axes. An attitude sensor also has errors about the
    # vertical.
    of_kind = _shear if streams.has_rates else _main_gain
    suspects.append(of_kind(fitted, streams))
    findings = most_significant(suspects)
    if (
        findings
        or not streams.has_rates
        or fitted.bias_drift < _BIAS_DRIFT_RAD_S
    ):
        return findings
    return [
        finding(
            "bias_drift",
            streams.name,
            deg_s=float(np.degrees(fitted.bias_drift)),
        )
    ]


def _smoothing(fitted: RotationFit, streams: _Streams) -> Suspect:
    """Return the test whether one stream is smoothed more than the other."""
    values, sigmas = fitted.estimate("smoothing")
    smoothing_s2 = float(values[0])
    n_sigmas = abs(smoothing_s2) / max(float(sigmas[0]), 1e-12)
    if abs(smoothing_s2) < _SMOOTHING_S2 or n_sigmas < _CLEAR_SIGMAS:
        return Suspect(n_sigmas, None)
    name = streams.name
    if smoothing_s2 < 0.0:
        name = "parent" if name == "child" else "child"
    stream = streams.child if name == "child" else streams.parent
    part = "rates" if stream.measures == "rates" else "orientations"
    seconds = abs(smoothing_s2) ** 0.5
    return Suspect(
        n_sigmas,
        finding("smoothed_rotations", name, part=part, smoothing_s=seconds),
    )


class _Largest(NamedTuple):
    """The most significant of the three values of a fault."""

    place: int
    value: float
    sigma: float


def _largest(fitted: RotationFit, name: str) -> _Largest | None:
    """Return the most significant value of a fault that noise in the columns does not explain.

    The columns are integrals of rates, so they contain the noise of the orientations.
    """
    values, sigmas = fitted.estimate(name)
    is_real = np.abs(values) > agreement.BIASES * fitted.biases(name)
    n_sigmas = np.where(is_real, np.abs(values) / sigmas, 0.0)
    place = int(np.argmax(n_sigmas))
    if not is_real[place]:
        return None
    return _Largest(place, float(values[place]), float(sigmas[place]))


def _gain(fitted: RotationFit, streams: _Streams) -> Suspect:
    """Return the test whether the rates about an axis of the sensor are too large or too small."""
    largest = _largest(fitted, "gains")
    if not largest:
        return Suspect(0.0, None)
    place, gain, sigma = largest
    values = {"axis": "xyz"[place], "gain": 1.0 + gain, "sigma": sigma}
    return Suspect(
        abs(gain) / sigma,
        graded("gain_of_axis", streams.name, gain, sigma, **values),
    )


def _main_gain(fitted: RotationFit, streams: _Streams) -> Suspect:
    """Return the test whether rotations about the main axis are too large or too small."""
    gain, sigma, bias = fitted.main_gain()
    if abs(gain) <= agreement.BIASES * bias:
        return Suspect(0.0, None)
    values = {"axis": "main", "gain": 1.0 + gain, "sigma": sigma}
    return Suspect(
        abs(gain) / sigma,
        graded("gain_of_axis", streams.name, gain, sigma, **values),
    )


def _shear(fitted: RotationFit, streams: _Streams) -> Suspect:
    """Return the test whether two axes of a gyroscope are not perpendicular."""
    largest = _largest(fitted, "shears")
    if not largest:
        return Suspect(0.0, None)
    place, shear, sigma = largest
    first, second = ("xyz"[axis] for axis in PLANES[place])
    degrees = float(np.degrees(2.0 * abs(shear)))
    axes = f"{first} and {second}"
    issue = graded(
        "misaligned", streams.name, shear, sigma, axes=axes, degrees=degrees
    )
    return Suspect(abs(shear) / sigma, issue)
