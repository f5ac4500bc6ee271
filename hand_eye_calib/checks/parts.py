"""Checks of two streams of which one has only positions, only rotations or only angular rates.

Positions beside poses: the sensor that measures positions borrows the orientations of the other
one, aligned to the world of the positions in windows. Then both streams are poses, and the
regressions of :mod:`~hand_eye_calib.checks.response` look for a coordinate of another scale or
delay and for smoothing.

Rotations: the rotation vectors of one stream are regressed on those of the other. The
antisymmetric part of the matrix between them is the extrinsic. The symmetric part is a fault: a
gain on the diagonal, axes that are not perpendicular beside it.
"""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import BLOCKS, usual_speed
from hand_eye_calib.assessment.moved import find_change
from hand_eye_calib.checks import agreement
from hand_eye_calib.checks.findings import LIMITS, Finding, Severity, finding, graded, gravest_first
from hand_eye_calib.checks.hypotheses import LAGS_S, MIN_PAIRS
from hand_eye_calib.checks.response import Regression, delays, response
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.gls.increments import without_rate_bias
from hand_eye_calib.pairing.motion_pairs import PosePairs, pairs_over, synchronise
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.stats import median, robust_sigma
from hand_eye_calib.text import angle, length

# Duration of the windows that positions are aligned in (s). An odometry turns little in it, and
# most motions of 3 s lie within one window.
_WINDOW_S = 30.0

# Fewest positions that are aligned by themselves.
_LEAST_ALIGNED = 10

# A lever arm is zero if each axis is within this distance (m), or within so many standard
# deviations. Two housings hardly fit closer than the first of these (m). It is an error if two
# axes have an upper bound (two standard deviations) below that, and the third below the second.
_ZERO_M, _ZERO_SIGMAS, _HOUSINGS_M = 0.005, 3.0, (0.03, 0.06)

# Positions that follow the other stream to this distance (m), and to this share of a step, are
# computed from it: no receiver or total station measures to a twentieth of a millimetre.
_COPIED_M = 5e-5
_COPIED_SHARE = 0.01

# The same for rotations (rad): quaternions with five digits.
_COPIED_RAD = 2e-5

# Codes of findings about positions alone.
_OF_POSITIONS = ("axis_scale", "axis_lag", "smoothed_positions")

# Positions are interpolated if at least this share of them lies on a straight line through both
# neighbours, within this distance (m). Recorded positions scatter by more, also on a motorway.
_STRAIGHT_SHARE, _STRAIGHT_M = 0.5, 1e-5

# Shorter steps (m) show no direction.
_MOVES_M = 1e-3

# Most motions of a regression of rotations.
_MOST_MOTIONS = 3000

# Rotation vectors near half a turn may point either way (rad).
_MOST_RAD = 2.8

# Rates are about left-handed axes if a reflection leaves less than this share of what the best
# rotation leaves. Noise makes both about equal.
_MIRRORED = 0.5
# The rotation leaves more than this share of the rotations then. Where all of them are about one
# axis, a mirror only turns over the noise of the others.
_UNMIRRORED = 0.1

# A coordinate with less than this factor has the wrong sign.
_MIRRORED_FACTOR = -0.5

# Planes of two principal axes.
_PLANES = ((0, 1), (0, 2), (1, 2))


def check_solved(
    parent: Trajectory,
    child: Trajectory,
    calibration: Calibration,
    config: CalibratorConfig,
    least_share: float = 0.0,
) -> list[Finding]:
    """Findings about two streams, at least one of which has only a part of its poses, and the
    result from them.

    Parameters
    ----------
    parent, child : Trajectory
        Each on its own clock.
    calibration : Calibration
    config : CalibratorConfig
        The options that the result was made with.
    least_share : float
        The share of the squared residuals that a fault of positions must explain.
    """
    child = child.shifted(calibration.time_offset_s)
    pairs = synchronise(parent, child, config.max_gap).child_scaled(calibration.scale)
    if len(pairs) < MIN_PAIRS:
        return []
    stream = "parent" if child.measures == "poses" else "child"
    priors = {*config.prior()}
    if calibration.measured == "rotations":
        has_rates = "rates" in (parent.measures, child.measures)
        return _check_turning(pairs, calibration, stream, priors, has_rates)
    measured = {"parent": parent, "child": child}[stream]
    interpolated = check_interpolated(measured.poses[:, :3, 3], stream)
    return _check_moving(pairs, calibration, stream, priors, least_share, interpolated)


