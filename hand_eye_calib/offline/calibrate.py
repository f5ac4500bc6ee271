"""The Python functions :func:`calibrate` and :func:`cross_check`, for two whole trajectories."""

import inspect
import math
import re
import textwrap
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    UnclearStreamsError,
    require_type,
)
from hand_eye_calib.core.base.option import option_name
from hand_eye_calib.core.base.spelling import Interface, spelled
from hand_eye_calib.core.base.text import AXIS_UNITS, Prior, shown_value
from hand_eye_calib.core.engine.cross_check import (
    answers_of_halves,
    answers_of_whole,
    compare_answers,
)
from hand_eye_calib.core.engine.run import Progress, run
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry.span import Span
from hand_eye_calib.core.geometry.trajectory import (
    Trajectory,
    TrajectoryLike,
)
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import CrossCheck
from hand_eye_calib.formats.files import path_of
from hand_eye_calib.formats.saved_results import refuse_saved_result
from hand_eye_calib.offline.beside_motion import switched_off, with_measurements

MethodName: TypeAlias = Literal[
    "auto",
    "dnlo",
    "dnl",
    "park",
    "taylor",
    "zhuang",
    "ali",
    "adaptive",
    "robust",
]
_Measures: TypeAlias = Literal[
    "auto",
    "poses",
    "positions",
    "rotations",
    "rates",
    "wheels",
    "wheel_odometry",
    "steering",
    "tricycle",
    "omni",
    "driving",
]
_Invert: TypeAlias = Literal["none", "poses", "orientations"]
_Kind: TypeAlias = Literal["odometry", "exact"]
_Order: TypeAlias = Literal["xyzw", "wxyz", "yzwx"]

# Endings of files with trajectories or samples of an arm. They are not bags.
_TABLES = (".npz", ".json", ".samples", ".tum", ".txt", ".csv", ".yaml", ".yml")


