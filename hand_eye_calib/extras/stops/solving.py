"""Solve of stops: check them, repair what is certain, choose the setup, settle the scale."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.findings import Finding, finding, repair_message
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.records import gravest_first, has_error
from hand_eye_calib.extras.stops.checks import MIN_LEAD, Examination, examine
from hand_eye_calib.extras.stops.closed_form import Stops
from hand_eye_calib.extras.stops.robot_world import RobotWorld, solve
from hand_eye_calib.extras.stops.rough_fit import (
    Mistakes,
    StopPoses,
    scaled,
    turns_about_two_axes,
)
from hand_eye_calib.extras.stops.worlds import SETUPS

# A scale is not 1 if its likelihood is that of so many standard deviations, and if it differs by
# this share.
_MIN_SCALE_SIGMAS = 3.0
_MIN_SCALE_CHANGE = 0.01

# A scale beyond this factor is not that of a target of another size.
_MAX_SIZE_RATIO = 10.0

# Rounds of the search for the scale; a step below this share of a standard deviation ends it.
_MAX_SCALE_ROUNDS = 10
_SMALL_STEP = 0.02

# Stops whose median rotation is larger than this (rad; 10 deg) determine all directions, unless
# their errors are larger than those of any camera.
_LARGE_TURN_RAD = 0.17


@dataclass(frozen=True)
class SetupFit:
    """Stops read with the camera at one place, and their fit.

    Attributes
    ----------
    fit : RobotWorld
    stops : Stops
    is_inverse : bool
        Whether one side is taken as inverse: for an arm, the camera is beside the robot.
    scale, scale_sigma : float
        Factor of the child's lengths and its standard deviation; 0 if it was not estimated.
    lead : float
        How much larger the objective of the other place of the camera is.
    """

    fit: RobotWorld
    stops: Stops
    is_inverse: bool
    scale: float = 1.0
    scale_sigma: float = 0.0
    lead: float = np.inf


@dataclass(frozen=True)
class SolvedStops:
    """Solved stops: their reading, and the options, findings and warnings that lead to it."""

    setup_fit: SetupFit
    config: CalibratorConfig
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]

    @property
    def is_usable(self) -> bool:
        """Whether no finding forbids the use of the result."""
        return not has_error(self.findings)

    def adding(self, *findings: Finding) -> "SolvedStops":
        """Return the solved stops with further findings."""
        return replace(self, findings=gravest_first((*self.findings, *findings)))


@dataclass(frozen=True)
class _Repaired:
    """Stops in the usual convention and in metres.

    Attributes
    ----------
    poses : StopPoses
    config : CalibratorConfig
        With the options that repair the stops.
    unit : float
        Factor that the child's lengths were multiplied by.
    rough_scale : float
        Further factor of the child's lengths, from a rough fit; 1 if it is unknown.
    findings, warnings : lists
        Findings, and warnings about repairs; the solve adds to both.
    """

    poses: StopPoses
    config: CalibratorConfig
    unit: float
    rough_scale: float
    findings: list[Finding]
    warnings: list[str]


def solve_checked(
    poses: StopPoses, config: CalibratorConfig, setup: str | None = None
) -> SolvedStops:
    """Check stops, repair what is certain, and solve.

    Parameters
    ----------
    poses : StopPoses
        In the conventions of their source.
    config : CalibratorConfig
    setup : {"hand", "beside"}, optional
        Place of the camera of an arm. Default: the likelier one.

    Raises
    ------
    ConfigError
        If the scale is to be estimated from rotations alone.
    """
    if config.scale == "estimate" and not poses.has_positions:
        raise ConfigError("scale estimate needs positions; both sides have rotations alone")
    repaired = _repaired(poses, config)
    poses = repaired.poses
    findings = repaired.findings
    setup_fit = _likelier_setup(poses, repaired.rough_scale, setup)
    if setup and setup_fit.lead < -MIN_LEAD:
        other = "hand" if setup_fit.is_inverse else "beside"
        findings.insert(0, finding("setup", place=SETUPS[setup], other=SETUPS[other]))
    setup_fit = _with_checked_scale(setup_fit, repaired, setup)
    findings += _check_unknown(poses, setup_fit.fit, findings)
    setup_fit = replace(
        setup_fit,
        scale=repaired.unit * setup_fit.scale,
        scale_sigma=repaired.unit * setup_fit.scale_sigma,
    )
    return SolvedStops(
        setup_fit, repaired.config, gravest_first(findings), tuple(repaired.warnings)
    )


# ------------------------------------------------------------------ options and repairs


def _repaired(poses: StopPoses, config: CalibratorConfig) -> _Repaired:
    """Check stops, and repair what is certain and not set by the user."""
    is_scale_free = config.scale in ("auto", "estimate")
    examination = examine(_in_metres(poses, config, config.given_scale), is_scale_free)
    # The unit of the child's lengths is a part of a scale that is estimated.
    unit = config.given_scale * examination.child_unit
    findings, repairs = _with_user_options(examination, config)
    # The rough scale is that of lengths whose units are put right.
    is_whole = len(repairs) == len(examination.repairs)
    rough_scale = examination.scale if is_whole else None
    warnings = []
    if repairs:
        options = _options_of(repairs, config)
        warnings.append(repair_message(repairs, options))
        config = replace(config, **options)
        unit = float(options.get("scale", unit))
    poses = _in_metres(poses, config, unit)
    return _Repaired(poses, config, unit, rough_scale or 1.0, findings, warnings)


def _in_metres(poses: StopPoses, config: CalibratorConfig, child_unit: float) -> StopPoses:
    """Return poses in the usual convention, by the options and the child's factor to metres."""
    parent = se3.put_right(poses.parent, config.parent_invert, config.parent_quaternion)
    child = se3.put_right(poses.child, config.child_invert, config.child_quaternion)
    return replace(
        poses, parent=scaled(parent, config.parent_scale), child=scaled(child, child_unit)
    )


