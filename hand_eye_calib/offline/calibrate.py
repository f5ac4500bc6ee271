"""Two whole trajectories in, the extrinsic out: the Python function :func:`calibrate`."""

import inspect
import textwrap
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Literal, TypeAlias

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.option import option_name
from hand_eye_calib.core.base.text import AXIS_UNITS, Prior, shown_value
from hand_eye_calib.core.engine.cross_check import compare_answers, other_answers
from hand_eye_calib.core.engine.run import Progress, run
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry.trajectory import Trajectory, TrajectoryLike
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import CrossCheck

MethodName: TypeAlias = Literal[
    "auto", "dnlo", "dnl", "park", "taylor", "zhuang", "ali", "adaptive", "robust"
]
_Measures: TypeAlias = Literal["auto", "poses", "positions", "rotations", "rates"]
_Invert: TypeAlias = Literal["none", "poses", "orientations"]
_Kind: TypeAlias = Literal["odometry", "exact"]
_Order: TypeAlias = Literal["xyzw", "wxyz", "yzwx"]


def calibrate(
    parent: TrajectoryLike,
    child: TrajectoryLike,
    *,
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
    target_translation: float | None = None,
    target_rotation: float | None = None,
    target_axes: str | None = None,
    parent_frame: str | None = None,
    child_frame: str | None = None,
    checks: bool | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Estimate the pose of the child sensor in the parent sensor's frame from two trajectories.

    All pose pairs are used, up to 100,000, unless ``max_pairs`` is given. The streams are checked,
    too: what a check is sure of, such as a clock offset, a unit or inverse poses, is used if it was
    not given, and a warning says so.

    Parameters
    ----------
    parent, child : Trajectory, path, array or DataFrame
        Poses of each sensor in its own world, m; what is no Trajectory is read as
        :func:`hand_eye_calib.read_trajectory` does, and sensors are named after their files. One
        of them may be positions (:meth:`Trajectory.from_positions`): the result is the lever arm.
        Either may be rotations or angular rates (:meth:`Trajectory.from_rates`): the result is the
        rotation, with the bias of the rates.
    prior : mapping of str to (float, float) or str, optional
        Value and standard deviation of x, y, z (m), roll, pitch or yaw (rad), such as
        ``{"z": (1.85, 0.02)}``; see :data:`~hand_eye_calib.core.base.text.Prior`.
    checks : bool, optional
        False: the streams are not checked, the result is not compared with other references and
        halves of the recording, and nothing is solved a second time. True: it is compared also if
        a reference is given, which leaves that out otherwise.
    progress : callable, optional
        Called with the share that is done, 0 to 1, and the step that begins.
    OPTIONS

    Raises
    ------
    ConfigError
        If an option has a value that is not allowed.
    InputError
        If an argument is no trajectory or both are of one sensor frame.
    NotEnoughDataError
        If too few poses can be paired.

    Examples
    --------
    >>> result = hec.calibrate("lidar.tum", "camera.tum", prior={"z": (0.5, 0.05)})
    >>> result.parent_frame, result.child_frame
    ('lidar', 'camera')
    """
    values = {name: value for name, value in locals().items() if value is not None}
    first = parent
    second = child
    if not (isinstance(first, Trajectory) and isinstance(second, Trajectory)):
        from hand_eye_calib.formats.trajectory_files.reading import read_trajectories

        first, second = read_trajectories(first, second)
    values |= prior_fields({} if prior is None else prior)
    named = [each for each in fields(CalibratorConfig) if each.name in values]
    given = {option_name(each): values[each.name] for each in named}
    found = run(whole_snapshot(first, second, given), checks=checks, progress=progress)
    return replace(found.calibration, recording=found.snapshot)


def _options_in_words() -> str:
    """The options of :func:`calibrate` for its docstring, from where they are declared."""
    names = inspect.signature(calibrate).parameters
    lines = []
    for field in fields(CalibratorConfig):
        if field.name in names:
            meta = field.metadata
            default = repr(field.default) if field.default != "" else "none"
            unit = f" {meta['unit']}" if meta["unit"] else ""
            kind = " or ".join(map(repr, meta["choices"] or ())) or type(field.default).__name__
            lines += [f"{field.name} : {kind}, optional"]
            lines += textwrap.wrap(f"{meta['doc']} Default: {default}{unit}.", 92)
    return "\n    ".join(f"{'' if ' : ' in line else '    '}{line}" for line in lines)


if calibrate.__doc__:  # not with python -OO
    calibrate.__doc__ = calibrate.__doc__.replace("OPTIONS", _options_in_words())


def prior_fields(prior: Prior) -> dict[str, str]:
    """Options of a CalibratorConfig that state a prior: the text of each attribute.

    Raises
    ------
    ConfigError
        If an axis is unknown or its value is not a text or a pair of numbers.
    """
    if not isinstance(prior, Mapping):
        raise ConfigError(
            f"prior must be a mapping such as {{'z': (1.85, 0.02)}}; got {shown_value(prior)}"
        )
    fields = {}
    for axis, known in prior.items():
        if axis not in AXIS_UNITS:
            raise ConfigError(f"prior takes {', '.join(AXIS_UNITS)}; got {axis!r}")
        if not isinstance(known, str):
            try:
                value, sigma = map(float, known)
            except (TypeError, ValueError):
                raise ConfigError(
                    f"prior {axis} must be (value, standard deviation) or a text; got {known!r}"
                ) from None
            known = f"{value!r}+/-{sigma!r}"
        fields[f"prior_{axis}"] = known
    return fields


def cross_check(
    calibration: Calibration,
    parent: Trajectory,
    child: Trajectory,
    config: CalibratorConfig | None = None,
) -> CrossCheck:
    """Cross-check a result with DNLO at other references and with both halves of its recording, as
    every solve with method or reference auto does by itself.

    Parameters
    ----------
    calibration : Calibration
        The result.
    parent, child : Trajectory
        The trajectories that gave it.
    config : CalibratorConfig, optional
        The options that gave it; the defaults, with the result's method, if left out.

    Raises
    ------
    ConfigError
        If a stream is not one of poses.
    NotEnoughDataError
        If too few poses can be paired.

    Examples
    --------
    >>> scatter = hec.cross_check(result, parent, child)
    >>> list(scatter)
    ['x', 'y', 'z', 'roll', 'pitch', 'yaw']
    """
    snapshot = whole_snapshot(parent, child, {"method": calibration.method})
    config = config or snapshot.config
    config.require_poses("a cross-check")
    settled = replace(snapshot, config=replace(config, time_offset=calibration.time_offset_s))
    return compare_answers(calibration, *other_answers(calibration, config, settled.pose_pairs))
