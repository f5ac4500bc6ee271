"""Calibrate an arm or two sensors from stops: check and solve ``A X = Z B``, assess the result."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.covariance import UNKNOWN_SIGMAS, combined
from hand_eye_calib.core.assessment.prior import fuse
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    NotEnoughDataError,
    require_type,
)
from hand_eye_calib.core.base.option import option_name
from hand_eye_calib.core.base.text import shown_value
from hand_eye_calib.core.checks.findings import Finding, finding
from hand_eye_calib.core.engine.estimation import calibration_of
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import pose_stack
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import Residuals
from hand_eye_calib.extras.stops.checks import MIN_LEAD
from hand_eye_calib.extras.stops.next_stops import advice_in_words, next_stops
from hand_eye_calib.extras.stops.outliers import check_left_out
from hand_eye_calib.extras.stops.robot_world import MIN_STOPS, RobotWorld
from hand_eye_calib.extras.stops.rough_fit import StopPoses
from hand_eye_calib.extras.stops.solving import (
    SetupFit,
    SolvedStops,
    inversions_in_words,
    solve_checked,
)
from hand_eye_calib.extras.stops.stop_table import StopTable, stop_table
from hand_eye_calib.extras.stops.worlds import SETUPS, Worlds
from hand_eye_calib.offline.calibrate import prior_fields

# Options that apply to stops.
_OBEYED = {"min_pairs", "parent_frame", "child_frame", "scale", "parent_scale"}
_OBEYED |= {
    f"{stream}_{name}"
    for stream in ("parent", "child")
    for name in ("invert", "quaternion", "measures")
}
# First parts of the names of further options that apply to stops.
_OBEYED_GROUPS = ("prior_", "target_")

# Options that declare inverse poses.
_INVERSIONS = {"parent_invert", "child_invert"}

# X and Z are the identity if each value is below this number of standard deviations ...
_IDENTITY_SIGMAS = 3.0
# ... or below this limit (m, rad).
_MIN_IDENTITY = 0.001

# Poses of an arm may be inverse if the sensor or target on the hand is farther from the hand than
# this (m) ...
_MAX_ON_HAND_M = 0.3
# ... and the other object is nearer to the base than this share of the distance to the hand.
_MAX_BASE_RATIO = 0.5

# An unobservable direction, a unit vector of translation and rotation, counts as a rotation if its
# rotation part is longer than this.
_ROTATION_PART = 0.5


def calibrate_stops(
    Ts_world_parent: Any,
    Ts_world_child: Any,
    config: CalibratorConfig | None = None,
    **options: Any,
) -> Calibration:
    """Calibrate two sensors from stops: pairs of poses in any order.

    Parameters
    ----------
    Ts_world_parent, Ts_world_child : array-likes
        Poses of both sensors, each in its own world. For a robot: the hand in the base of the
        robot, and the camera on the hand in the frame of a target. Matrices (N, 4, 4), rows (N, 7)
        of x, y, z, qx, qy, qz, qw, or a pair (R, t) of rotations (N, 3, 3) or rotation vectors (N,
        3) and translations (N, 3).
    config : CalibratorConfig, optional
        Options for conventions, units, scale, priors, targets and names of frames. Any other option
        raises an error if it is set.
    **options
        The same options as keywords of :func:`hand_eye_calib.calibrate`, without ``config``.

    Returns
    -------
    Calibration
        With ``T_world_world``: the pose of the child's world in the parent's world.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than three stops.
    InputError
        If the arrays are not poses, or have different lengths.
    ConfigError
        If an option is set that has no effect on stops.

    Examples
    --------
    >>> hand, camera = parent.at(child.stamps_ns[10:800:20]), child[10:800:20]
    >>> hec.calibrate_stops(hand, camera.poses).T_world_world.shape
    (4, 4)
    """
    config = _checked(config, options)
    poses = _checked_poses(
        {"parent": Ts_world_parent, "child": Ts_world_child}, config
    )
    solved = solve_checked(poses, config)
    warnings = list(solved.warnings)
    if solved.is_usable and not _INVERSIONS & config.given:
        warnings.append(
            "read as poses of both sensors in their worlds; if both hold inverse poses, which fit "
            "as well, give parent_invert poses and child_invert poses"
        )
    frames = _Frames("parent", "child", "parent_world", "child_world")
    return _calibration_of(solved, warnings, frames)


def _names_of_frames(names: Any) -> dict[str, str]:
    """Return the names of the frames of an arm, by default base, hand, camera and target."""
    if names is not None:
        require_type("names", names, Mapping)
    named = {name: name for name in ("base", "hand", "camera", "target")}
    return named | (names or {})


def calibrate_arm(
    robot: Any,
    tracking: Any = None,
    config: Any = None,
    names: Any = None,
    setup: str | None = None,
    **options: Any,
) -> Calibration:
    """Calibrate a camera on a robot's hand, or beside a robot that holds the target.

    Without ``setup``, both places of the camera are tried, and the likelier place is used. The four
    arrays of ``cv2.calibrateHandEye`` are accepted in the same order:
    ``calibrate_arm(R_gripper2base, t_gripper2base, R_target2cam, t_target2cam)``.

    Parameters
    ----------
    robot, tracking : array-likes
        Poses of the hand in the base (parent), and of the target in the camera (child), in the
        forms of :func:`calibrate_stops`. To set options for arrays of OpenCV, use pairs (R, t).
    config : CalibratorConfig, optional
        See :func:`calibrate_stops`, also for ``options``.
    names : mapping of str to str, optional
        Names of the frames base, hand, camera, target.
    setup : {"hand", "beside"}, optional
        Place of the camera: on the hand or beside the robot.

    Returns
    -------
    Calibration
        Pose of the camera in the hand, and of the target in the base. With the camera beside the
        robot: pose of the camera in the base, and of the target in the hand.

    Raises
    ------
    NotEnoughDataError, InputError, ConfigError
        See :func:`calibrate_stops`. ConfigError also for an unknown setup.

    Examples
    --------
    >>> samples = hec.read_arm_samples("samples.yaml")
    >>> hec.calibrate_arm(samples.robot, samples.tracking).n_poses
    40
    """
    if tracking is None:
        raise InputError(
            "the poses of the target are missing: pass robot and tracking; a file has both: "
            "samples = hec.read_arm_samples(path), then samples.robot, samples.tracking"
        )
    if _are_arrays_of_opencv(config, names):
        robot, tracking = (robot, tracking), (config, names)
        config = names = None
    config = _checked(config, options)
    if setup is not None and setup not in SETUPS:
        raise ConfigError(
            f"setup must be one of {', '.join(SETUPS)}; got {shown_value(setup)}"
        )
    named = _names_of_frames(names)
    poses = _checked_poses({"robot": robot, "tracking": tracking}, config)
    poses = replace(poses, is_arm=True, has_target=True)
    return _calibrated_arm(poses, config, named, setup)


def calibrate_hand_and_camera(
    Ts_base_hand: Any,
    Ts_target_camera: Any,
    config: CalibratorConfig,
    setup: str | None = None,
) -> Calibration:
    """Calibrate an arm like :func:`calibrate_arm`, from poses of the camera in the target.

    Poses of the target in a camera on the hand look like poses of a camera beside the robot.
    Therefore a camera beside the robot needs the option ``setup``.
    """
    config = _checked(config, {})
    poses = _checked_poses(
        {"hand": Ts_base_hand, "camera": Ts_target_camera}, config
    )
    return _calibrated_arm(
        replace(poses, is_arm=True), config, _names_of_frames(None), setup
    )


def _calibrated_arm(
    poses: StopPoses,
    config: CalibratorConfig,
    named: Mapping[str, str],
    setup: str | None,
) -> Calibration:
    """Return the result of an arm. ``named`` has the frames base, hand, camera and target."""
    solved = solve_checked(poses, config, setup)
    setup_fit = solved.setup_fit
    solved = solved.adding(*_check_setup(setup_fit, setup))
    is_declared = poses.has_target or setup or config.given & _INVERSIONS
    if setup_fit.is_inverse and not is_declared:
        solved = solved.adding(finding("beside_or_inverse", "child"))
    warnings = list(solved.warnings)
    has_both_inversions = config.given >= _INVERSIONS
    if solved.is_usable and not has_both_inversions:
        if not setup:
            warnings.append(_setup_in_words(setup_fit, config))
        solved = solved.adding(*_check_distances(setup_fit, named, config))
    return _calibration_of(
        solved, warnings, _frames_of_arm(named, setup_fit.is_inverse)
    )


# ------------------------------------------------------------------ options and poses


def _are_arrays_of_opencv(config: Any, names: Any) -> bool:
    """Return whether the third and fourth argument are arrays: R_target2cam, t_target2cam."""
    has_options = isinstance(config, CalibratorConfig | None)
    has_names = isinstance(names, Mapping | None)
    return not (has_options or has_names)


def _checked(
    config: CalibratorConfig | None, options: Mapping[str, Any]
) -> CalibratorConfig:
    """Return the options in ``config``, the options in keywords, or the default options.

    Raises
    ------
    InputError
        If the options are not a CalibratorConfig; they may be an array of OpenCV.
    ConfigError
        If an option is set that has no effect on stops, or if both kinds of options are present.
    """
    if config is not None and options:
        raise ConfigError(
            f"give {', '.join(options)} in config, or without config as keywords"
        )
    if options:
        prior = prior_fields(options.get("prior", {}))
        others = {
            name: value for name, value in options.items() if name != "prior"
        }
        config = CalibratorConfig(**{**others, **prior})
    if not isinstance(config, CalibratorConfig | None):
        raise InputError(
            f"the options are a CalibratorConfig; found {type(config).__name__}. Arrays of OpenCV "
            "are R_gripper2base, t_gripper2base, R_target2cam, t_target2cam"
        )
    config = config or CalibratorConfig()
    for name in sorted(config.given - _OBEYED):
        field = CalibratorConfig.__dataclass_fields__[name]
        if not name.startswith(_OBEYED_GROUPS):
            raise ConfigError(
                f"{option_name(field)} {getattr(config, name)} has no meaning for "
                "stops, which have no order and one solver; leave it out"
            )
    if config.measured not in ("poses", "rotations"):
        raise ConfigError(
            f"stops need poses or rotations of both sides, not {config.measured}"
        )
    return config


def _checked_poses(
    sides: Mapping[str, Any], config: CalibratorConfig
) -> StopPoses:
    """Return the poses of parent and child as stacks. ``sides`` has their values by name.

    Positions are zero if only rotations are measured.
    """
    parent, child = [pose_stack(values, side) for side, values in sides.items()]
    n_stops = len(parent)
    if n_stops != len(child):
        parent_name, child_name = sides
        raise InputError(
            f"{n_stops} poses of {parent_name}, {len(child)} of {child_name}: each stop needs one "
            "of both"
        )
    fewest = config.min_pairs if "min_pairs" in config.given else MIN_STOPS
    if n_stops < fewest:
        raise NotEnoughDataError(
            f"{n_stops} stops are too few: at least {fewest}, with rotations about two axes, are "
            "necessary; 15 or more are better"
        )
    has_positions = config.measured == "poses"
    if not has_positions:
        zeros = np.zeros((n_stops, 3))
        parent = se3.from_rotation_translation(se3.rotation_of(parent), zeros)
        child = se3.from_rotation_translation(se3.rotation_of(child), zeros)
    return StopPoses(parent, child, has_positions=has_positions)


# ------------------------------------------------------------------ findings about the fit


def _check_setup(setup_fit: SetupFit, setup: str | None) -> list[Finding]:
    """Return a finding if both sides of an arm have equal poses, or if both setups fit equally."""
    if setup_fit.fit.undetermined().size:
        return []
    if _is_copy(setup_fit.fit):
        return [finding("copied_stops")]
    if not setup and setup_fit.lead < MIN_LEAD:
        return [finding("both_readings")]
    return []


def _is_copy(fit: RobotWorld) -> bool:
    """Return whether X and Z are the identity, which means that both sides have the same poses.

    With a real arm, camera and target are not both at the origins of hand and base.
    """
    offsets = np.r_[se3.log(fit.T_parent_child), se3.log(fit.T_world_world)]
    sigmas = np.sqrt(np.diag(fit.covariance))
    return bool(
        np.all(
            np.abs(offsets)
            < np.maximum(_MIN_IDENTITY, _IDENTITY_SIGMAS * sigmas)
        )
    )


def _setup_in_words(setup_fit: SetupFit, config: CalibratorConfig) -> str:
    """Return the assumed place of the camera in words, with the options for inverse poses."""
    place = SETUPS["beside" if setup_fit.is_inverse else "hand"]
    return (
        f"read as a camera {place}; if that is wrong, one side or both have inverse poses: "
        f"{inversions_in_words(config)}; or exchange both sides"
    )


def _check_distances(
    setup_fit: SetupFit, frames: Mapping[str, str], config: CalibratorConfig
) -> list[Finding]:
    """Return a finding if distances of camera and target suggest inverse poses.

    Inverse poses are likely if the camera or target on the hand is far from the hand, while the
    other one is near the base. ``frames`` has the names of base, hand, camera and target.
    """
    fit = setup_fit.fit
    if (
        fit.undetermined().size
        or not se3.translation_of(setup_fit.stops.Ts_world_child).any()
    ):
        return []
    on_hand_m = float(np.linalg.norm(se3.translation_of(fit.T_parent_child)))
    from_base_m = float(np.linalg.norm(se3.translation_of(fit.T_world_world)))
    moving = frames["camera"]
    fixed = frames["target"]
    if setup_fit.is_inverse:
        on_hand_m, from_base_m = from_base_m, on_hand_m
        moving, fixed = fixed, moving
    if (
        on_hand_m <= _MAX_ON_HAND_M
        or from_base_m >= _MAX_BASE_RATIO * on_hand_m
    ):
        return []
    what = (
        f"{moving} would be {on_hand_m:.2g} m from {frames['hand']}, {fixed} {from_base_m:.2g} m "
        f"from {frames['base']}"
    )
    return [finding("reading", what=what, todo=inversions_in_words(config))]


# ------------------------------------------------------------------ the result


class _Frames(NamedTuple):
    """Default names of both sensors' frames and of their worlds, and the setup of an arm.

    ``setup`` is "hand" or "beside" for an arm; empty otherwise.
    """

    parent: str
    child: str
    parent_world: str
    child_world: str
    setup: str = ""


def _frames_of_arm(names: Mapping[str, str], is_beside: bool) -> _Frames:
    """Return the frames of an arm. ``names`` has the names of base, hand, camera and target."""
    if is_beside:
        return _Frames(
            names["base"],
            names["camera"],
            names["hand"],
            names["target"],
            "beside",
        )
    return _Frames(
        names["hand"], names["camera"], names["base"], names["target"], "hand"
    )


def _calibration_of(
    solved: SolvedStops, warnings: Sequence[str], frames: _Frames
) -> Calibration:
    """Return the result: the fit combined with the prior, with residuals, findings and advice."""
    fit = solved.setup_fit.fit
    stops = solved.setup_fit.stops
    config = solved.config
    if solved.is_usable:
        solved = solved.adding(*check_left_out(fit, stops))
    X = fit.T_parent_child
    Z = fit.T_world_world
    covariance_X = fit.covariance[:6, :6]
    covariance_Z = fit.covariance[6:, 6:]
    unknown = fit.undetermined()
    if config.measured == "rotations":
        covariance_X = _without_positions(covariance_X)
        covariance_Z = _without_positions(covariance_Z)
        unknown = _with_unknown_positions(unknown)
    fused = fuse(combined(X, covariance_X, unknown), config.prior())
    errors = se3.log(
        se3.inverse(Z @ stops.Ts_world_child) @ stops.Ts_world_parent @ X
    )
    rows = np.arange(len(errors))
    residuals = Residuals(
        translation=errors[:, :3] @ se3.rotation_of(X).T,
        rotation=errors[:, 3:],
        weights=fit.weights,
        start_ns=rows,
        end_ns=rows,
    )
    worlds = Worlds(
        Z, covariance_Z, frames.parent_world, frames.child_world, frames.setup
    )
    table = StopTable(stop_table(errors, fit.weights, stops.Ts_world_child))
    if solved.is_usable:
        table = _with_advice(table, solved, frames)
    return calibration_of(
        fit,
        fused,
        residuals,
        rows,
        config,
        tuple(warnings),
        T_method=X,
        measured=config.measured,
        reference="stops",
        stamp_ns=0,
        findings=solved.findings,
        scale=solved.setup_fit.scale,
        scale_sigma=solved.setup_fit.scale_sigma,
        parent_frame=config.parent_frame or frames.parent,
        child_frame=config.child_frame or frames.child,
        parts={"worlds": worlds, "stops": table},
    )


def _with_advice(
    table: StopTable, solved: SolvedStops, frames: _Frames
) -> StopTable:
    """Return the table of stops, with advice about the next stops to record."""
    config = solved.config
    is_beside = frames.setup == "beside"
    hand = config.parent_frame or frames.parent
    if is_beside:
        hand = frames.parent_world
    targets = np.repeat([config.target_translation, config.target_rotation], 3)
    setup_fit = solved.setup_fit
    start, following = next_stops(
        setup_fit.stops, setup_fit.fit, hand, is_beside, targets
    )
    advice = advice_in_words(start + 1, following)
    return replace(table, start=start + 1, next=following, advice=advice)


def _without_positions(covariance: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) whose translation is replaced by an unknown translation."""
    without = np.diag(UNKNOWN_SIGMAS**2)
    without[3:, 3:] = covariance[3:, 3:]
    return without


def _with_unknown_positions(unknown: FloatArray) -> FloatArray:
    """Return the unobservable directions (6, K) if only rotations are measured.

    They are the three translations, and the rotations among the unknown directions (6, K).
    """
    is_rotation = np.linalg.norm(unknown[3:], axis=0) > _ROTATION_PART
    rotations = unknown[3:, is_rotation]
    directions = np.zeros((6, 3 + rotations.shape[1]))
    directions[:3, :3] = np.eye(3)
    directions[3:, 3:] = rotations
    return directions