def _with_user_options(
    examination: Examination, config: CalibratorConfig
) -> tuple[list[Finding], list[Finding]]:
    """Return findings and repairs; a repair of an option that the user set becomes a finding."""
    findings = []
    for issue in examination.findings:
        if issue.code != "ambiguous":
            findings.append(_with_user_values(issue, config))
        elif not {*issue.options} <= config.given:
            # A user who sets the conventions of both sides has decided.
            findings.append(issue)
    settled_codes = {issue.code for issue in examination.repairs if {*issue.options} & config.given}
    repairs = []
    for issue in examination.repairs:
        if issue.code in settled_codes:
            findings.append(_with_user_values(issue, config))
        else:
            repairs.append(issue)
    return findings, repairs


def _with_user_values(issue: Finding, config: CalibratorConfig) -> Finding:
    """Return a finding whose options include the values that the user set."""
    options: dict[str, float | str] = {}
    for name, value in issue.options.items():
        current = getattr(config, name)
        if current == value or {current, value} == {"wxyz", "yzwx"}:
            # A convention that is undone twice, or by its contrary, was right before.
            options[name] = getattr(CalibratorConfig, name)
        elif isinstance(value, float) and isinstance(current, float):
            options[name] = value * current
        else:
            options[name] = value
    return replace(issue, options=options)


def _options_of(repairs: Sequence[Finding], config: CalibratorConfig) -> dict[str, Any]:
    """Return the options of all repairs; parent_scale is multiplied by the factor of the user."""
    options: dict[str, Any] = {}
    for repair in repairs:
        options |= repair.options
    if "parent_scale" in options:
        options["parent_scale"] = float(options["parent_scale"]) * config.parent_scale
    return options


# ------------------------------------------------------------------ setup and scale


def _likelier_setup(poses: StopPoses, scale: float, setup: str | None) -> SetupFit:
    """Return the likelier reading of stops, or the reading of a setup.

    The lead of a setup is negative if the other one is likelier.
    """
    setup_fits = []
    for is_inverse in poses.possible_inversions:
        stops = poses.without(Mistakes(is_inverse=is_inverse), scale)
        setup_fits.append(SetupFit(solve(stops), stops, is_inverse, scale))
    if not poses.is_arm:
        return setup_fits[0]
    if setup is None:
        setup_fits.sort(key=lambda setup_fit: setup_fit.fit.objective)
    elif setup == "beside":
        setup_fits.reverse()
    chosen, other = setup_fits
    return replace(chosen, lead=other.fit.objective - chosen.fit.objective)


def _determines_scale(poses: StopPoses, findings: Sequence[Finding]) -> bool:
    """Return whether stops without errors determine the factor of the child's lengths."""
    return not has_error(findings) and poses.has_positions and turns_about_two_axes(poses.parent)