def _check_turning(
    pairs: PosePairs,
    calibration: Calibration,
    stream: str,
    priors: Collection[str],
    has_rates: bool,
) -> list[Finding]:
    """Findings about rotations or rates, the first kind that there is."""
    T_parent_child = calibration.T_parent_child
    sigmas = calibration.sigmas_measured[3:]
    same = check_rotation(T_parent_child[:3, :3], sigmas, priors, has_rates)
    if copied := _copied_rotations(pairs, T_parent_child):
        return [replace(found, severity=Severity.ERROR) for found in same] or copied
    if found := same or _check_handedness(pairs, stream):
        return found
    return check_rotations(_without_bias(pairs, calibration), T_parent_child, stream, has_rates)


def _check_moving(
    pairs: PosePairs,
    calibration: Calibration,
    stream: str,
    priors: Collection[str],
    least_share: float,
    interpolated: list[Finding],
) -> list[Finding]:
    """Findings about positions, the first kind that there is."""
    T_parent_child = calibration.T_parent_child
    same = check_position(T_parent_child[:3, 3], calibration.sigmas_measured[:3], priors)
    pairs = _with_orientations(pairs, T_parent_child, stream)
    if copied := _copied_positions(pairs, T_parent_child):
        return [replace(found, severity=Severity.ERROR) for found in same] or copied
    if found := [*interpolated, *same]:
        return found
    return check_positions(pairs, T_parent_child, stream, least_share)


def _without_bias(pairs: PosePairs, calibration: Calibration) -> PosePairs:
    """The pose pairs without the bias of a gyroscope."""
    if not calibration.rate_bias:
        return pairs
    bias = np.array(calibration.rate_bias.rad_per_s)
    if calibration.rate_bias.of == "parent":
        freed = without_rate_bias(pairs.stamps_ns, pairs.Ts_pw_p, bias)
        return replace(pairs, Ts_pw_p=freed)
    return replace(pairs, Ts_cw_c=without_rate_bias(pairs.stamps_ns, pairs.Ts_cw_c, bias))


def check_position(
    lever_arm: FloatArray, sigmas: FloatArray, given: Collection[str]
) -> list[Finding]:
    """Finding about a lever arm of zero: positions that were copied from the other stream.

    Parameters
    ----------
    lever_arm, sigmas : (3,) array
        m; the standard deviation of an axis is infinite if the motion does not show it.
    given : collection of str
        Axes with a prior, which the user has measured.
    """
    axes = [k for k, axis in enumerate("xyz") if np.isfinite(sigmas[k]) and axis not in given]
    if len(axes) < 2:
        return []
    sizes, spreads = np.abs(lever_arm[axes]), sigmas[axes]
    if (sizes > np.maximum(_ZERO_M, _ZERO_SIGMAS * spreads)).any():
        return []
    uppers_m = np.sort(sizes + 2.0 * spreads)
    if uppers_m[1] > _HOUSINGS_M[1]:  # unknown rather than zero
        return []
    # An antenna may be right above the other sensor.
    is_sure = len(axes) == 3 and uppers_m[1] < _HOUSINGS_M[0] and uppers_m[2] < _HOUSINGS_M[1]
    severity = Severity.ERROR if is_sure else Severity.WARNING
    distance_m = float(np.linalg.norm(sizes))
    size = f"{length(distance_m)} +/- {length(float(spreads.max()))}"
    return [finding("no_lever_arm", "both", severity, size=size, translation_m=distance_m)]


