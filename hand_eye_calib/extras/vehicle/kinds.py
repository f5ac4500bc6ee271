"""Wheels and a sensor, or a sensor on a vehicle alone, as a kind of data on the road."""

import numpy as np

from hand_eye_calib.core.assessment import covariance
from hand_eye_calib.core.assessment.prior import fuse
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.registry import OUT_OF_REACH
from hand_eye_calib.core.base.stats import quantile
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import Finding, Severity, finding, gravest_first
from hand_eye_calib.core.checks.streams import check_stream
from hand_eye_calib.core.engine import estimation
from hand_eye_calib.core.engine.kinds import Kind
from hand_eye_calib.core.engine.snapshot import MOST_MOVED_S, Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import AXES, Residuals
from hand_eye_calib.extras.vehicle.parameters import VehicleParameter, VehicleParameters
from hand_eye_calib.extras.vehicle.solving import (
    BLOCKS,
    CLOCK,
    N_FIXED,
    TILT,
    YAW,
    Drive,
    Fit,
    Y,
    fit_drive,
)
from hand_eye_calib.extras.vehicle.wheels import MODELS, steps_of

# Durations of the windows (s). Without wheels, the curvature of a window must be constant.
_WINDOW_S = 0.5
_WINDOW_ALONE_S = 0.3

# The vehicle rests in a window with less than this share of the usual motion, a quantile.
_AT_REST = 0.05
_USUAL = 0.9

# Smaller motions (m, rad) across the plane of a sensor are rounding: its poses are of two
# dimensions.
_FLAT = 1e-6

# The drive determines the pose if the motion has this many times the information of noise: 168 and
# more in simulated figures of eight, below 2 on straight roads and on one circle.
_MIN_SIGNAL_TO_NOISE = 10.0

# Share of the forward motion or of the turns that wheels and sensor have not in common, from which
# on they seem to be of two drives, and from which on they are: 0.02 in simulated drives with slip.
_UNRELATED = 0.1
_UNUSABLE = 0.3

# Both halves of a drive disagree above this many joint standard deviations.
_APART_SIGMAS = 3.3

# The vehicle drives the same curve if the turns (rad) of its windows differ by less from it.
_VARIED_TURN = 0.02

# Options that have no meaning for a vehicle, and their only values.
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
    """Estimate the pose of the sensor on the vehicle; the road adds the names of the frames."""
    config = snapshot.config
    wheels, _ = snapshot.streams
    pairs = snapshot.pose_pairs
    offset_s = config.given_time_offset_s
    window_s = _WINDOW_ALONE_S if config.parent_measures == "driving" else _WINDOW_S
    if "time_offset" not in config.given and snapshot.correlation.is_clear:
        offset_s = snapshot.correlation.offset_s
    drive = _drive(pairs, wheels, config, offset_s, window_s)
    if len(drive.xi) < 3 * BLOCKS:
        raise NotEnoughDataError(
            f"the vehicle moves for {len(drive.xi) * window_s:.0f} s while both streams have data; "
            f"at least {3 * BLOCKS * window_s:.0f} s are needed: drive figures of eight"
        )
    fixed = []
    if drive.model is None or "time_offset" in config.given:
        fixed.append(CLOCK)
    if drive.model is None:
        fixed.append(Y)
    if _is_flat(drive):
        fixed += TILT
    fit = fit_drive(drive, _drive(pairs, wheels, config, offset_s, 2.0 * window_s), fixed)
    return _calibration(fit, drive, pairs, offset_s, config)


def _drive(
    pairs: PosePairs,
    wheels: Trajectory,
    config: CalibratorConfig,
    offset_s: float,
    window_s: float,
) -> Drive:
    """Return the windows in which the vehicle moves, without gaps, and the data of the wheels."""
    start_ns = pairs.stamps_ns[0]
    times_s = np.asarray((pairs.stamps_ns - start_ns) * 1e-9, dtype=float)
    begin_s = np.arange(0.0, times_s[-1], window_s)
    rows = np.unique(np.searchsorted(times_s, begin_s - _FLAT))
    poses = pairs.Ts_cw_c[rows]
    xi = se3.log(se3.inverse(poses[:-1]) @ poses[1:])
    moved = np.linalg.norm(xi[:, :3], axis=1)
    turned = np.linalg.norm(xi[:, 3:], axis=1)
    is_used = (moved > _AT_REST * quantile(moved, _USUAL)) | (
        turned > _AT_REST * quantile(turned, _USUAL)
    )
    is_used &= np.diff(times_s[rows]) < window_s + config.max_gap
    xi = xi[is_used]
    # Pairs are on the parent's clock with the offset of the options.
    clock_s = times_s[rows] + offset_s - config.given_time_offset_s
    model = MODELS.get(config.parent_measures)
    components = [1, 2, 3, 4] if model is None else [0, 1, 2, 3, 4, 5]
    if np.abs(xi[:, 2:5]).max(initial=0.0) < _FLAT:
        components = [number for number in components if number not in (2, 3, 4)]
    return Drive(
        xi=xi,
        ends_s=np.stack([clock_s[:-1], clock_s[1:]])[:, is_used],
        stamps_s=np.asarray((wheels.stamps_ns - start_ns) * 1e-9, dtype=float),
        steps=steps_of(wheels),
        model=model,
        components=components,
    )


