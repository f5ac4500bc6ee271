"""Two whole trajectories in, the extrinsic out: the Python function :func:`calibrate`."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.answers import OtherAnswers, compare_answers
from hand_eye_calib.engine.run import Progress, run
from hand_eye_calib.engine.snapshot import Snapshot, name_frames
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import CrossCheck
from hand_eye_calib.text import AXIS_UNITS, Prior

# Pose pairs that are used unless an option says otherwise: the noise model takes 8 kB for each, and
# hours at ten a second hold as many.
_MOST_PAIRS = 100_000


def calibrate(
    parent: Trajectory,
    child: Trajectory,
    *,
    method: str | None = None,
    reference: str | None = None,
    backend: str | None = None,
    threshold: float | None = None,
    min_inlier_fraction: float | None = None,
    min_pairs: int | None = None,
    max_pairs: int | None = None,
    keyframe_min_translation: float | None = None,
    keyframe_min_rotation: float | None = None,
    keyframe_min_interval: float | None = None,
    max_gap: float | None = None,
    time_offset: float | str | None = None,
    scale: float | str | None = None,
    parent_scale: float | None = None,
    parent_measures: str | None = None,
    child_measures: str | None = None,
    parent_invert: str | None = None,
    child_invert: str | None = None,
    parent_quaternion: str | None = None,
    child_quaternion: str | None = None,
    parent_kind: str | None = None,
    child_kind: str | None = None,
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

    Each keyword is the option of :class:`~hand_eye_calib.config.CalibratorConfig` of that name,
    which has its meaning, unit, range and default; None stands for the default. All pose pairs are
    used, up to 100,000, unless ``max_pairs`` is given. The streams are checked, too: if a check is
    certain of the time offset or of the scale, and it was not given, it is estimated, and a warning
    says so.

    Parameters
    ----------
    parent, child : Trajectory
        Poses of each sensor in its own world. One of them may be positions
        (:meth:`Trajectory.from_positions`): the result is the lever arm. Either may be rotations or
        angular rates (:meth:`Trajectory.from_rates`): the result is the rotation, with the bias of
        the rates.
    parent_measures, child_measures : str, optional
        What counts of a trajectory of poses: "positions" or "rotations" alone.
    prior : mapping of str to (float, float) or str, optional
        Value and standard deviation of x, y, z (m), roll, pitch or yaw (rad), such as
        ``{"z": (1.85, 0.02)}``; see :data:`~hand_eye_calib.text.Prior`.
    checks : bool, optional
        False: the streams are not checked, the result is not compared with other references and
        halves of the recording, and nothing is solved a second time. True: it is compared also if
        a reference is given, which leaves that out otherwise.
    progress : callable, optional
        Called with the share that is done, 0 to 1, and the step that begins.

    Raises
    ------
    ConfigError
        If an option has a value that is not allowed.
    InputError
        If an argument is no Trajectory or both are of one sensor frame.
    NotEnoughDataError
        If too few poses can be paired.
    """
    options = dict(locals())
    _require_trajectories(parent, child)
    for name in ("parent", "child", "prior", "checks", "progress"):
        del options[name]
    options = {name: value for name, value in options.items() if value is not None}
    options = _of_streams(parent, child) | options | prior_fields(prior or {})
    config = CalibratorConfig(**options)
    snapshot = whole_snapshot(config, parent, child)
    return run(snapshot, checks=checks, progress=progress).calibration


def _require_trajectories(parent: object, child: object) -> None:
    for name, given in (("parent", parent), ("child", child)):
        if not isinstance(given, Trajectory):
            raise InputError(
                f"{name} must be a Trajectory; found {type(given).__name__}: build one with "
                "hec.Trajectory(stamps_ns, poses) or hec.read_trajectory(path)"
            )


def prior_fields(prior: Prior) -> dict[str, str]:
    """The same prior as options of a CalibratorConfig, attribute to text.

    Raises
    ------
    ConfigError
        If an axis is unknown or its value is not a text or a pair of numbers.
    """
    fields = {}
    for axis, known in prior.items():
        if axis not in (*AXIS_UNITS, "transform"):
            raise ConfigError(f"prior takes {', '.join(AXIS_UNITS)} or transform; got {axis!r}")
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


def offline_config(
    parent: Trajectory, child: Trajectory, options: Mapping[str, object]
) -> CalibratorConfig:
    """The CalibratorConfig for two whole trajectories, from options by their public names: all
    pairs up to 100,000 unless they set another limit.
    """
    return CalibratorConfig.from_options(_of_streams(parent, child) | dict(options))


def whole_snapshot(config: CalibratorConfig, parent: Trajectory, child: Trajectory) -> Snapshot:
    """The Snapshot of two whole trajectories."""
    parent_frame, child_frame, warnings = name_frames(
        config, {"parent": parent.sensor_frame, "child": child.sensor_frame}
    )
    if min(len(parent), len(child)) > config.max_pairs == _MOST_PAIRS:
        warnings += (f"{_MOST_PAIRS:,} pose pairs are used at most; give max_pairs to use more",)
    return Snapshot(
        config=config,
        kept=PosePairs.empty(),
        buffered_parent=parent,
        buffered_child=child,
        paired_at=None,
        parent_frame=parent_frame,
        child_frame=child_frame,
        warnings=warnings,
    )


def _of_streams(parent: Trajectory, child: Trajectory) -> dict[str, Any]:
    """Options that follow from the streams: what they measure, and that all their poses are used
    unless there are too many.
    """
    return {
        "max_pairs": min(max(len(parent), len(child), 10), _MOST_PAIRS),
        "parent_measures": parent.measures,
        "child_measures": child.measures,
    }


def cross_check(
    calibration: Calibration,
    parent: Trajectory,
    child: Trajectory,
    config: CalibratorConfig | None = None,
) -> CrossCheck:
    """Cross-check a result with other methods and references and with both halves of its recording.

    This solves some fifteen times.

    Parameters
    ----------
    calibration : Calibration
        The result.
    parent, child : Trajectory
        The trajectories that gave it.
    config : CalibratorConfig, optional
        The options that gave it; the defaults, with the result's method, if left out.

    Returns
    -------
    CrossCheck

    Raises
    ------
    ConfigError
        If a stream is not one of poses.
    NotEnoughDataError
        If too few poses can be paired.
    """
    config = config or offline_config(parent, child, {"method": calibration.method})
    config.require_poses("a cross-check")
    settled = replace(config, time_offset=calibration.time_offset_s)
    pose_pairs = whole_snapshot(settled, parent, child).pose_pairs()
    answers = OtherAnswers(calibration, config, pose_pairs)
    return compare_answers(
        calibration,
        [other.calibration for other in answers.other_methods()],
        [half.calibration for half in answers.halves()],
    )