def check_rotation(
    rotation: FloatArray, sigmas: FloatArray, given: Collection[str], has_rates: bool
) -> list[Finding]:
    """Finding about a rotation of zero: rates or rotations of the other sensor itself.

    Parameters
    ----------
    rotation : (3, 3) array
    sigmas : (3,) array
        rad; the standard deviation of an axis is infinite if the motion does not show it.
    given : collection of str
        Axes with a prior, which the user has measured.
    has_rates : bool
        Whether a stream has rates: that is an error then. Two cameras may well be parallel.
    """
    limit_rad = agreement.MAX_SIGMA_RAD
    # Two level sensors that rotate about a single axis look alike, and yaw is unknown.
    if {"roll", "pitch", "yaw"} & {*given} or not sigmas.max() < limit_rad:
        return []
    turned = np.abs(se3.rotation_log(rotation))
    if (turned > np.maximum(agreement.SAME_RAD, _ZERO_SIGMAS * sigmas)).any():
        return []
    angle_rad = float(np.linalg.norm(turned))
    severity = Severity.ERROR if has_rates else Severity.WARNING
    return [finding("parallel_axes", "both", severity, size=angle(angle_rad), angle_rad=angle_rad)]


def check_positions(
    pairs: PosePairs, T_parent_child: FloatArray, stream: str, least_share: float = 0.0
) -> list[Finding]:
    """Findings about positions beside poses, on one clock and in one unit of length.

    Parameters
    ----------
    pairs : PosePairs
        The stream with positions has the orientations of the other one.
    T_parent_child : (4, 4) array
        The lever arm, without a rotation.
    stream : {"parent", "child"}
        The stream that has positions.
    least_share : float
        The share of the squared residuals that a fault must explain.
    """
    motions = pairs_over(pairs, LAGS_S[0], agreement.MOST_SHORT)
    if len(motions) < MIN_PAIRS:
        return []
    slow, _ = response(pairs, motions, T_parent_child)
    other = {"child": "parent", "parent": "child"}[stream]
    suspects = [
        (slow.share(f"axes_{stream}"), agreement.axis_gain(slow, stream)),
        # A large factor shows better as its inverse, in the columns of the poses.
        (slow.share(f"axes_{other}"), agreement.axis_gain(slow, other, stream)),
    ]
    short = pairs_over(pairs, agreement.SHORT_S, agreement.MOST_SHORT)
    if fast := delays(pairs, short, T_parent_child):
        speed = usual_speed(pairs.stamps_ns, pairs.Ts_pw_p[:, :3, 3])
        interval_s = median(np.diff(pairs.stamps_ns)) * 1e-9
        suspects += agreement.delay_suspects(fast, pairs, speed, 0.0)
        suspects += agreement.smoothing_suspects(fast, interval_s, speed)
    named = [
        (suspect.code == "smoothed_positions", share, _of_positions_alone(suspect))
        for share, suspect in suspects
        if suspect and share > least_share and suspect.stream == stream
        if suspect.code in _OF_POSITIONS
    ]
    # Smoothing makes a coordinate shorter that changes fast: it is the cause.
    return [max(named, key=lambda suspect: suspect[:2])[2]] if named else []


def _of_positions_alone(suspect: Finding) -> Finding:
    """The finding as it is about positions alone.

    Smoothed positions are an error: the lever arm depends on little else. A negative scale is a
    mirror.
    """
    if suspect.code == "smoothed_positions":
        return replace(suspect, severity=Severity.ERROR)
    if suspect.code == "axis_scale" and suspect.evidence["factor"] < _MIRRORED_FACTOR:
        return finding("mirrored_positions", suspect.stream)
    return suspect


def _with_orientations(pairs: PosePairs, T_parent_child: FloatArray, stream: str) -> PosePairs:
    """Pose pairs whose stream with positions has the orientations of the other stream, in the
    world of its positions.
    """
    if stream == "child":
        predicted, measured = pairs.Ts_pw_p @ T_parent_child, pairs.Ts_cw_c
    else:
        predicted, measured = pairs.Ts_cw_c @ se3.inverse(T_parent_child), pairs.Ts_pw_p
    windows = (pairs.stamps_ns - pairs.stamps_ns[0]) // round(_WINDOW_S * 1e9)
    borrowed = measured.copy()
    for window in np.unique(windows):
        inside = windows == window
        used = inside if inside.sum() >= _LEAST_ALIGNED else np.abs(windows - window) <= 1
        path, positions = (Ts[used, :3, 3] for Ts in (predicted, measured))
        products = (positions - positions.mean(axis=0)).T @ (path - path.mean(axis=0))
        borrowed[inside, :3, :3] = se3.nearest_rotation(products) @ predicted[inside, :3, :3]
    if stream == "child":
        return replace(pairs, Ts_cw_c=borrowed)
    return replace(pairs, Ts_pw_p=borrowed)


