"""Kind of data "vehicle": wheels and a sensor with poses, or such a sensor alone.

A kind supplies the functions that solve and check its data, see :mod:`..core.engine.kinds`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hand_eye_calib.core.assessment import common_mode, covariance
from hand_eye_calib.core.assessment.moved import SIGNIFICANT
from hand_eye_calib.core.assessment.prior import fuse
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.registry import OUT_OF_REACH
from hand_eye_calib.core.base.stats import quantile
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import (
    Finding,
    Severity,
    finding,
    gravest_first,
)
from hand_eye_calib.core.checks.streams import check_stream
from hand_eye_calib.core.engine import estimation
from hand_eye_calib.core.engine.kinds import Kind
from hand_eye_calib.core.engine.snapshot import MOST_MOVED_S, Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import AXES, Residuals
from hand_eye_calib.extras.vehicle.drive import CLOCK, TILT, YAW, Drive, Y
from hand_eye_calib.extras.vehicle.parameters import (
    VehicleParameter,
    VehicleParameters,
)
from hand_eye_calib.extras.vehicle.solving import (
    BLOCKS,
    N_FIXED,
    Fit,
    fit_drive,
)
from hand_eye_calib.extras.vehicle.wheels import MODELS, RIVALS, steps_of

# Duration (s) of a window if there are wheel data.
_WINDOW_S = 0.5
# Duration (s) of a window without wheel data. The curvature in it must be nearly constant.
_WINDOW_ALONE_S = 0.3

# Quantile of the motions, or of their deviations, that counts as their usual size.
_USUAL = 0.9
# A vehicle that moves by less than this share of its usual motion is at rest in a window.
_AT_REST = 0.05

# Poses are two-dimensional if they move by less than this (m, rad) across the plane. Smaller motion
# is rounding.
_FLAT = 1e-6
# By rounding, poses at the start of a window may be early by this time (s).
_ROUNDING_S = 1e-6

# The drive determines an axis if its information exceeds the information in noise by this factor.
# Measured: at least 168 in simulated figures of eight, below 2 on straight roads and on a single
# circle.
_MIN_SIGNAL_TO_NOISE = 10.0

# A fifth of the drive contains most of the information on an axis if the variance without this
# fifth is larger by this factor. Measured: below 2 in figures of eight, above 5 with a single bend.
_MAX_CONCENTRATION = 4.0

# Wheels and sensor are probably from different drives if they disagree in more than this share of
# the forward motion or of the turns. Measured: 0.02 in simulated drives with slip.
_UNRELATED = 0.1
# The result is unusable if they disagree in more than this share.
_UNUSABLE = 0.3
# Largest standard deviation (s) of the clock offset: three quarters of its prior. Measured: at most
# 12 ms if the wheels slip for 30 % of the time, 83 ms if the clocks differ by 3 s, up to 300 ms for
# an articulated machine, which no model describes.
_MAX_CLOCK_SIGMA_S = 0.15

# The two halves of a drive contradict each other above this number of joint standard deviations.
_MAX_SIGMAS_OF_HALVES = 3.3

# A vehicle always drives the same curve if the turns (rad) of its windows usually deviate from a
# constant curvature by less than this ...
_VARIED_TURN = 0.02
# ... or by less than this share of the turns (root mean squares). Measured: 0.35 to 0.5 in
# simulated figures of eight, at most 0.25 on the spot.
_VARIED_SHARE = 0.3

# A vehicle turns on the spot if its unit vehicle travels less than this length per radian.
_ON_THE_SPOT = 0.2

# Usual radii of wheels (m), from a small robot to a truck.
_USUAL_RADII_M = (0.02, 1.25)
# Parameters with which the radius of a wheel is compared.
_LENGTHS = ("wheel_separation", "wheelbase")
# Usual radii as shares of these lengths: from 0.08 (bus) and 0.11 (car, TurtleBot) to 0.5
# (tractor). With a speed in rpm, a usual wheel seems to be too small by a factor of 9.5.
_USUAL_RADII = (0.055, 0.8)
# Usual multipliers of a wheel odometry. They allow a wrong radius, but not another unit.
_USUAL_MULTIPLIERS = (0.5, 2.0)
# Usual log ratio of two radii: tyre pressure, wear and load change a radius by some per cent.
_USUAL_DEVIATION = 0.1
# Units of speed, and the factor from a number in this unit to the right value.
_UNITS = {
    "rpm": np.pi / 30.0,
    "deg/s": np.pi / 180.0,
    "revolutions/s": 2.0 * np.pi,
    "km/h": 1.0 / 3.6,
    "mm/s": 1e-3,
}

# Options without an effect on vehicles, and their accepted values.
_ALLOWED: dict[str, tuple[object, ...]] = {
    "method": ("auto", "adaptive"),
    "reference": ("auto",),
    "backend": ("fast",),
    "threshold": (CalibratorConfig.threshold,),
    "min_inlier_fraction": (CalibratorConfig.min_inlier_fraction,),
    "scale": ("none", "auto"),
    "parent_scale": (1.0,),
    "parent_kind": ("odometry",),
}


def _solve(snapshot: Snapshot, cross_check: bool | None) -> Calibration:
    """Estimate the pose of the sensor on the vehicle. The caller adds the frame names.

    ``cross_check`` has no effect.

    Raises
    ------
    NotEnoughDataError
        If the vehicle moves for too short a time.
    """
    config = snapshot.config
    wheels, _ = snapshot.streams
    pairs = snapshot.pose_pairs
    offset_s = config.given_time_offset_s
    window_s = (
        _WINDOW_ALONE_S if config.parent_measures == "driving" else _WINDOW_S
    )
    if "time_offset" not in config.given and snapshot.correlation.is_clear:
        offset_s = snapshot.correlation.offset_s
    drive = _drive(pairs, wheels, config, offset_s, window_s)
    if len(drive.xi) < 3 * BLOCKS:
        raise NotEnoughDataError(
            f"the vehicle moves for {len(drive.xi) * window_s:.0f} s while both streams have data; "
            f"at least {3 * BLOCKS * window_s:.0f} s are needed: drive figures of eight"
        )
    fixed = []
    if _is_clock_fixed(drive, config):
        fixed.append(CLOCK)
    if drive.model is None:
        fixed.append(Y)
    if _is_flat(drive):
        fixed += TILT
    # The same drive in longer windows. Its difference from the fit enlarges the covariance.
    longer = _drive(pairs, wheels, config, offset_s, 2.0 * window_s)
    fit = fit_drive(drive, longer, fixed)
    findings = _check_fit(fit, drive, config)
    rival = RIVALS.get(config.parent_measures)
    if rival:
        model = MODELS[rival]
        other = fit_drive(
            replace(drive, model=model), replace(longer, model=model), fixed
        )
        if _log_ratio(other, fit) > SIGNIFICANT:
            # This finding is the cause of all others, so it replaces them.
            findings = (finding(f"speed_of_{rival}"),)
    return _calibration(fit, findings, drive, pairs, offset_s, config)


def _log_ratio(fit: Fit, other: Fit) -> float:
    """Return the log likelihood ratio of two fits of the same windows: positive for the first."""
    volumes = [np.linalg.slogdet(item.noise)[1] for item in (other, fit)]
    return 0.5 * len(fit.weights) * float(np.subtract(*volumes))


def _drive(
    pairs: PosePairs,
    wheels: Trajectory,
    config: CalibratorConfig,
    offset_s: float,
    window_s: float,
) -> Drive:
    """Return the motions of the sensor in windows, and the wheel data.

    Windows at rest, and windows with a gap, are skipped. ``offset_s`` is the clock offset of the
    sensor.
    """
    start_ns = pairs.stamps_ns[0]
    times_s = np.asarray((pairs.stamps_ns - start_ns) * 1e-9, dtype=float)
    begin_s = np.arange(0.0, times_s[-1], window_s)
    # Indices of the poses at the ends of the windows.
    ends = np.unique(np.searchsorted(times_s, begin_s - _ROUNDING_S))
    poses = pairs.Ts_cw_c[ends]
    xi = se3.log(se3.inverse(poses[:-1]) @ poses[1:])
    lengths = np.linalg.norm(xi[:, :3], axis=1)
    turns = np.linalg.norm(xi[:, 3:], axis=1)
    is_moving = lengths > _AT_REST * quantile(lengths, _USUAL)
    is_turning = turns > _AT_REST * quantile(turns, _USUAL)
    has_no_gap = np.diff(times_s[ends]) < window_s + config.max_gap
    is_used = (is_moving | is_turning) & has_no_gap
    xi = xi[is_used]
    # The stamps of the pairs already contain the clock offset of the options.
    clock_s = times_s[ends] + offset_s - config.given_time_offset_s
    model = MODELS.get(config.parent_measures)
    # Without wheels, forward motion and turns have no measurement. Two-dimensional poses have no
    # upward motion, roll or pitch.
    components = [1, 2, 3, 4] if model is None else [0, 1, 2, 3, 4, 5]
    if np.abs(xi[:, 2:5]).max(initial=0.0) < _FLAT:
        components = [index for index in components if index not in (2, 3, 4)]
    return Drive(
        xi=xi,
        ends_s=np.stack([clock_s[:-1], clock_s[1:]])[:, is_used],
        stamps_s=np.asarray((wheels.stamps_ns - start_ns) * 1e-9, dtype=float),
        steps=steps_of(wheels),
        model=model,
        components=components,
    )


def _is_clock_fixed(drive: Drive, config: CalibratorConfig) -> bool:
    """Return whether the clock offset is not estimated: it is given, or there are no wheels."""
    return drive.model is None or "time_offset" in config.given


def _is_flat(drive: Drive) -> bool:
    """Return whether the poses of the sensor are two-dimensional."""
    return 2 not in drive.components


# ---- result


def _calibration(
    fit: Fit,
    findings: tuple[Finding, ...],
    drive: Drive,
    pairs: PosePairs,
    offset_s: float,
    config: CalibratorConfig,
) -> Calibration:
    """Return the result for a fit and its findings: pose, parameters of the wheels, clock offset.

    ``offset_s`` is the clock offset with which the drive was made. The fit estimates its remainder.
    """
    kind = "vehicle" if drive.model else "vehicle_alone"
    if _is_flat(drive):
        kind += "_2d"
    unknown_axes = OUT_OF_REACH[kind]
    if any(item.makes_unusable for item in findings):
        unknown_axes = AXES
    fused = fuse(_assessed(fit, unknown_axes), config.prior())
    clock_sigma_s = 0.0
    if not _is_clock_fixed(drive, config):
        clock_sigma_s = float(np.sqrt(fit.covariance[CLOCK, CLOCK]))
    result = estimation.calibration_of(
        fit,
        fused,
        _residuals_of(fit, drive, int(pairs.stamps_ns[0])),
        pairs.stamps_ns,
        config,
        reference="windows",
        measured=kind,
        T_method=fit.T_base_sensor,
        covariance_allowance=fused.allowance(_allowance(pairs, config)),
        time_offset_s=offset_s + float(fit.others[0]),
        time_offset_sigma_s=clock_sigma_s,
        findings=findings,
    )
    if drive.model is None or unknown_axes == AXES:
        return result
    sigmas = np.sqrt(np.diag(fit.covariance))[N_FIXED:]
    values = fit.others[N_FIXED - CLOCK :]
    parameters = map(
        VehicleParameter, drive.model.names, values.tolist(), sigmas.tolist()
    )
    wheels = VehicleParameters(
        tuple(parameters),
        # The same share is in the reason of the verdict.
        slip_share=1.0 - result.n_inliers / max(result.n_pairs, 1),
        measures=config.parent_measures,
        nominal_radius_m=config.nominal_radius,
        nominal_separation_m=config.nominal_separation,
    )
    result = replace(
        result,
        findings=result.findings + _check_size(wheels),
        warnings=result.warnings + _note_on_identity(result),
    )
    return result.with_part("wheels", wheels)


def _note_on_identity(result: Calibration) -> tuple[str, ...]:
    """Return a note if the sensor seems to be at the origin of the vehicle, with its axes."""
    x, y, _, _, _, yaw = se3.xyz_rpy(result.T_parent_child)
    is_near = np.hypot(x, y) < result.target_translation
    if not is_near or abs(yaw) > result.target_rotation:
        return ()
    return (
        "x, y and yaw are 0 within the targets: are the poses odometry of these wheels? Then give "
        "the poses of another sensor",
    )


def _check_size(wheels: VehicleParameters) -> tuple[Finding, ...]:
    """Return the finding about a wheel of unusual size; empty if the size is usual."""
    # A wheel odometry has a multiplier of the radius, or of the forward motion.
    size = wheels.radius or wheels.parameters[0].value
    nominal = wheels.nominal_radius_m
    if nominal:
        # A multiplier is the ratio itself. Only a radius in m is divided by the nominal radius.
        is_in_m = wheels.radius != 0.0 and not wheels.is_factor
        ratio = size / nominal if is_in_m else size
        if abs(np.log(ratio)) < _USUAL_DEVIATION:
            return ()
        return (
            finding(
                "radius_not_nominal",
                radius=ratio * nominal,
                ratio=ratio,
                nominal=nominal,
                cause=_cause_of(ratio),
            ),
        )
    if wheels.radius:
        if _is_usual_radius(wheels):
            return ()
        return (finding("unusual_radius", radius=size),)
    lowest, highest = _USUAL_MULTIPLIERS
    if lowest <= size <= highest:
        return ()
    return (finding("unusual_multiplier", ratio=size, cause=_cause_of(size)),)


def _is_usual_radius(wheels: VehicleParameters) -> bool:
    """Return whether the radius of the wheels is usual, also beside their track or wheelbase."""
    lowest, highest = _USUAL_RADII_M
    if not lowest <= wheels.radius <= highest:
        return False
    if wheels.is_factor:
        return True
    for parameter in wheels.parameters:
        if parameter.name in _LENGTHS:
            lowest, highest = _USUAL_RADII
            return (
                lowest * parameter.value
                <= wheels.radius
                <= highest * parameter.value
            )
    return True


def _cause_of(ratio: float) -> str:
    """Return the likely cause of a radius that is wrong by the factor ``ratio``."""
    for unit, factor in _UNITS.items():
        if abs(np.log(ratio / factor)) < _USUAL_DEVIATION:
            return f"speeds in {unit}"
    return "a gear ratio, ticks of an encoder, or lengths of the sensor that are not metres"


def _assessed(fit: Fit, unknown_axes: Sequence[str]) -> covariance.Assessment:
    """Return the pose of a fit with its covariance. Unknown axes are marked."""
    T = fit.T_base_sensor
    without_z = fit.covariance[:CLOCK, :CLOCK]
    # Covariance (6, 6) of the pose in the axes of the vehicle. Row and column of z are 0, because z
    # is an unknown axis.
    in_base = np.insert(np.insert(without_z, 2, 0.0, axis=0), 2, 0.0, axis=1)
    to_child = se3.block_diagonal(se3.rotation_of(T).T)
    unknown = to_child[:, [AXES.index(axis) for axis in unknown_axes]]
    return covariance.combined(T, to_child @ in_base @ to_child.T, unknown)


def _allowance(pairs: PosePairs, config: CalibratorConfig) -> FloatArray:
    """Return the covariance (6, 6) of constant errors of the sensor, which no recording reveals."""
    if config.child_kind != "odometry":
        return np.zeros((6, 6))
    speed_m_s = common_mode.usual_speed(
        pairs.stamps_ns, se3.translation_of(pairs.Ts_cw_c)
    )
    # The floor is for two odometries. Only the sensor has one here, so use half of the floor.
    return 0.5 * common_mode.common_mode_floor(speed_m_s)


def _residuals_of(fit: Fit, drive: Drive, start_ns: int) -> Residuals:
    """Return the residuals of a fit. ``start_ns`` is the stamp of the first pose.

    The residual of a component that is not compared is zero.
    """
    residuals = np.zeros(drive.xi.shape)
    residuals[:, drive.components] = fit.residuals
    since_start_ns = np.round(drive.ends_s * 1e9).astype(np.int64)
    window_start_ns, window_end_ns = start_ns + since_start_ns
    return Residuals(
        translation=residuals[:, :3],
        rotation=residuals[:, 3:] @ se3.rotation_of(fit.T_base_sensor),
        weights=fit.weights,
        start_ns=window_start_ns,
        end_ns=window_end_ns,
    )


def _check_fit(
    fit: Fit, drive: Drive, config: CalibratorConfig
) -> tuple[Finding, ...]:
    """Return the finding about a fit; empty if the fit is good.

    Possible findings: the drive does not determine the pose, the wheels are from another drive, the
    sensor seems to be upside down, or its mount moved during the drive.
    """
    # Indices of the unknowns for the estimated axes.
    index_of = {"x": 0, "yaw": YAW}
    if drive.model:
        index_of["y"] = Y
    undetermined = _undetermined_axes(fit, drive, index_of)
    if undetermined or not fit.converged:
        is_varied = _has_varied_turns(drive) and not _is_on_the_spot(drive)
        key = "unrelated_wheels" if is_varied else "one_motion"
        return (finding(key, axes=listing(undetermined or [*index_of])),)
    contradicting = _check_wheels(fit, drive, config) if drive.model else ()
    if contradicting:
        return contradicting
    # The estimate of a half has twice the variance. The difference of both halves has four times
    # the variance.
    sigmas = 2.0 * np.sqrt(np.diag(fit.covariance))
    differences = np.abs(np.subtract(*fit.halves)) / sigmas
    different = [
        axis
        for axis, index in index_of.items()
        if differences[index] > _MAX_SIGMAS_OF_HALVES
    ]
    return (
        (finding("vehicle_halves", axes=listing(different)),)
        if different
        else ()
    )


def _undetermined_axes(
    fit: Fit, drive: Drive, index_of: Mapping[str, int]
) -> list[str]:
    """Return the axes that the drive, or most of it, does not determine."""
    ratios = fit.signal_to_noise(drive.components)
    undetermined = []
    for axis, index in index_of.items():
        is_concentrated = fit.concentration[index] > _MAX_CONCENTRATION
        if is_concentrated or ratios[axis] < _MIN_SIGNAL_TO_NOISE:
            undetermined.append(axis)
    return undetermined


def _check_wheels(
    fit: Fit, drive: Drive, config: CalibratorConfig
) -> tuple[Finding, ...]:
    """Return the finding about wheels from another drive, or about a sensor upside down."""
    share = _unrelated_share(fit, drive)
    has_no_clock = fit.covariance[CLOCK, CLOCK] > _MAX_CLOCK_SIGMA_S**2
    if share > _UNRELATED or has_no_clock:
        is_unusable = share > _UNUSABLE or has_no_clock
        severity = Severity.ERROR if is_unusable else Severity.WARNING
        return (finding("unrelated_wheels", severity=severity),)
    has_prior = bool({"roll", "pitch"} & {*config.prior()})
    if not has_prior and _is_upside_down(fit):
        roll = np.degrees(
            se3.rotation_to_rpy(se3.rotation_of(fit.T_base_sensor))[0]
        )
        return (finding("upside_down", roll=f"{roll:.0f}"),)
    return ()


def _is_upside_down(fit: Fit) -> bool:
    """Return whether z of the sensor, or -y of a camera, points down."""
    up = se3.rotation_of(fit.T_base_sensor)[2]
    main = int(np.argmax(np.abs(up)))
    if main == 2:
        return bool(up[2] < 0.0)
    return main == 1 and bool(up[1] > 0.0)


def _has_varied_turns(drive: Drive) -> bool:
    """Return whether the vehicle drives curves of different curvature."""
    lengths = np.linalg.norm(drive.xi[:, :3], axis=1)
    turns = np.linalg.norm(drive.xi[:, 3:], axis=1)
    curvature = lengths @ turns / (lengths @ lengths)
    deviations = turns - curvature * lengths
    is_large = np.mean(deviations**2) > _VARIED_SHARE**2 * np.mean(turns**2)
    return bool(
        is_large and quantile(np.abs(deviations), _USUAL) > _VARIED_TURN
    )


def _is_on_the_spot(drive: Drive) -> bool:
    """Return whether the wheels turn the vehicle on the spot."""
    if drive.model is None:
        return False
    forward, left, turns = np.abs(drive.motions_of_unit_vehicle()).sum(axis=1)
    return bool(np.hypot(forward, left) < _ON_THE_SPOT * turns)


def _unrelated_share(fit: Fit, drive: Drive) -> float:
    """Return the share of the motion in which wheels and sensor disagree.

    It is the larger share of two components: the first (forward) and the last (turn).
    """
    axle = drive.measured(fit.T_base_sensor)[:, drive.components]
    shares = np.sqrt(np.diag(fit.noise) / np.mean(axle**2, axis=0))
    return float(max(shares[0], shares[-1]))


def _check(
    snapshot: Snapshot, calibration: Calibration | None = None
) -> CheckResult:
    """Return the findings about the calibration and about the stream of the sensor."""
    findings = [*calibration.findings] if calibration else []
    findings += check_stream(
        snapshot.streams[1], "child", snapshot.config.max_gap
    )
    return CheckResult(gravest_first(findings))


#: The kind of data "vehicle".
VEHICLE = Kind(_solve, _check, MOST_MOVED_S, _ALLOWED)
