"""Two whole trajectories in, the extrinsic out: the Python function :func:`calibrate`."""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from hand_eye_calib.config import AXIS_UNITS, CalibratorConfig, Prior
from hand_eye_calib.engine.checked import at_clear_offset, checked
from hand_eye_calib.engine.snapshot import Snapshot, name_frames
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration

#: Called with the share that is done, 0 to 1, and the step that begins.
Progress: TypeAlias = Callable[[float, str], None]

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
    parent_measures: str | None = None,
    child_measures: str | None = None,
    prior: Prior | None = None,
    target_translation: float | None = None,
    target_rotation: float | None = None,
    target_axes: str | None = None,
    parent_frame: str | None = None,
    child_frame: str | None = None,
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
        ``{"z": (1.85, 0.02)}``; see :data:`~hand_eye_calib.config.Prior`.
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
    for name in ("parent", "child", "prior", "progress"):
        del options[name]
    options = {name: value for name, value in options.items() if value is not None}
    of_streams = _most_pairs(parent, child) | _measures(parent, child)
    config = CalibratorConfig(**(of_streams | options | prior_fields(prior or {})))
    snapshot = whole_snapshot(config, parent, child)
    if progress is None:
        snapshot = at_clear_offset(snapshot)
        return checked(snapshot.estimate(), snapshot)[0]
    # The snapshot keeps what these steps give.
    progress(0.0, "time offset")
    snapshot = at_clear_offset(snapshot)
    snapshot.resolved()
    progress(0.2, "pairing")
    snapshot.pose_pairs()
    progress(0.3, "solving")
    result = snapshot.estimate()
    progress(0.8, "checking the streams")
    result, _ = checked(result, snapshot)
    progress(1.0, "done")
    return result


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
    of_streams = _most_pairs(parent, child) | _measures(parent, child)
    return CalibratorConfig.from_options(of_streams | dict(options))


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


def _most_pairs(parent: Trajectory, child: Trajectory) -> dict[str, Any]:
    """Options under which all poses of both trajectories are used, unless there are too many."""
    return {"max_pairs": min(max(len(parent), len(child), 10), _MOST_PAIRS)}


def _measures(parent: Trajectory, child: Trajectory) -> dict[str, Any]:
    """Options that say what the streams measure, as they themselves do."""
    return {"parent_measures": parent.measures, "child_measures": child.measures}