def calibrate(
    parent: TrajectoryLike,
    child: TrajectoryLike | None = None,
    *,
    parent_topic: str | None = None,
    child_topic: str | None = None,
    start: float | None = None,
    end: float | None = None,
    method: MethodName | None = None,
    reference: str | None = None,
    backend: Literal["fast", "ipopt"] | None = None,
    threshold: float | None = None,
    min_inlier_fraction: float | None = None,
    min_pairs: int | None = None,
    max_pairs: int | None = None,
    keyframe_min_translation: float | None = None,
    keyframe_min_rotation: float | None = None,
    keyframe_min_interval: float | None = None,
    max_gap: float | None = None,
    time_offset: float | Literal["estimate"] | None = None,
    scale: float | Literal["none", "auto", "estimate"] | None = None,
    parent_scale: float | None = None,
    parent_measures: _Measures | None = None,
    child_measures: _Measures | None = None,
    parent_invert: _Invert | None = None,
    child_invert: _Invert | None = None,
    parent_quaternion: _Order | None = None,
    child_quaternion: _Order | None = None,
    parent_kind: _Kind | None = None,
    child_kind: _Kind | None = None,
    prior: Prior | None = None,
    nominal_radius: float | None = None,
    nominal_separation: float | None = None,
    target_translation: float | None = None,
    target_rotation: float | None = None,
    target_axes: str | None = None,
    parent_frame: str | None = None,
    child_frame: str | None = None,
    ground: Literal["auto", "off"] | None = None,
    checks: bool | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Estimate the pose of the child sensor in the parent sensor's frame from two trajectories.

    At most 100,000 pose pairs are used; ``max_pairs`` changes this limit. The streams are also
    checked. If a check is certain of a clock offset, a unit or inverse poses, it sets the option
    for the solve, and the result has a warning. An option that the caller sets is never changed.

    Parameters
    ----------
    parent, child : Trajectory, path, array or DataFrame
        Poses of each sensor in its own world, m. Anything except a Trajectory is read by
        :func:`hand_eye_calib.read_trajectory`; the sensors are named after their files. One of both
        may be positions (:meth:`Trajectory.from_positions`): the result is the lever arm. Either
        may be rotations or angular rates (:meth:`Trajectory.from_rates`): the result is the
        rotation, with the bias of the rates.
        A bag with both sensors is passed as ``parent``, without ``child``.
    parent_topic, child_topic : str, optional
        Topics of a bag, or frames such as "odom:lidar". They may be omitted if only one pair of
        streams is possible.
    start, end : float, optional
        Part of the recording to use: seconds after its start, which is the first instant at which
        both streams have poses. From 1e8 on, a stamp in seconds.
    prior : mapping of str to (float, float) or str, optional
        Value and standard deviation of x, y, z (m), roll, pitch or yaw (rad), such as
        ``{"z": (1.85, 0.02)}``; see :data:`~hand_eye_calib.core.base.text.Prior`.
    ground : {"auto", "off"}, optional
        Whether clouds or IMU data of both sensors in a bag measure z, roll and pitch, too; only for
        a bag. Default: auto.
    checks : bool, optional
        False: the streams are not checked, the result is not compared with other references and
        halves of the recording, and there is no second solve. True: the result is compared even if
        ``reference`` is set. By default, it is compared unless ``reference`` is set.
    progress : callable, optional
        Function that is called with the finished share of the work, 0 to 1, and the name of the
        next step.

    Raises
    ------
    ConfigError
        If an option has a value that is not allowed.
    InputError
        If an argument is not a trajectory, or if both have the same sensor frame.
    NotEnoughDataError
        If too few poses can be paired.

    Examples
    --------
    >>> result = hec.calibrate("lidar.tum", "camera.tum", prior={"z": (0.5, 0.05)})
    >>> result.parent_frame, result.child_frame
    ('lidar', 'camera')
    """
    values = {
        name: value for name, value in locals().items() if value is not None
    }
    _check_settings(progress, checks, ground, is_bag=child is None)
    first, second = _read_both(
        parent, child, {"parent": parent_topic, "child": child_topic}
    )
    span = Span.of(start, end)
    first, second = span.cut((first, second), ("the parent", "the child"))
    values |= prior_fields({} if prior is None else prior)
    options = {
        option_name(field): values[field.name]
        for field in fields(CalibratorConfig)
        if field.name in values
    }
    snapshot = whole_snapshot(first, second, options)
    if child is None:
        snapshot, notes = with_measurements(
            snapshot, [path_of("a bag", parent)], switched_off(values)
        )
        for text in notes:
            warnings.warn(text, UserWarning, stacklevel=2)
    result = run(snapshot, checks=checks, progress=progress)
    in_python = tuple(
        spelled(text, Interface.PYTHON) for text in result.calibration.warnings
    )
    return replace(
        result.calibration, warnings=in_python, recording=result.snapshot
    )


def _check_settings(
    progress: Any, checks: Any, ground: Any, is_bag: bool
) -> None:
    """Raise an error for arguments of :func:`calibrate` that are not allowed."""
    if progress is not None and not callable(progress):
        raise InputError(
            f"progress must be a function; got {type(progress).__name__}"
        )
    if checks is not None:
        require_type("checks", checks, bool)
    if ground not in (None, "auto", "off"):
        raise ConfigError(
            f"ground must be 'auto' or 'off'; got {shown_value(ground)}"
        )
    if ground is not None and not is_bag:
        raise ConfigError(
            "ground applies to a bag; for trajectories, call calibrate_on_ground"
        )


def _read_both(
    parent: TrajectoryLike,
    child: TrajectoryLike | None,
    topics: Mapping[str, str | None],
) -> Sequence[Trajectory]:
    """Return the trajectories of parent and child. Without a child, ``parent`` is a bag."""
    if parent is None:
        raise InputError(
            "the parent must be a trajectory, a file or a bag; got None"
        )
    if child is None and not isinstance(parent, str | PathLike):
        raise InputError(
            "a child is missing: pass two trajectories, or the path of a bag"
        )
    if child is None:
        return _read_bag(path_of("a bag without a child", parent), topics)
    for stream, topic in topics.items():
        if topic is not None:
            raise ConfigError(
                f"{stream}_topic is a topic of a bag: pass only the bag, no child"
            )
    if isinstance(parent, Trajectory) and isinstance(child, Trajectory):
        from hand_eye_calib.formats.trajectory_files.stamps import (
            require_nanoseconds,
        )

        require_nanoseconds("the parent", parent)
        require_nanoseconds("the child", child)
        return parent, child
    from hand_eye_calib.formats.trajectory_files.reading import (
        read_trajectories,
    )

    return read_trajectories(parent, child)


def _read_bag(
    path: Path, topics: Mapping[str, str | None]
) -> Sequence[Trajectory]:
    """Return the trajectories of both streams of a bag; notes become Python warnings."""
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.formats.bags.sources import source_of

    refuse_saved_result(path)
    if path.suffix in _TABLES and path.is_file():
        raise InputError(
            f"{path} is one file: pass the trajectories of both sensors; samples of an arm are for "
            "calibrate_arm, see read_arm_samples"
        )
    named = {}
    for stream, topic in topics.items():
        if topic is not None:
            require_type(f"{stream}_topic", topic, str)
            named[stream] = source_of(topic)
    trajectories = []
    notes: list[str] = []
    with PoseBag(path) as bag:
        try:
            sources = bag.select(named.get("parent"), named.get("child"))
        except UnclearStreamsError as error:
            options = ", ".join(
                f"{name}={topic!r}" for name, topic in error.options.items()
            )
            raise InputError(
                f"{error}. Set {options}" if options else str(error)
            ) from None
        if len(named) < len(sources):
            notes.append(f"parent is {sources[0]}, child is {sources[1]}")
        for source in sources:
            trajectory, repairs = bag.trajectory(source)
            trajectories.append(trajectory)
            notes += repairs
        notes += bag.warnings
    for text in notes:
        warnings.warn(text, UserWarning, stacklevel=4)
    return trajectories


def _options_in_words() -> list[str]:
    """Return the options among the parameters of :func:`calibrate`, as lines of its docstring."""
    names = inspect.signature(calibrate).parameters
    lines = []
    for field in fields(CalibratorConfig):
        if field.name not in names:
            continue
        default = repr(field.default) if field.default != "" else "none"
        if field.metadata["unit"]:
            default += f" {field.metadata['unit']}"
        choices = field.metadata["choices"] or ()
        kind = " or ".join(map(repr, choices)) or type(field.default).__name__
        lines.append(f"{field.name} : {kind}, optional")
        description = textwrap.wrap(
            f"{field.metadata['doc']} Default: {default}.", 92
        )
        lines += [f"    {line}" for line in description]
    return lines


def _with_options(docstring: str) -> str:
    """Return a docstring with all options at the end of its parameters."""
    parameters, heading, rest = re.split(
        r"(\n\n *Raises\n)", docstring, maxsplit=1
    )
    # Python 3.13 removes the indentation of docstrings.
    indentation = heading.strip("\n").removesuffix("Raises")
    options = "".join(f"\n{indentation}{line}" for line in _options_in_words())
    return parameters + options + heading + rest


# python -OO removes docstrings.
if calibrate.__doc__:
    calibrate.__doc__ = _with_options(calibrate.__doc__)


def prior_fields(prior: Prior) -> dict[str, str]:
    """Return the options that state a prior: attributes of CalibratorConfig, with their texts.

    Raises
    ------
    ConfigError
        If an axis is unknown, or its value is neither a text nor a pair of numbers.
    """
    if not isinstance(prior, Mapping):
        raise ConfigError(
            f"prior must be a mapping such as {{'z': (1.85, 0.02)}}; got {shown_value(prior)}"
        )
    options = {}
    for axis, value in prior.items():
        if axis not in AXIS_UNITS:
            raise ConfigError(
                f"prior takes {', '.join(AXIS_UNITS)}; got {axis!r}"
            )
        options[f"prior_{axis}"] = (
            value if isinstance(value, str) else _prior_text(axis, value)
        )
    return options


def _prior_text(axis: str, pair: Any) -> str:
    """Return a value and its standard deviation as the text of an option, ``VALUE+/-SIGMA``."""
    try:
        value, sigma = map(float, pair)
    except (TypeError, ValueError):
        raise ConfigError(
            f"prior {axis} must be (value, standard deviation) or a text such as '1.85+/-0.02'; "
            f"got {pair!r}"
        ) from None
    if AXIS_UNITS[axis] == "rad" and abs(value) > 2.0 * math.pi:
        raise ConfigError(
            f"prior {axis} is in rad; got {value:g}: for degrees write "
            f"'{value:g}deg+/-{sigma:g}deg', or convert both numbers with np.deg2rad"
        )
    return f"{value!r}+/-{sigma!r}"


def cross_check(
    calibration: Calibration,
    parent: Trajectory,
    child: Trajectory,
    config: CalibratorConfig | None = None,
) -> CrossCheck:
    """Compare a result with robust least squares on the whole recording and on both halves.

    With the method or the reference ``auto``, a solve already makes this comparison.

    Parameters
    ----------
    calibration : Calibration
        The result.
    parent, child : Trajectory
        Trajectories of the result.
    config : CalibratorConfig, optional
        Options of the result. Default: the defaults, with the result's method.

    Raises
    ------
    ConfigError
        If a stream has no poses.
    NotEnoughDataError
        If too few poses can be paired.

    Examples
    --------
    >>> scatter = hec.cross_check(result, parent, child)
    >>> list(scatter)
    ['x', 'y', 'z', 'roll', 'pitch', 'yaw']
    """
    require_type("calibration", calibration, Calibration)
    require_type("parent", parent, Trajectory)
    require_type("child", child, Trajectory)
    if config is not None:
        require_type("config", config, CalibratorConfig)
    snapshot = whole_snapshot(parent, child, {"method": calibration.method})
    config = config or snapshot.config
    config.require_poses("a cross-check")
    settled = replace(
        snapshot, config=replace(config, time_offset=calibration.time_offset_s)
    )
    settled.require_pairs()
    others = answers_of_whole(calibration, settled.pose_pairs)
    halves = answers_of_halves(calibration, settled.pose_pairs)
    return compare_answers(calibration, others, halves)
