"""Whole trajectories of several sensors in, the extrinsics of all of them out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import solve_poses
from hand_eye_calib.engine.run import run
from hand_eye_calib.engine.snapshot import whole_snapshot
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.motion_pairs import synchronise
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.rig.result import RigCalibration

# Options that are of one pair of sensors, by their beginnings.
_OF_ONE_PAIR = ("parent_", "child_", "base_frame", "prior")


def calibrate_rig(
    trajectories: Mapping[str, Trajectory],
    options: Mapping[str, Any] | None = None,
    *,
    time_offset: str | None = None,
    scale: str | None = None,
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
    time_offset, scale : str, optional
        "estimate", for the scale also "auto" or "none": of every sensor against the first one.

    Raises
    ------
    ConfigError, InputError
        If an option is not allowed, or there are fewer than three trajectories.
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
    first, *rest = [replace(each, sensor_frame=name) for name, each in trajectories.items()]
    star, moved = [], []
    for other in rest:
        snapshot = whole_snapshot(first, other, options)
        answer = run(snapshot).calibration
        star.append(answer)
        moved.append(other.scaled(answer.scale).shifted(answer.time_offset_s))
    couples = zip(star, moved, moved[1:], strict=False)
    chain = [_between(*each, snapshot.config.max_gap) for each in couples]
    return RigCalibration.of(tuple(trajectories), star, chain)


def _between(
    answer: Calibration, before: Trajectory, after: Trajectory, max_gap_s: float
) -> Calibration:
    """Of two neighbours on one clock and in one unit, with the method of an answer."""
    pairs = synchronise(before, after, max_gap_s)
    config = CalibratorConfig(method=answer.method, max_pairs=max(len(pairs), 10))
    found = solve_poses(pairs, config).calibration()
    return replace(found, parent_frame=before.sensor_frame, child_frame=after.sensor_frame)


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