def _is_flat(drive: Drive) -> bool:
    return 2 not in drive.components


# ------------------------------------------------------------------ the result


def _calibration(
    fit: Fit, drive: Drive, pairs: PosePairs, offset_s: float, config: CalibratorConfig
) -> Calibration:
    """Return the result of a fit: pose, parameters of the wheels, clock and findings."""
    kind = "vehicle" if drive.model else "vehicle_alone"
    if _is_flat(drive):
        kind += "_2d"
    findings = _check_fit(fit, drive)
    unknown_axes = OUT_OF_REACH[kind]
    if any(found.makes_unusable for found in findings):
        unknown_axes = AXES
    T = fit.T_base_sensor
    in_base = np.insert(np.insert(fit.covariance[:CLOCK, :CLOCK], 2, 0.0, axis=0), 2, 0.0, axis=1)
    to_child = se3.block_diagonal(se3.rotation_of(T).T)
    unknown = to_child[:, [AXES.index(axis) for axis in unknown_axes]]
    assessment = covariance.combined(T, to_child @ in_base @ to_child.T, unknown)
    fused = fuse(assessment, config.prior())
    floor = np.zeros((6, 6))
    if config.child_kind == "odometry":
        speed_m_s = covariance.usual_speed(pairs.stamps_ns, se3.translation_of(pairs.Ts_cw_c))
        # The floor is that of two odometries.
        floor = 0.5 * covariance.common_mode_floor(speed_m_s)
    whole = np.zeros(drive.xi.shape)
    whole[:, drive.components] = fit.residuals
    start_ns, end_ns = pairs.stamps_ns[0] + np.round(drive.ends_s * 1e9).astype(np.int64)
    residuals = Residuals(
        translation=whole[:, :3],
        rotation=whole[:, 3:] @ se3.rotation_of(T),
        weights=fit.weights,
        start_ns=start_ns,
        end_ns=end_ns,
    )
    result = estimation.calibration_of(
        fit,
        fused,
        residuals,
        pairs.stamps_ns,
        config,
        reference="windows",
        measured=kind,
        T_method=T,
        covariance_allowance=fused.allowance(floor),
        time_offset_s=offset_s + float(fit.others[0]),
        time_offset_sigma_s=float(np.sqrt(fit.covariance[CLOCK, CLOCK])),
        findings=findings,
    )
    if drive.model is None or unknown_axes == AXES:
        return result
    sigmas = np.sqrt(np.diag(fit.covariance))[N_FIXED:]
    values = fit.others[N_FIXED - CLOCK :]
    parameters = map(VehicleParameter, drive.model.names, values.tolist(), sigmas.tolist())
    slip_share = float(np.mean(fit.weights == 0.0))
    return result.with_part("wheels", VehicleParameters(tuple(parameters), slip_share))


def _check_fit(fit: Fit, drive: Drive) -> tuple[Finding, ...]:
    """Detect drives that determine nothing, other machines, and mounts that moved."""
    rows = {"x": 0, "yaw": YAW} | ({"y": Y} if drive.model else {})
    ratios = fit.signal_to_noise(drive.components)
    hidden = [axis for axis in rows if ratios[axis] < _MIN_SIGNAL_TO_NOISE]
    if hidden or not fit.converged:
        lengths = np.linalg.norm(drive.xi[:, :3], axis=1)
        turns = np.linalg.norm(drive.xi[:, 3:], axis=1)
        curvature = lengths @ turns / (lengths @ lengths)
        is_varied = quantile(np.abs(turns - curvature * lengths), _USUAL) > _VARIED_TURN
        key = "unrelated_wheels" if is_varied else "one_motion"
        return (finding(key, axes=listing(hidden or [*rows])),)
    if drive.model:
        axle = drive.measured(fit.T_base_sensor)[:, drive.components]
        shares = np.sqrt(np.diag(fit.noise) / np.mean(axle**2, axis=0))
        share = float(max(shares[0], shares[-1]))
        if share > _UNRELATED:
            severity = Severity.ERROR if share > _UNUSABLE else Severity.WARNING
            return (finding("unrelated_wheels", severity=severity),)
    # Each half has twice the variance, and their difference four times.
    sigmas = np.abs(np.subtract(*fit.halves)) / (2.0 * np.sqrt(np.diag(fit.covariance)))
    apart = [axis for axis, row in rows.items() if sigmas[row] > _APART_SIGMAS]
    return (finding("vehicle_halves", axes=listing(apart)),) if apart else ()


def _check(snapshot: Snapshot, calibration: Calibration | None = None) -> CheckResult:
    """Return the findings of the solve, and of the stream of the sensor."""
    findings = [*calibration.findings] if calibration else []
    findings += check_stream(snapshot.streams[1], "child", snapshot.config.max_gap)
    return CheckResult(gravest_first(findings))


#: Wheels and a sensor with poses, or a sensor alone.
VEHICLE = Kind(_solve, _check, MOST_MOVED_S, _ALLOWED)
