"""Whole trajectories of several sensors in, the extrinsics of all of them out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import basis, combined, noise_driven
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.checked import at_clear_offset, checked
from hand_eye_calib.engine.estimation import estimate_extrinsic
from hand_eye_calib.engine.offline import Progress, offline_config, whole_snapshot
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.results.calibration import Calibration, DofVerdict, Residuals, SolveStatus
from hand_eye_calib.rig import solution as joint
from hand_eye_calib.rig.increments import Aligned
from hand_eye_calib.rig.result import RigCalibration, closures
from hand_eye_calib.rig.solution import RigSolution, SensorNoise
from hand_eye_calib.rig.table import Table, synchronised

# Options that are of one pair of sensors, by their beginnings.
_OF_ONE_PAIR = ("parent_", "child_", "base_frame", "prior")


def calibrate_rig(
    trajectories: Mapping[str, Trajectory],
    *,
    method: str | None = None,
    max_gap: float | None = None,
    time_offset: str | None = None,
    scale: str | None = None,
    target_translation: float | None = None,
    target_rotation: float | None = None,
    progress: Progress | None = None,
) -> RigCalibration:
    """Estimate the poses of all sensors of a rig in the frame of the first one, in one solve.

    First every other sensor is calibrated against the first one, as
    :func:`~hand_eye_calib.engine.offline.calibrate` does: that gives time offsets, scales and
    first answers. Then one solve estimates all extrinsics along with the noise of every single
    sensor. Its answers close: any chain of them between two sensors gives the same.

    Parameters
    ----------
    trajectories : mapping of str to Trajectory
        Poses of each sensor in its own world, by the name of its frame; at least three.
    method : str, optional
        Of the first answers; see :class:`~hand_eye_calib.config.CalibratorConfig`, as for the other
        options.
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
        If too few instants have poses of all sensors.
    """
    options = {
        "method": method,
        "max_gap": max_gap,
        "time_offset": time_offset,
        "scale": scale,
        "target_translation": target_translation,
        "target_rotation": target_rotation,
    }
    given = {name: value for name, value in options.items() if value is not None}
    return solve_rig(trajectories, given, progress)


def solve_rig(
    trajectories: Mapping[str, Trajectory],
    options: Mapping[str, Any],
    progress: Progress | None = None,
) -> RigCalibration:
    """The same as :func:`calibrate_rig`, with options by their public names."""
    _refuse(trajectories, options)
    tell: Callable[[float, str], None] = progress or (lambda share, step: None)
    sensors = tuple(trajectories)
    first = trajectories[sensors[0]]
    star = []
    for index, name in enumerate(sensors[1:]):
        tell(0.6 * index / (len(sensors) - 1), f"{name} in {sensors[0]}")
        star.append(_pairwise(first, trajectories[name], sensors[0], name, options))
    tell(0.6, "all sensors")
    moved = [
        trajectories[each.child_frame].scaled(each.scale).shifted(each.time_offset_s)
        for each in star
    ]
    table = synchronised([first, *moved], CalibratorConfig.from_options(dict(options)).max_gap)
    solution = joint.solve(table, _first_answers(star), _aligned(star))
    tell(0.8, "closure of pairs")
    chain = [
        _on_table(table, at, sensors, star[at - 1].method) for at in range(1, len(sensors) - 1)
    ]
    tell(1.0, "done")
    return RigCalibration(
        sensors=sensors,
        calibrations=tuple(
            _joint(each, at, table, solution) for at, each in enumerate(star, start=1)
        ),
        pairwise=tuple(star),
        closures=closures(sensors, star, chain),
        solution=solution,
    )


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


def _pairwise(
    first: Trajectory, other: Trajectory, name: str, of_other: str, options: Mapping[str, Any]
) -> Calibration:
    """A sensor against the first one by itself."""
    first = dataclasses.replace(first, sensor_frame=name)
    other = dataclasses.replace(other, sensor_frame=of_other)
    config = offline_config(first, other, options)
    snapshot = at_clear_offset(whole_snapshot(config, first, other))
    return checked(snapshot.estimate(), snapshot)[0]


def _on_table(table: Table, at: int, sensors: tuple[str, ...], method: str) -> Calibration:
    """The sensor behind another one in the frame of that, from poses that are aligned."""
    config = CalibratorConfig.from_options({"method": method, "max_pairs": max(len(table), 10)})
    found = estimate_extrinsic(table.pair(at, at + 1), config)
    return dataclasses.replace(found, parent_frame=sensors[at], child_frame=sensors[at + 1])


def _first_answers(star: list[Calibration]) -> FloatArray:
    return np.array([np.eye(4), *(each.T_parent_child for each in star)])


def _aligned(star: list[Calibration]) -> Aligned:
    """The time offsets and scales that were estimated, so that their errors count."""
    found = list(enumerate(star, start=1))
    return Aligned(
        tuple(at for at, each in found if each.time_offset_s and each.time_offset_sigma_s),
        tuple(at for at, each in found if each.scale != 1.0 and each.scale_sigma),
    )


def _joint(pairwise: Calibration, sensor: int, table: Table, solution: RigSolution) -> Calibration:
    """The calibration of a sensor as the joint solve has it."""
    T, covariance = solution.T(0, sensor), solution.covariance_of(0, sensor)
    pairs = motion_pairs(table.poses[0], table.poses[sensor], "B1")
    noises = (solution.noise[0], solution.noise[sensor])
    hidden = noise_driven(
        table.poses[0],
        T,
        np.zeros(len(table) - 1, dtype=bool),
        lambda n: np.asarray(sum(_rotation_variance(noise, n) for noise in noises)),
    )
    unknown = basis([*solution.unseen_of(0, sensor).T, *hidden])
    assessment = combined(T, covariance, None, unknown)
    translation, rotation = pairs.residuals(T)
    n = len(translation)
    is_known = all(dof.verdict is not DofVerdict.UNOBSERVABLE for dof in assessment.observability)
    status = SolveStatus.OK if is_known else SolveStatus.UNOBSERVABLE
    return dataclasses.replace(
        pairwise,
        T_parent_child=T,
        T_method=T,
        covariance=assessment.cov_parent_child_in_child,
        observability=assessment.observability,
        status=status if solution.converged else SolveStatus.NOT_CONVERGED,
        method="adaptive",
        reference="increments",
        proved_global="not tried",
        method_reason=f"rig: one solve for {table.n_sensors} sensors",
        reference_reason="",
        objective=solution.objective,
        noise=None,
        n_poses=len(table),
        n_pairs=n,
        n_inliers=n,
        motion_residuals=Residuals(
            translation=translation,
            rotation=rotation,
            weights=np.ones(n),
            start_ns=table.stamps_ns[pairs.i],
            end_ns=table.stamps_ns[pairs.j],
        ),
        other_answer=None,
    )


def _rotation_variance(noise: SensorNoise, n: int) -> float:
    """Variance (rad^2) per axis of the rotation over so many increments."""
    return 2.0 * noise.rotation_white**2 + n * noise.rotation_drift**2
