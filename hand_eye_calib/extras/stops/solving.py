"""Solve stops: check them, repair certain mistakes, choose the setup, check the scale."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.findings import Finding, finding, repair_message
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.records import gravest_first, has_error
from hand_eye_calib.extras.stops.checks import MIN_LEAD, Examination, examine
from hand_eye_calib.extras.stops.closed_form import Stops
from hand_eye_calib.extras.stops.movement import check_movement
from hand_eye_calib.extras.stops.robot_world import RobotWorld, solve
from hand_eye_calib.extras.stops.rough_fit import (
    Mistakes,
    StopPoses,
    scaled,
    turns_about_two_axes,
)
from hand_eye_calib.extras.stops.worlds import SETUPS

# The scale of the child's lengths counts as different from 1 if the difference exceeds this number
# of standard deviations ...
_MIN_SCALE_SIGMAS = 3.0
# ... and this limit.
_MIN_SCALE_CHANGE = 0.01

# Largest factor between assumed and true size of a target. A larger scale has another cause.
_MAX_SIZE_RATIO = 10.0

# Largest number of iterations for the estimate of the scale.
_MAX_SCALE_ROUNDS = 10
# The iteration ends at a step below this share of the standard deviation of the scale.
_SMALL_STEP = 0.02

# Median rotation of stops (rad, 10 deg) above which every direction is observable for any camera.
# If a direction is unobservable then, the stops contradict each other.
_LARGE_TURN_RAD = 0.17


@dataclass(frozen=True)
class SetupFit:
    """Fit of stops under one setup: for an arm, the camera on the hand or beside the robot.

    Attributes
    ----------
    fit : RobotWorld
        Result of the fit.
    stops : Stops
        Poses A and B of ``A X = Z B`` under the setup.
    is_inverse : bool
        Whether the poses of one side were inverted, because the camera is beside the robot.
    scale : float
        Factor by which the child's lengths were multiplied.
    scale_sigma : float
        Standard deviation of ``scale``; 0 if the scale was not estimated.
    lead : float
        Log likelihood of this setup minus that of the other setup.
    """

    fit: RobotWorld
    stops: Stops
    is_inverse: bool
    scale: float = 1.0
    scale_sigma: float = 0.0
    lead: float = np.inf


@dataclass(frozen=True)
class SolvedStops:
    """Solved stops: the fit, the options with repairs, the findings and the warnings."""

    setup_fit: SetupFit
    config: CalibratorConfig
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]

    @property
    def is_usable(self) -> bool:
        """Whether no finding is an error."""
        return not has_error(self.findings)

    def adding(self, *findings: Finding) -> "SolvedStops":
        """Return a copy with further findings."""
        return replace(
            self, findings=gravest_first((*self.findings, *findings))
        )


@dataclass(frozen=True)
class _Repaired:
    """Stops after the repair of conventions and units.

    Attributes
    ----------
    poses : StopPoses
        Poses in the usual convention and in metres.
    config : CalibratorConfig
        Options of the user, together with the options of the repairs.
    unit : float
        Factor that converted the child's lengths to metres.
    rough_scale : float
        Further factor of the child's lengths from a rough fit, used as a start; 1 if unknown.
    findings, warnings : lists
        Findings, and warnings about repairs. The solve appends to both lists.
    """

    poses: StopPoses
    config: CalibratorConfig
    unit: float
    rough_scale: float
    findings: list[Finding]
    warnings: list[str]


def inversions_in_words(config: CalibratorConfig) -> str:
    """Return the options for inverse poses of an arm that the user can still set, in words."""
    sides = {"parent_invert": "robot", "child_invert": "target"}
    inverted = [name for name in sides if getattr(config, name) == "poses"]
    others = [
        f"{name} poses ({side})"
        for name, side in sides.items()
        if name not in inverted
    ]
    if not inverted:
        return f"give {', '.join(others)}, or both"
    if not others:
        return f"leave {' or '.join(inverted)} out, or both"
    return f"leave {inverted[0]} out, or give {others[0]} as well"


def solve_checked(
    poses: StopPoses, config: CalibratorConfig, setup: str | None = None
) -> SolvedStops:
    """Check stops, repair certain mistakes, and solve.

    Parameters
    ----------
    poses : StopPoses
        Poses in the conventions of the user's files.
    config : CalibratorConfig
        Options of the user.
    setup : {"hand", "beside"}, optional
        Place of the camera of an arm; by default the likelier place.

    Raises
    ------
    ConfigError
        If the scale must be estimated, but only rotations are measured.
    """
    if config.scale == "estimate" and not poses.has_positions:
        raise ConfigError(
            "scale estimate needs positions; both sides have rotations alone"
        )
    repaired = _repaired(poses, config)
    poses = repaired.poses
    findings = repaired.findings
    setup_fit = _likelier_setup(poses, repaired.rough_scale, setup)
    if setup and setup_fit.lead < -MIN_LEAD:
        other = "hand" if setup_fit.is_inverse else "beside"
        contradiction = finding(
            "setup",
            place=SETUPS[setup],
            other=SETUPS[other],
            setup=other,
            todo=inversions_in_words(config),
        )
        findings.insert(0, contradiction)
    setup_fit = _with_checked_scale(setup_fit, repaired, setup)
    findings = _with_movement(poses, setup_fit, findings)
    findings += _check_unknown(poses, setup_fit.fit, findings)
    setup_fit = replace(
        setup_fit,
        scale=repaired.unit * setup_fit.scale,
        scale_sigma=repaired.unit * setup_fit.scale_sigma,
    )
    return SolvedStops(
        setup_fit,
        repaired.config,
        gravest_first(findings),
        tuple(repaired.warnings),
    )


# ------------------------------------------------------------------ options and repairs


def _repaired(poses: StopPoses, config: CalibratorConfig) -> _Repaired:
    """Check stops. Repair certain mistakes, except where the user set the option."""
    is_scale_free = config.scale in ("auto", "estimate")
    examination = examine(
        _in_metres(poses, config, config.given_scale), is_scale_free
    )
    # An estimated scale contains the unit of the child's lengths.
    unit = config.given_scale * examination.child_unit
    findings, repairs = _with_user_options(examination, config)
    # The rough scale is valid only if all repairs are applied.
    is_whole = len(repairs) == len(examination.repairs)
    rough_scale = examination.scale if is_whole else None
    warnings = []
    if repairs:
        options = _options_of(repairs, config)
        warnings.append(repair_message(repairs, options))
        config = replace(config, **options)
        unit = float(options.get("scale", unit))
    poses = _in_metres(poses, config, unit)
    return _Repaired(
        poses, config, unit, rough_scale or 1.0, findings, warnings
    )


def _in_metres(
    poses: StopPoses, config: CalibratorConfig, child_unit: float
) -> StopPoses:
    """Return poses in metres and in the usual convention, according to the options.

    ``child_unit`` is the factor from the child's lengths to metres.
    """
    parent = se3.put_right(
        poses.parent, config.parent_invert, config.parent_quaternion
    )
    child = se3.put_right(
        poses.child, config.child_invert, config.child_quaternion
    )
    return replace(
        poses,
        parent=scaled(parent, config.parent_scale),
        child=scaled(child, child_unit),
    )


def _with_user_options(
    examination: Examination, config: CalibratorConfig
) -> tuple[list[Finding], list[Finding]]:
    """Return findings and repairs after a comparison with the options that the user set.

    A repair becomes a finding if the user set one of its options, or an option of another repair
    with the same code. An ambiguous finding is omitted if the user set all of its options.
    """
    findings = []
    for issue in examination.findings:
        is_decided = {*issue.options} <= config.given
        if issue.code != "ambiguous":
            findings.append(_with_user_values(issue, config))
        elif not is_decided:
            findings.append(issue)
    settled_codes = {
        issue.code
        for issue in examination.repairs
        if {*issue.options} & config.given
    }
    repairs = []
    for issue in examination.repairs:
        if issue.code in settled_codes:
            findings.append(_with_user_values(issue, config))
        else:
            repairs.append(issue)
    return findings, repairs


def _with_user_values(issue: Finding, config: CalibratorConfig) -> Finding:
    """Return a finding whose options include the values that the user set.

    The checks examine poses to which the user's options were already applied. So the option of a
    finding and the option of the user are combined: factors are multiplied, and two inverse
    conventions yield the default.
    """
    options: dict[str, float | str] = {}
    for name, value in issue.options.items():
        current = getattr(config, name)
        if current == value or {current, value} == {"wxyz", "yzwx"}:
            # The data were right, and the user's option made them wrong. The finding proposes the
            # inverse of the option. wxyz and yzwx are inverse to each other; every other convention
            # is its own inverse.
            options[name] = getattr(CalibratorConfig, name)
        elif isinstance(value, float) and isinstance(current, float):
            options[name] = value * current
        else:
            options[name] = value
    return replace(issue, options=options)


def _options_of(
    repairs: Sequence[Finding], config: CalibratorConfig
) -> dict[str, Any]:
    """Return the options of all repairs. ``parent_scale`` includes the factor of the user."""
    options: dict[str, Any] = {}
    for repair in repairs:
        options |= repair.options
    if "parent_scale" in options:
        options["parent_scale"] = (
            float(options["parent_scale"]) * config.parent_scale
        )
    return options


# ------------------------------------------------------------------ setup and scale


def _likelier_setup(
    poses: StopPoses, scale: float, setup: str | None
) -> SetupFit:
    """Return the fit of the setup that the user chose, or of the likelier setup.

    ``scale`` is a factor of the child's lengths.
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
        # The first fit is that of a camera on the hand.
        setup_fits.reverse()
    chosen, other = setup_fits
    return replace(chosen, lead=other.fit.objective - chosen.fit.objective)


