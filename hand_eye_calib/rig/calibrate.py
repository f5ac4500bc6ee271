"""Whole trajectories of several sensors in, the extrinsics of all of them out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import solve_poses
from hand_eye_calib.engine.run import Progress, run
from hand_eye_calib.engine.snapshot import whole_snapshot
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.synchronise import synchronise
from hand_eye_calib.rig.result import RigCalibration

# Options that are of one pair of sensors, by their beginnings.
_OF_ONE_PAIR = ("parent_", "child_", "base_frame", "prior")


def calibrate_rig(
    trajectories: Mapping[str, Trajectory],
    options: Mapping[str, Any] | None = None,
    *,
    time_offset: str | None = None,
    scale: str | None = None,
    progress: Progress | None = None,
) -> RigCalibration:
    """Estimate the poses of all sensors of a rig in the frame of the first one.

    Every other sensor is calibrated against the first one, as
    :func:`~hand_eye_calib.engine.offline.calibrate` does, and neighbours in the list against each
    other. What these answers miss closing by tests them. It is then shared among them, so that any
    chain of extrinsics between two sensors gives the same.

    Parameters
    ----------
    trajectories : mapping of str to Trajectory
        Poses of each sensor in its own world, by the name of its frame; at least three.
    options : mapping of str to value, optional
        By their public names, such as method, max_gap or target.translation; see
        :class:`~hand_eye_calib.config.CalibratorConfig`.
    time_offset : "estimate", optional
        Of every sensor against the first one.
    scale : {"none", "auto", "estimate"}, optional
        The same.
    progress : callable, optional
        Called with the share that is done, 0 to 1, and the step that begins.

    Raises
    ------
    ConfigError
        If an option has a value that is not allowed.
    InputError
        If there are fewer than three trajectories.
    NotEnoughDataError
        If too few instants have poses of two sensors.

    Examples
    --------
    >>> rig = hec.calibrate_rig({"lidar": parent, "camera": child, "rear": other})
    >>> len(rig.calibrations)
    2
    """
    named = {"time_offset": time_offset, "scale": scale}
    options = dict(options or {}) | {name: each for name, each in named.items() if each is not None}
    _refuse(trajectories, options)
    tell = progress or (lambda share, step: None)
    sensors = tuple(trajectories)
    first, *rest = [replace(each, sensor_frame=name) for name, each in trajectories.items()]
    star, moved = [], []
    for index, other in enumerate(rest):
        tell(0.6 * index / (len(sensors) - 1), f"{other.sensor_frame} in {sensors[0]}")
        snapshot = whole_snapshot(first, other, options)
        answer = run(snapshot).calibration
        star.append(answer)
        moved.append(other.scaled(answer.scale).shifted(answer.time_offset_s))
    chain = []
    for index, (answer, before, after) in enumerate(zip(star, moved, moved[1:], strict=False)):
        tell(0.6 + 0.4 * index / (len(star) - 1), "closure of pairs")
        pairs = synchronise(before, after, snapshot.config.max_gap)
        of_pair = {"method": answer.method, "max_pairs": max(len(pairs), 10)}
        found = solve_poses(pairs, CalibratorConfig.from_options(of_pair)).calibration()
        ends = before.sensor_frame, after.sensor_frame
        chain.append(replace(found, parent_frame=ends[0], child_frame=ends[1]))
    tell(1.0, "done")
    return RigCalibration.of(sensors, star, chain)


def _refuse(trajectories: Mapping[str, Trajectory], options: Mapping[str, Any]) -> None:
    if len(trajectories) < 3:
        raise InputError(
            f"a rig has at least three sensors; found {len(trajectories)}: two are calibrated as "
            "parent and child"
        )
    for name, trajectory in trajectories.items():
        if trajectory.measures != "poses":
            raise InputError(
                f"{name} measures {trajectory.measures} only: a rig takes sensors with poses; "
                "calibrate this one with one of the others"
            )
    for name, value in options.items():
        if name.startswith(_OF_ONE_PAIR):
            raise ConfigError(f"{name} is of two sensors; it cannot be given for a rig")
        if name in ("time_offset", "scale") and not isinstance(value, str):
            raise ConfigError(
                f"{name} {value} would be of which sensor of the rig? Give {name} estimate, or "
                "correct the trajectories before"
            )