def _with_estimated_scale(poses: StopPoses, setup_fit: SetupFit) -> SetupFit:
    """Return a reading with the factor of the child's lengths estimated."""
    mistakes = Mistakes(is_inverse=setup_fit.is_inverse)
    scale = setup_fit.scale
    for _ in range(_MAX_SCALE_ROUNDS):
        stops = poses.without(mistakes, scale)
        fit = solve(stops, stretch=np.inf)
        if not np.isfinite(fit.scale_sigma):
            break
        if abs(fit.scale_step) < _SMALL_STEP * fit.scale_sigma:
            break
        scale *= 1.0 + float(np.clip(fit.scale_step, -0.5, 1.0))
    sigma = scale * fit.scale_sigma
    return replace(setup_fit, fit=fit, stops=stops, scale=scale, scale_sigma=sigma)


def _with_checked_scale(setup_fit: SetupFit, repaired: _Repaired, setup: str | None) -> SetupFit:
    """Return the reading with the child's lengths as they are, or times an estimated scale.

    A scale that is clearly not 1 becomes a finding, unless the user allows the scale to be
    estimated.
    """
    poses = repaired.poses
    config = repaired.config
    if config.scale == "estimate":
        return _with_estimated_scale(poses, setup_fit)
    as_given = setup_fit
    if setup_fit.scale != 1.0:
        as_given = _likelier_setup(poses, 1.0, setup)
    if not _determines_scale(poses, repaired.findings):
        return as_given
    free = _with_estimated_scale(poses, setup_fit)
    is_auto = config.scale == "auto"
    has_other_unit = is_auto and repaired.unit != 1.0
    if not (has_other_unit or _is_clearly_not_one(poses, free, as_given)):
        return as_given
    is_size = 1.0 / _MAX_SIZE_RATIO < free.scale < _MAX_SIZE_RATIO
    scale = repaired.unit * free.scale
    sigma = repaired.unit * free.scale_sigma
    is_allowed = is_auto and is_size
    if not is_allowed:
        issue = finding("target_scale", "child", scale=scale, sigma=sigma, times=1.0 / scale)
        repaired.findings.append(replace(issue, options={"scale": "estimate"}))
    if not is_size or config.is_known("scale"):
        return as_given
    undo: object = "none"
    if repaired.unit != 1.0 and not is_auto:
        undo = repaired.unit
    repaired.warnings.append(
        f"solved with the child's lengths times {scale:.4f} +/- {sigma:.4f}; to take them as they "
        f"are, give scale {undo}"
    )
    return free


def _is_clearly_not_one(poses: StopPoses, free: SetupFit, as_given: SetupFit) -> bool:
    """Return whether an estimated scale is certainly not 1, by the ratio of likelihoods."""
    if abs(np.log(free.scale)) < _MIN_SCALE_CHANGE:
        return False
    least_gain = 0.5 * _MIN_SCALE_SIGMAS**2 * free.fit.scale_inflation
    gain = as_given.fit.objective - free.fit.objective
    if free.scale < 1.0 and gain > least_gain:
        gain = _gain_in_measured_lengths(poses, free, as_given)
    return bool(gain > least_gain)


def _gain_in_measured_lengths(poses: StopPoses, free: SetupFit, as_given: SetupFit) -> float:
    """Return the largest gain of log likelihood by a scale between the estimated one and 1.

    Residuals of positions shrink with the child's lengths, and so does noise of these lengths. The
    log density of the lengths as they were measured has the term ``3 log(scale)`` for each stop.
    """
    mistakes = Mistakes(is_inverse=free.is_inverse)

    def objective(log_scale: float) -> float:
        fit = solve(poses.without(mistakes, float(np.exp(log_scale))))
        return fit.objective - 3.0 * len(poses) * log_scale

    bounds = (float(np.log(free.scale)), 0.0)
    best = minimize_scalar(objective, bounds=bounds, options={"xatol": _MIN_SCALE_CHANGE})
    return as_given.fit.objective - float(best.fun)


def _check_unknown(poses: StopPoses, fit: RobotWorld, findings: Sequence[Finding]) -> list[Finding]:
    """Return a finding if directions are unknown.

    Stops that turn about one axis leave directions unknown, and so do contradicting stops.
    """
    if not turns_about_two_axes(poses.parent):
        return [finding("turning_about_one_axis")] if poses.has_positions else []
    rotations = se3.rotation_of(poses.parent)
    turn_rad = median(se3.rotation_angle(rotations[0].T @ rotations))
    if has_error(findings) or not fit.undetermined().size or turn_rad < _LARGE_TURN_RAD:
        return []
    share = min(float(np.sqrt(3.0)) * fit.level_rad / turn_rad, 1.0)
    return [finding("disagreeing_stops", part="rotations", share=share)]