def _determines_scale(poses: StopPoses, findings: Sequence[Finding]) -> bool:
    """Return whether the stops determine the scale of the child's lengths: two axes, no error."""
    return (
        not has_error(findings)
        and poses.has_positions
        and turns_about_two_axes(poses.parent)
    )


def _with_estimated_scale(poses: StopPoses, setup_fit: SetupFit) -> SetupFit:
    """Return the fit with an estimated scale of the child's lengths, by iterated linear steps."""
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
    return replace(
        setup_fit, fit=fit, stops=stops, scale=scale, scale_sigma=sigma
    )


def _with_checked_scale(
    setup_fit: SetupFit, repaired: _Repaired, setup: str | None
) -> SetupFit:
    """Return the fit with an estimated scale, or with the lengths of the child unchanged.

    The scale is estimated if it is clearly not 1, or if the user requests it. If it is clearly not
    1, and the option ``scale`` does not allow this, ``repaired`` gets a finding.
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
    if not (has_other_unit or _is_clearly_not_one(free)):
        return as_given
    is_size = 1.0 / _MAX_SIZE_RATIO < free.scale < _MAX_SIZE_RATIO
    scale = repaired.unit * free.scale
    sigma = repaired.unit * free.scale_sigma
    if not (is_auto and is_size):
        issue = finding(
            "target_scale", "child", scale=scale, sigma=sigma, times=1.0 / scale
        )
        repaired.findings.append(replace(issue, options={"scale": "estimate"}))
    if not is_size or config.is_known("scale"):
        return as_given
    repaired.warnings.append(
        _scale_in_words(scale, sigma, 1.0 if is_auto else repaired.unit)
    )
    return free


def _scale_in_words(scale: float, sigma: float, unit: float) -> str:
    """Return the estimated scale in words, with the option that leaves the lengths unchanged.

    ``unit`` is the factor from the child's lengths to metres if the option must contain it;
    otherwise 1.
    """
    option = "none" if unit == 1.0 else unit
    return (
        f"solved with the child's lengths times {scale:.4f} +/- {sigma:.4f}; to take them as they "
        f"are, give scale {option}"
    )


def _is_clearly_not_one(free: SetupFit) -> bool:
    """Return whether an estimated scale is clearly not 1."""
    change = abs(float(np.log(free.scale)))
    sigma = free.scale_sigma / free.scale
    return change > max(_MIN_SCALE_CHANGE, _MIN_SCALE_SIGMAS * sigma)


def _with_movement(
    poses: StopPoses, setup_fit: SetupFit, findings: list[Finding]
) -> list[Finding]:
    """Return the findings, with a movement of the camera or of the target if it is significant.

    The movement replaces the finding that stops disagree, if it is the only error. Otherwise the
    other errors may look like a movement.
    """
    others = [issue for issue in findings if issue.key != "disagreeing_stops"]
    if has_error(others) or not poses.has_positions:
        return findings
    if not turns_about_two_axes(poses.parent):
        return findings
    moved = check_movement(setup_fit.stops, setup_fit.fit, poses.is_arm)
    return [moved, *others] if moved else findings


def _check_unknown(
    poses: StopPoses, fit: RobotWorld, findings: Sequence[Finding]
) -> list[Finding]:
    """Return a finding if the motion leaves directions of X unobservable.

    Either the stops rotate about a single axis, or they contradict each other.
    """
    if not turns_about_two_axes(poses.parent):
        return (
            [finding("turning_about_one_axis")] if poses.has_positions else []
        )
    rotations = se3.rotation_of(poses.parent)
    turn_rad = median(se3.rotation_angle(rotations[0].T @ rotations))
    if (
        has_error(findings)
        or not fit.undetermined().size
        or turn_rad < _LARGE_TURN_RAD
    ):
        return []
    share = min(float(np.sqrt(3.0)) * fit.level_rad / turn_rad, 1.0)
    return [finding("disagreeing_stops", part="rotations", share=share)]
