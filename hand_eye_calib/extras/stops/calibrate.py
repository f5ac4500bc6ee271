"""From stops of an arm to a calibration: ``A X = Z B`` checked, solved, judged, and named by its
frames.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hand_eye_calib.core.assessment.covariance import UNKNOWN_SIGMAS, combined
from hand_eye_calib.core.assessment.prior import fuse
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig, defaults_of
from hand_eye_calib.core.base.errors import ConfigError, InputError, NotEnoughDataError
from hand_eye_calib.core.base.option import option_name, options_in_words
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.base.text import listing, shown_value
from hand_eye_calib.core.checks.findings import Finding, Severity, finding
from hand_eye_calib.core.engine.estimation import calibration_of
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import pose_stack
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import Residuals, gravest_first
from hand_eye_calib.extras.stops.checks import (
    Examination,
    GivenStops,
    Mistakes,
    examine,
    scale_finding,
    scaled,
    stops_of,
    turns_about_two_axes,
)
from hand_eye_calib.extras.stops.robot_world import MIN_STOPS, RobotWorld, Stops, solve
from hand_eye_calib.extras.stops.worlds import SETUPS, Worlds

# Options that mean something for stops; those of groups by the beginnings of their names.
_OBEYED = {
    "min_pairs",
    "parent_frame",
    "child_frame",
    "scale",
    "parent_scale",
    *(f"{stream}_{name}" for stream in ("parent", "child") for name in ("invert", "quaternion")),
    *(f"{stream}_{name}" for stream in ("parent", "child") for name in ("measures", "kind")),
}
_OBEYED_GROUPS = ("prior_", "target_")

# A scale contradicts if it is so many of its standard deviations and this share off. Noise of the
# child's positions makes it smaller, by three squared standard deviations for each stop; that of
# the parent's does not. Of KinHEC's noisy stops (0.76 +/- 0.06 where 1 is right) that is enough.
_SCALE_SIGMAS = 3.0
_SCALE_SHARE = 0.01
_BY_NOISE = 3.0

# Scales beyond this factor are no size of a target.
_WRONG_SCALE = 10.0

# Values of the option scale that have it found.
_FOUND_SCALES = ("auto", "estimate")

# Steps to the scale; a step below this share of its standard deviation ends them.
_SCALE_ROUNDS = 10
_SMALL_STEP = 0.02

# Readings whose objectives differ by less than this fit equally well: a factor of 1100 between
# their likelihoods. Simulated arms of four stops or more have 95 at least, of three stops 0.0.
_READING_LEAD = 7.0

# Mounts are the identity, and one side a copy of the other, within so many standard deviations
# and these lengths (m) and angles (rad).
_IDENTITY_SIGMAS = 3.0
_IDENTITY_M = 0.001
_IDENTITY_RAD = 0.001

# Stops that rotate by more than this (rad; 10 deg) in the median are unknown only through errors
# that no camera has.
_FAR_RAD = 0.17

# More stops than this share that are left out ask for care; so many of them are named.
_MANY_LEFT_OUT = 0.1
_MOST_NUMBERS = 8

# What is on a hand is nearer to it than this (m), or than twice the way from the base to what is
# fixed there.
_ON_HAND_M = 0.3
_NEARER = 0.5


@dataclass(frozen=True)
class _Solved:
    """A fit with the stops, the options and the findings that lead to it."""

    fit: RobotWorld
    stops: Stops
    is_inverse: bool
    config: CalibratorConfig
    scale: float
    scale_sigma: float
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]
    # How much larger the objective of the other way round is.
    lead: float = np.inf

    @property
    def is_usable(self) -> bool:
        """Whether no finding forbids the use of the result."""
        return not any(found.makes_unusable for found in self.findings)


def calibrate_stops(
    Ts_world_parent: Any,
    Ts_world_child: Any,
    config: CalibratorConfig | None = None,
) -> Calibration:
    """Solve and assess stops, which are poses without an order.

    Parameters
    ----------
    Ts_world_parent, Ts_world_child : array-likes
        Poses of both sensors, each in its own world: of a hand in the base of a robot, and of the
        camera in the hand in the frame of a target. Matrices (N, 4, 4), rows (N, 7) of x, y, z, qx,
        qy, qz, qw, or a pair (R, t) of rotations (N, 3, 3) or rotation vectors (N, 3) and
        translations (N, 3).
    config : CalibratorConfig, optional
        Conventions, units, scale, priors, targets and names of frames. Other options raise if they
        are set.

    Returns
    -------
    Calibration
        With ``T_world_world``: where the child's world is in the parent's.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than three stops.
    InputError
        If the poses are none, or not as many on both sides.
    ConfigError
        For an option that has no meaning for stops.

    Examples
    --------
    >>> hand, camera = parent.at(child.stamps_ns[10:800:20]), child[10:800:20]
    >>> hec.calibrate_stops(hand, camera.poses).T_world_world.shape
    (4, 4)
    """
    config = _usable(config)
    given = _given(Ts_world_parent, Ts_world_child, config, ("parent", "child"))
    solved = _solved(given, config)
    if solved.is_usable and not {"parent_invert", "child_invert"} & config.given:
        both = (
            "read as poses of both sensors in their worlds; if both hold inverse poses, which fit "
            "as well, give parent_invert poses and child_invert poses"
        )
        solved = replace(solved, warnings=(*solved.warnings, both))
    return _assessed(solved, ["parent", "child", "parent_world", "child_world"])


def calibrate_arm(
    robot: Any,
    tracking: Any,
    config: CalibratorConfig | None = None,
    names: Mapping[str, str] | None = None,
    setup: str | None = None,
) -> Calibration:
    """Calibrate a camera on a robot's hand, or beside the robot with the target on the hand.

    Without ``setup`` both places are tried: only one of them leaves small errors.

    Parameters
    ----------
    robot, tracking : array-likes
        Poses of the hand in the base (parent), and of the target in the camera (child), as MoveIt
        and easy_handeye2 have them. Matrices (N, 4, 4), rows (N, 7) of x, y, z, qx, qy, qz, qw, or
        a pair (R, t) as ``cv2.calibrateHandEye`` takes them: rotations (N, 3, 3) or rotation
        vectors (N, 3), and translations (N, 3).
    config : CalibratorConfig, optional
        Conventions, units, scale, priors, targets and names of frames. Other options raise if they
        are set.
    names : mapping of str to str, optional
        Names of the frames base, hand, camera, target.
    setup : {"hand", "beside"}, optional
        Where the camera is: on the hand or beside the robot. Default: as the samples fit.

    Returns
    -------
    Calibration
        The camera in the hand, and the target in the base; or the camera in the base, and the
        target in the hand.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than three stops.
    InputError
        If the poses are none, or not as many on both sides.
    ConfigError
        For an option that has no meaning for stops.

    Examples
    --------
    >>> samples = hec.read_arm_samples("samples.yaml")
    >>> hec.calibrate_arm(samples.robot, samples.tracking).n_poses
    40
    """
    if not isinstance(names, Mapping | None):
        raise InputError(
            "calibrate_arm takes robot and tracking; give OpenCV's arrays as two pairs: "
            "calibrate_arm((R_gripper2base, t_gripper2base), (R_target2cam, t_target2cam))"
        )
    config = _usable(config)
    if setup is not None and setup not in SETUPS:
        raise ConfigError(f"setup must be one of {', '.join(SETUPS)}; got {shown_value(setup)}")
    named = {name: name for name in ("base", "hand", "camera", "target")} | dict(names or {})
    given = _given(robot, tracking, config, ("robot", "tracking"), is_arm=True)
    solved = _solved(given, config, setup)
    parent, world = ("base", "hand") if solved.is_inverse else ("hand", "base")
    findings = gravest_first((*solved.findings, *_contradictions(solved, setup)))
    solved = replace(solved, findings=findings)
    if solved.is_usable and not {"parent_invert", "child_invert"} <= config.given:
        doubts, warnings = _reading(solved, named)
        findings = gravest_first((*solved.findings, *doubts))
        solved = replace(solved, findings=findings)
        if not setup:
            solved = replace(solved, warnings=(*solved.warnings, *warnings))
    frames = [named[name] for name in (parent, "camera", world, "target")]
    return _assessed(solved, frames, "beside" if solved.is_inverse else "hand")


# ------------------------------------------------------------------ what is given


def _usable(config: CalibratorConfig | None) -> CalibratorConfig:
    """The options, of which those that mean nothing for stops may not be set."""
    if not isinstance(config, CalibratorConfig | None):
        raise InputError(
            f"the options are a CalibratorConfig; found {type(config).__name__}. Give OpenCV's "
            "arrays as two pairs: (R_gripper2base, t_gripper2base), (R_target2cam, t_target2cam)"
        )
    config = config or CalibratorConfig()
    for name, field in CalibratorConfig.__dataclass_fields__.items():
        is_obeyed = name in _OBEYED or name.startswith(_OBEYED_GROUPS)
        if name in config.given and not is_obeyed and getattr(config, name) != field.default:
            value = getattr(config, name)
            raise ConfigError(
                f"{option_name(field)} {value} has no meaning for stops, which have no order and "
                "one solver; leave it out"
            )
    if config.measured not in ("poses", "rotations"):
        raise ConfigError(f"stops need poses or rotations of both sides, not {config.measured}")
    return config


def _given(
    parent: Any,
    child: Any,
    config: CalibratorConfig,
    sides: tuple[str, str],
    is_arm: bool = False,
) -> GivenStops:
    """Both sides as checked stacks of poses."""
    poses = [pose_stack(values, side) for values, side in zip((parent, child), sides, strict=True)]
    counts = [len(Ts) for Ts in poses]
    if counts[0] != counts[1]:
        raise InputError(
            f"{counts[0]} poses of {sides[0]}, {counts[1]} of {sides[1]}: each stop needs one of "
            "both"
        )
    least = config.min_pairs if "min_pairs" in config.given else MIN_STOPS
    if counts[0] < least:
        raise NotEnoughDataError(
            f"{counts[0]} stops are too few: at least {least}, with rotations about two axes, are "
            "necessary; 15 or more are better"
        )
    has_positions = config.measured == "poses"
    if not has_positions:
        zeros = np.zeros((counts[0], 3))
        poses = [se3.from_rotation_translation(Ts[:, :3, :3], zeros) for Ts in poses]
    return GivenStops(poses[0], poses[1], is_arm, has_positions)


def _put_right(given: GivenStops, config: CalibratorConfig, child_unit: float) -> GivenStops:
    """Return the poses in the usual convention, in metres, from that of the options and a factor
    from the child's lengths to metres.
    """
    parent = se3.put_right(given.parent, config.parent_invert, config.parent_quaternion)
    child = se3.put_right(given.child, config.child_invert, config.child_quaternion)
    return replace(
        given, parent=scaled(parent, config.parent_scale), child=scaled(child, child_unit)
    )


# ------------------------------------------------------------------ the solve


def _solved(given: GivenStops, config: CalibratorConfig, setup: str | None = None) -> _Solved:
    """Check the stops, repair what is certain, solve, and estimate the scale if it matters."""
    unit = config.given_scale
    stops = _put_right(given, config, unit)
    examination = examine(stops)
    if config.scale in _FOUND_SCALES:
        examination, unit = _without_unit_of_child(examination)
    findings = []
    for found in examination.findings:
        if found.code != "ambiguous":
            findings.append(_as_set(found, config))
        elif not {*found.options} <= config.given:
            # Whoever sets the convention of both sides has decided.
            findings.append(found)
    settled = {found.code for found in examination.repairs if {*found.options} & config.given}
    repairs = []
    for repair in examination.repairs:
        if repair.code in settled:
            findings.append(_as_set(repair, config))
        else:
            repairs.append(repair)
    warnings = []
    for repair in repairs:
        options = _composed(repair, config)
        done = options_in_words(options)
        undo = options_in_words(defaults_of(options))
        warnings.append(f"repaired: {repair.what}. Solved with {done} (undo with {undo})")
        config = replace(config, **options)
        unit = float(options.get("scale", unit))
    stops = _put_right(given, config, unit)
    # The rough scale is that of lengths whose units are put right.
    scale = None if settled else examination.scale
    return _with_scale(stops, config, unit, scale, findings, warnings, setup)


def _without_unit_of_child(examination: Examination) -> tuple[Examination, float]:
    """Take the unit of the child's lengths out of the findings: it is part of a scale that is
    found. Return the rest, and the factor to metres.
    """
    unit = 1.0
    for found in (*examination.findings, *examination.repairs):
        if _is_unit_of_child(found):
            unit = float(found.options["scale"])
    findings = tuple(found for found in examination.findings if not _is_unit_of_child(found))
    repairs = tuple(found for found in examination.repairs if not _is_unit_of_child(found))
    return replace(examination, findings=findings, repairs=repairs), unit


def _is_unit_of_child(found: Finding) -> bool:
    return {*found.options} == {"scale"}


def _composed(repair: Finding, config: CalibratorConfig) -> dict[str, Any]:
    """The options of a repair; factors on top of those that are set."""
    options = dict(repair.options)
    if "parent_scale" in options:
        options["parent_scale"] = float(options["parent_scale"]) * config.parent_scale
    return options


def _as_set(found: Finding, config: CalibratorConfig) -> Finding:
    """A finding whose options go on top of those that the user has set."""
    options: dict[str, float | str] = {}
    for name, value in found.options.items():
        current = getattr(config, name)
        is_undone = current == value or {current, value} == {"wxyz", "yzwx"}
        if is_undone:
            # What was put right already, and needs it again or the contrary, was right before.
            options[name] = getattr(CalibratorConfig, name)
        elif isinstance(value, float) and isinstance(current, float):
            options[name] = value * current
        else:
            options[name] = value
    return replace(found, options=options)


def _with_scale(
    given: GivenStops,
    config: CalibratorConfig,
    base: float,
    rough_scale: float | None,
    findings: list[Finding],
    warnings: list[str],
    setup: str | None,
) -> _Solved:
    """Solve with the scale that the options ask for, or that the stops clearly show.

    The child's lengths are multiplied by ``base`` already.
    """
    wants_scale = config.scale == "estimate"
    if wants_scale and not given.has_positions:
        raise ConfigError("scale estimate needs positions; both sides have rotations alone")
    start = rough_scale or 1.0
    fit, stops, is_inverse, lead = _fit(given, start, setup)
    if setup and lead < -_READING_LEAD:
        other = "hand" if is_inverse else "beside"
        findings = [finding("setup", place=SETUPS[setup], other=SETUPS[other]), *findings]
    is_unusable = any(found.makes_unusable for found in findings)
    scale = 1.0
    sigma = 0.0
    is_determined = given.has_positions and turns_about_two_axes(given.parent)
    if wants_scale or (is_determined and not is_unusable):
        free = _with_free_scale(given, start, is_inverse)
        scale = free[2]
        sigma = free[3]
        off = _off_scale(scale, sigma, len(stops))
        is_auto = config.scale == "auto"
        is_clear = off > _SCALE_SHARE or (is_auto and base != 1.0)
        is_given = "scale" in config.given and config.scale not in _FOUND_SCALES
        is_size = 1.0 / _WRONG_SCALE < scale < _WRONG_SCALE
        is_used = wants_scale or (is_clear and is_size and not is_given)
        is_asked = wants_scale or (is_auto and is_size)
        if is_clear and not is_asked:
            findings = [*findings, scale_finding(base * scale, base * sigma)]
        if is_used:
            fit = free[0]
            stops = free[1]
            if not wants_scale:
                undo = "none" if base == 1.0 or is_auto else base
                warnings = [
                    *warnings,
                    f"solved with the child's lengths times {base * scale:.4f} +/- "
                    f"{base * sigma:.4f}; to take them as they are, give scale {undo}",
                ]
        else:
            scale = 1.0
            sigma = 0.0
    if scale == 1.0 and start != 1.0:
        fit, stops, is_inverse, lead = _fit(given, 1.0, setup)
    findings = [*findings, *_of_unknown(given, fit, findings)]
    return _Solved(
        fit=fit,
        stops=stops,
        is_inverse=is_inverse,
        config=config,
        scale=base * scale,
        scale_sigma=base * sigma,
        findings=gravest_first(findings),
        warnings=tuple(warnings),
        lead=lead,
    )


def _of_unknown(given: GivenStops, fit: RobotWorld, findings: list[Finding]) -> list[Finding]:
    """Why directions are unknown: the stops turn about one axis, or contradict each other."""
    if not turns_about_two_axes(given.parent):
        return [finding("turning_about_one_axis")] if given.has_positions else []
    is_unusable = any(found.makes_unusable for found in findings)
    rotations = given.parent[:, :3, :3]
    turned_rad = median(se3.rotation_angle(rotations[0].T @ rotations))
    if is_unusable or not fit.undetermined().size or turned_rad < _FAR_RAD:
        return []
    share = min(float(np.sqrt(3.0)) * fit.level_rad / turned_rad, 1.0)
    return [finding("disagreeing_stops", part="rotations", share=share)]


def _off_scale(scale: float, sigma: float, n_stops: int) -> float:
    """Return the share by which a scale differs from 1, beyond its errors."""
    share = sigma / scale
    by_noise = _BY_NOISE * n_stops * share**2
    lowest = np.log(scale) - _SCALE_SIGMAS * share
    highest = np.log(scale) + by_noise + _SCALE_SIGMAS * share
    return float(max(lowest, -highest, 0.0))


def _fit(
    given: GivenStops, scale: float, setup: str | None
) -> tuple[RobotWorld, Stops, bool, float]:
    """The likelier solution of both ways round, if both are possible, and its lead; with a setup
    its solution, whose lead may be negative.
    """
    fits = []
    for is_inverse in (False, True) if given.is_arm else (False,):
        stops = stops_of(given, Mistakes(is_inverse=is_inverse), scale)
        fits.append((solve(stops), stops, is_inverse))
    if setup is None:
        fits.sort(key=lambda fit: fit[0].objective)
    elif setup == "beside":
        fits.reverse()
    lead = fits[1][0].objective - fits[0][0].objective if given.is_arm else np.inf
    return *fits[0], lead


def _with_free_scale(
    given: GivenStops, scale: float, is_inverse: bool
) -> tuple[RobotWorld, Stops, float, float]:
    """Solution, stops, scale and its standard deviation, with the scale as one more value."""
    for _ in range(_SCALE_ROUNDS):
        stops = stops_of(given, Mistakes(is_inverse=is_inverse), scale)
        fit = solve(stops, stretch=np.inf)
        if not np.isfinite(fit.scale_sigma):
            break
        if abs(fit.scale_step) < _SMALL_STEP * fit.scale_sigma:
            break
        scale *= 1.0 + float(np.clip(fit.scale_step, -0.5, 1.0))
    return fit, stops, scale, scale * fit.scale_sigma


# ------------------------------------------------------------------ the result


def _contradictions(solved: _Solved, setup: str | None) -> list[Finding]:
    """Findings on an arm whose stops fit both setups, or whose sides are the same poses."""
    if solved.fit.undetermined().size:
        return []
    if _is_copy(solved):
        return [finding("copied_stops")]
    if not setup and solved.lead < _READING_LEAD:
        return [finding("both_readings")]
    return []


def _is_copy(solved: _Solved) -> bool:
    """Whether both mounts are the identity: no camera is at the origin of a hand or base, and no
    target at that of the other, with the same axes.
    """
    fit = solved.fit
    steps = np.r_[se3.log(fit.Ts_parent_child[0]), se3.log(fit.Ts_world_world[0])]
    least = np.tile(np.repeat([_IDENTITY_M, _IDENTITY_RAD], 3), 2)
    sigmas = np.sqrt(np.diag(fit.covariance))
    return bool(np.all(np.abs(steps) < np.maximum(least, _IDENTITY_SIGMAS * sigmas)))


def _reading(solved: _Solved, named: Mapping[str, str]) -> tuple[list[Finding], list[str]]:
    """Other readings of the samples that fit as well: a warning that says which was taken, and a
    finding if the lengths speak for another one.
    """
    camera, target, hand, base = (named[name] for name in ("camera", "target", "hand", "base"))
    on_parent_m = float(np.linalg.norm(solved.fit.Ts_parent_child[0][:3, 3]))
    on_world_m = float(np.linalg.norm(solved.fit.Ts_world_world[0][:3, 3]))
    setup = "beside" if solved.is_inverse else "hand"
    if solved.is_inverse:
        on_hand_m = on_world_m
        on_base_m = on_parent_m
        moving = target
        fixed = camera
    else:
        on_hand_m = on_parent_m
        on_base_m = on_world_m
        moving = camera
        fixed = target
    text = (
        f"read as a camera {SETUPS[setup]}; if that is wrong, one side or both hold inverse "
        "poses: give parent_invert poses (robot), child_invert poses (target), or both; or "
        "exchange both sides"
    )
    if not solved.fit.undetermined().size and solved.stops.Ts_world_child[:, :3, 3].any():
        is_odd = on_hand_m > _ON_HAND_M and on_base_m < _NEARER * on_hand_m
        if is_odd:
            what = f"{moving} would be {on_hand_m:.2g} m from {hand}, {fixed} {on_base_m:.2g} m "
            return [finding("reading", what=what + f"from {base}")], [text]
    return [], [text]


def _left_out(weights: FloatArray) -> Finding | None:
    """Return the finding that stops do not fit the others, with their numbers from 1."""
    numbers = [str(row + 1) for row in np.flatnonzero(weights == 0.0)]
    if not numbers:
        return None
    count = len(numbers)
    share = count / len(weights)
    if count > _MOST_NUMBERS:
        numbers = [*numbers[:_MOST_NUMBERS], f"{count - _MOST_NUMBERS} more"]
    return finding(
        "outlier_stops",
        severity=Severity.WARNING if share > _MANY_LEFT_OUT else Severity.NOTE,
        count=count,
        n_stops=len(weights),
        numbers=listing(numbers),
    )


def _assessed(solved: _Solved, frames: list[str], setup: str = "") -> Calibration:
    fit = solved.fit
    findings = solved.findings
    outliers = _left_out(fit.weights)
    if outliers and solved.is_usable:
        findings = gravest_first((*findings, outliers))
    stops = solved.stops
    config = solved.config
    X = fit.Ts_parent_child[0]
    Z = fit.Ts_world_world[0]
    parent, child, parent_world, child_world = frames
    covariance = fit.covariance[:6, :6]
    of_Z = fit.covariance[6:, 6:]
    unknown = fit.undetermined()
    if config.measured == "rotations":
        covariance = _without_positions(covariance)
        of_Z = _without_positions(of_Z)
        of_rotation = unknown[3:, np.linalg.norm(unknown[3:], axis=0) > _NEARER]
        unknown = np.zeros((6, 3 + of_rotation.shape[1]))
        unknown[:3, :3] = np.eye(3)
        unknown[3:, 3:] = of_rotation
    fused = fuse(combined(X, covariance, unknown), config.prior())
    errors = se3.log(se3.inverse(Z @ stops.Ts_world_child) @ stops.Ts_world_parent @ X)
    rows = np.arange(len(errors))
    residuals = Residuals(
        translation=errors[:, :3] @ X[:3, :3].T,
        rotation=errors[:, 3:],
        weights=fit.weights,
        start_ns=rows,
        end_ns=rows,
    )
    return calibration_of(
        fit,
        fused,
        residuals,
        rows,
        config,
        solved.warnings,
        T_method=X,
        measured=config.measured,
        reference="stops",
        stamp_ns=0,
        findings=findings,
        scale=solved.scale,
        scale_sigma=solved.scale_sigma,
        parent_frame=config.parent_frame or parent,
        child_frame=config.child_frame or child,
        parts={"worlds": Worlds(Z, of_Z, parent_world, child_world, setup)},
    )


def _without_positions(covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a transform whose translation is not known."""
    without = np.diag(UNKNOWN_SIGMAS**2)
    without[3:, 3:] = covariance[3:, 3:]
    return without