def _copied_positions(pairs: PosePairs, T_parent_child: FloatArray) -> list[Finding]:
    """Finding about positions that were computed from the poses: only rounding differs."""
    motions = pairs_over(pairs, 0.0, agreement.MOST_SHORT)
    if len(motions) < MIN_PAIRS:
        return []
    left_m = median(np.linalg.norm(motions.residuals(T_parent_child)[0], axis=1))
    moved_m = median(np.linalg.norm(motions.Ts_parenti_parentj[:, :3, 3], axis=1))
    if left_m > min(_COPIED_M, _COPIED_SHARE * moved_m):
        return []
    text = "The positions agree with the poses to rounding"
    return [finding("not_independent", "both", Severity.ERROR, evidence=text, residual_m=left_m)]


def check_interpolated(positions: FloatArray, stream: str) -> list[Finding]:
    """Finding about positions (N, 3) that were interpolated between few measured ones."""
    steps = np.diff(positions, axis=0)
    sizes = np.linalg.norm(steps, axis=1)
    moving = np.minimum(sizes[1:], sizes[:-1]) > _MOVES_M
    if moving.sum() < MIN_PAIRS:
        return []
    # The middle of three positions, off the line through the other two.
    chord = steps[1:] + steps[:-1]
    along = np.linalg.norm(chord, axis=1)
    off = np.linalg.norm(se3.cross(steps[:-1], chord), axis=1) / np.maximum(along, 1e-12)
    share = float((off[moving] < _STRAIGHT_M).mean())
    return [finding("interpolated", stream, share=share)] if share > _STRAIGHT_SHARE else []


def _copied_rotations(pairs: PosePairs, T_parent_child: FloatArray) -> list[Finding]:
    """Finding about rotations that were computed from the others: only rounding differs."""
    of_parent, of_child = _rotation_vectors(pairs)
    if len(of_parent) < MIN_PAIRS:
        return []
    remaining = np.linalg.norm(of_child @ T_parent_child[:3, :3].T - of_parent, axis=1)
    left_rad = median(remaining)
    if left_rad > min(_COPIED_RAD, _COPIED_SHARE * median(np.linalg.norm(of_parent, axis=1))):
        return []
    text = "The rotations of both streams agree to rounding"
    return [
        finding("not_independent", "both", Severity.ERROR, evidence=text, residual_rad=left_rad)
    ]


def check_rotations(
    pairs: PosePairs, T_parent_child: FloatArray, stream: str, has_rates: bool
) -> list[Finding]:
    """Findings about rotations that agree, on one clock and without the bias of a gyroscope.

    Parameters
    ----------
    pairs : PosePairs
        Positions are not looked at.
    T_parent_child : (4, 4) array
    stream : {"parent", "child"}
        The stream that findings name: the one with rates.
    has_rates : bool
        Orientations come from an odometry or a filter, which has no axes to misalign: only
        a mount that moves is looked for then.
    """
    rotation = T_parent_child[:3, :3]
    of_parent, of_child = _rotation_vectors(pairs)
    if len(of_parent) < BLOCKS * MIN_PAIRS:
        return []
    suspects: list[Finding | None] = []
    if has_rates:
        suspects = _matrix_suspects(of_parent, of_child @ rotation.T, stream)
    still = np.zeros((len(pairs), 3))
    turning = PosePairs(
        pairs.stamps_ns,
        se3.from_rotation_translation(pairs.Ts_pw_p[:, :3, :3], still),
        se3.from_rotation_translation(pairs.Ts_cw_c[:, :3, :3], still),
    )
    change = find_change(turning, se3.from_rotation_translation(rotation, np.zeros(3)))
    moved = agreement.moved_mount(change, int(pairs.stamps_ns[0])) if change else None
    if moved:
        return [moved]
    named = gravest_first([suspect for suspect in suspects if suspect])
    return [*named[:1]]


def _rotation_vectors(pairs: PosePairs) -> tuple[FloatArray, FloatArray]:
    """Rotation vectors (K, 3) of parent and child over a second, each in its own axes."""
    motions = pairs_over(pairs, agreement.SHORT_S, _MOST_MOTIONS)
    turns = [
        se3.rotation_log(Ts[:, :3, :3])
        for Ts in (motions.Ts_parenti_parentj, motions.Ts_childi_childj)
    ]
    usable = np.max([np.linalg.norm(vectors, axis=1) for vectors in turns], axis=0) < _MOST_RAD
    return turns[0][usable], turns[1][usable]


def _check_handedness(pairs: PosePairs, stream: str) -> list[Finding]:
    """Finding about rates that a reflection explains far better than any rotation."""
    of_parent, of_child = _rotation_vectors(pairs)
    if len(of_parent) < BLOCKS * MIN_PAIRS:
        return []
    # A bias is a mean. It is not known as long as the rotation is wrong.
    of_parent, of_child = (vectors - vectors.mean(axis=0) for vectors in (of_parent, of_child))
    left, _, right = np.linalg.svd(of_child.T @ of_parent)
    rotating = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    mirroring = rotating * [1.0, 1.0, -1.0]
    by_rotation, by_mirror = (
        median(np.linalg.norm(of_child @ left @ signs @ right - of_parent, axis=1))
        for signs in (rotating, mirroring)
    )
    usual = median(np.linalg.norm(of_parent, axis=1))
    is_mirrored = by_mirror < _MIRRORED * by_rotation and by_rotation > _UNMIRRORED * usual
    return [finding("mirrored_rates", stream)] if is_mirrored else []


def _matrix_suspects(
    of_parent: FloatArray, of_child: FloatArray, stream: str
) -> list[Finding | None]:
    """Gains and misaligned axes of the rates of a stream, from rotation vectors (K, 3) of both in
    the parent's axes.

    Rates are the less noisy: their rotation vectors are the columns. These are small rotations of
    the extrinsic, gains of the principal axes, and the symmetric part beside the diagonal.
    """
    if stream == "child":
        reference, measured = of_child, of_parent
    else:
        reference, measured = of_parent, of_child
    axes = np.linalg.eigh(reference.T @ reference)[1][:, ::-1]
    x, y = reference @ axes, measured @ axes
    gains = x[:, None, :] * np.eye(3)
    shears = np.zeros((len(x), 3, 3))
    for column, (k, m) in enumerate(_PLANES):
        shears[:, k, column] = x[:, m]
        shears[:, m, column] = x[:, k]
    rows = np.concatenate([se3.skew(x), gains, shears, (y - x)[:, :, None]], axis=2)
    where = {"rotation": [0, 1, 2], "gain": [3, 4, 5], "shear": [6, 7, 8]}
    unit = np.full((3, 1), max(float(robust_sigma(y - x)), 1e-8))
    fit = Regression(rows, rows, unit, where, "rotation")
    gain = agreement.rotation_gain(fit, axes, inverse=stream == "child")
    return [_shear(fit, stream), gain]


def _shear(fit: Regression, stream: str) -> Finding | None:
    """Axes of rotation that are not perpendicular."""
    values, sigmas = fit.fit("shear", "gain")
    limits = agreement.BIASES * fit.biases("shear")
    known = np.where(
        np.abs(values) > np.maximum(LIMITS["misaligned"][0] * sigmas, limits), values, 0
    )
    size = float(np.abs(known).max())
    # A symmetric part of s is an angle between two axes that is off by 2 s.
    degrees = float(np.degrees(2.0 * size))
    return graded("misaligned", stream, size, degrees=degrees)
