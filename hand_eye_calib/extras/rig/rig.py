"""Whole trajectories of several sensors in, the extrinsics of all of them out: a tree of
extrinsics, and the closure test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.plain import Document, plain
from hand_eye_calib.core.base.stats import CHI2
from hand_eye_calib.core.base.text import angle, frame_name, length, listing
from hand_eye_calib.core.engine.attempts import Attempt
from hand_eye_calib.core.engine.estimation import solve_poses
from hand_eye_calib.core.engine.run import run
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import synchronise
from hand_eye_calib.core.results.calibration import Calibration, Verdict

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
    :func:`~hand_eye_calib.offline.calibrate.calibrate` does, and neighbours in the list against
    each other. What these answers miss closing by tests them. It is then shared among them, so that
    any chain of extrinsics between two sensors gives the same.

    Parameters
    ----------
    trajectories : mapping of str to Trajectory
        Poses of each sensor in its own world, by the name of its frame; at least three.
    options : mapping of str to value, optional
        By their public names, such as method, max_gap or target.translation; see
        :class:`~hand_eye_calib.core.base.config.CalibratorConfig`.
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
    first, *rest = [
        replace(trajectory, sensor_frame=frame_name(name))
        for name, trajectory in trajectories.items()
    ]
    star = []
    moved = []
    for other in rest:
        found = run(whole_snapshot(first, other, options))
        answer = found.calibration
        star.append(answer)
        other = _as_solved(other, found)
        moved.append(other.scaled(answer.scale).shifted(answer.time_offset_s))
    couples = zip(star, moved, moved[1:], strict=False)
    chain = [_between(*each, found.snapshot.config.max_gap) for each in couples]
    sensors = (first.sensor_frame, *(answer.child_frame for answer in star))
    return RigCalibration.of(sensors, star, chain)


def _as_solved(child: Trajectory, found: Attempt) -> Trajectory:
    """Return the poses of a child as a run has read them, with the name of the sensor's frame.

    Inverse poses are those of the other frame of the stream: of a camera that sees a marker.
    """
    config = found.snapshot.config
    poses = se3.put_right(child.poses, config.child_invert, config.child_quaternion)
    return replace(child, poses=poses, sensor_frame=found.calibration.child_frame)


def _between(
    answer: Calibration, before: Trajectory, after: Trajectory, max_gap_s: float
) -> Calibration:
    """The answer for two neighbours, on one clock and in one unit, by the method of another."""
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
                f"{name} {value} does not say which sensor of the rig it is for; give {name} "
                "estimate, or correct the trajectories before"
            )


# Variances (m^2, rad^2) of directions that are unknown are larger.
_UNKNOWN = 1.0

# Variance (m^2, rad^2) that no answer is better than: that of poses without noise is zero.
_ROUNDING = 1e-16


@dataclass(frozen=True)
class Closure:
    """How far the pairwise answers of three sensors are from closing.

    Attributes
    ----------
    sensors : (str, str, str)
    translation_m, rotation_rad : float
        Size of ``T_ab T_bc T_ca``, which is the identity without errors, along directions that all
        three answers know.
    chi2 : float
        The same in standard deviations, squared: with the covariances of the three answers as if
        they were independent. They share sensors, so that it is rather smaller than by chance.
    dof : int
        Number of these directions.
    """

    sensors: tuple[str, str, str]
    translation_m: float
    rotation_rad: float
    chi2: float
    dof: int

    @property
    def closes(self) -> bool:
        """Whether chance makes it so large more than once in a hundred times."""
        return self.dof == 0 or self.chi2 <= CHI2[0.01][self.dof]

    @property
    def sentence(self) -> str:
        """The closure in one sentence."""
        how = "closes" if self.closes else "DOES NOT CLOSE"
        return (
            f"{' - '.join(self.sensors)} {how}: off by {length(self.translation_m)} and "
            f"{angle(self.rotation_rad)}, chi-square {self.chi2:.1f} with "
            f"{self.dof} degrees of freedom"
        )


@dataclass(frozen=True)
class RigCalibration:
    """The extrinsics of all sensors of a rig.

    Attributes
    ----------
    sensors : tuple of str
        Frames of the S sensors. All extrinsics are stated in the first one's.
    calibrations : tuple of Calibration
        Of every other sensor in the frame of the first one: S - 1.
    neighbours : tuple of Calibration
        Of every sensor from the third one on in the frame of the one before it: S - 2.
    closures : tuple of Closure
        Of answers for two sensors at a time: the first and two neighbours in the list each.

    Examples
    --------
    >>> sensors = {"lidar": parent, "camera": child, "rear": other}
    >>> hec.calibrate_rig(sensors).sensors
    ('lidar', 'camera', 'rear')
    """

    sensors: tuple[str, ...]
    calibrations: tuple[Calibration, ...]
    neighbours: tuple[Calibration, ...]
    closures: tuple[Closure, ...]

    @classmethod
    def of(
        cls,
        sensors: tuple[str, ...],
        star: Sequence[Calibration],
        neighbours: Sequence[Calibration],
    ) -> RigCalibration:
        """From answers for two sensors at a time. What they miss closing by is shared among them,
        as far as each is uncertain.
        """
        triangles = zip(star, neighbours, star[1:], strict=False)
        closures = tuple(closure(*answers) for answers in triangles)
        found = cls(sensors, tuple(star), tuple(neighbours), closures)
        calibrations = tuple(
            replace(each, T_parent_child=se3.exp(step) @ each.T_parent_child)
            for each, step in zip(star, found._steps(), strict=True)
        )
        return replace(found, calibrations=calibrations)

    def __repr__(self) -> str:
        return f"{self.verdict.value}: {listing(self.sensors)}"

    @property
    def verdict(self) -> Verdict:
        """The gravest verdict of all extrinsics."""
        return max((each.verdict for each in self.calibrations), key=[*Verdict].index)

    @cached_property
    def Xs(self) -> FloatArray:
        """Poses (S, 4, 4) of the sensors in the frame of the first one."""
        return np.array([np.eye(4), *(each.T_parent_child for each in self.calibrations)])

    def _steps(self) -> FloatArray:
        """Changes (S - 1, 6) of the extrinsics, in the frame of the first sensor, that make all
        answers close: weighted least squares.
        """
        K = len(self.calibrations)
        information = np.zeros((K, 6, K, 6))
        pulled = np.zeros((K, 6))
        for at, (each, X) in enumerate(zip(self.calibrations, self.Xs[1:], strict=True)):
            information[at, :, at] += np.linalg.inv(_moved(each, X))
        for at, each in enumerate(self.neighbours):
            before = self.Xs[at + 1]
            after = self.Xs[at + 2]
            miss = se3.log(before @ each.T_parent_child @ se3.inverse(after))
            weight = np.linalg.inv(_moved(each, after))
            for row, sign in ((at + 1, 1.0), (at, -1.0)):
                pulled[row] += sign * weight @ miss
                information[row, :, at + 1] += sign * weight
                information[row, :, at] -= sign * weight
        steps = np.linalg.solve(information.reshape(6 * K, 6 * K), pulled.ravel())
        return np.asarray(steps.reshape(K, 6))

    def T(self, first: str, second: str) -> FloatArray:
        """Pose (4, 4) of the second sensor in the frame of the first."""
        before, after = self.Xs[[self.sensors.index(first), self.sensors.index(second)]]
        return se3.inverse(before) @ after

    def covariance(self, first: str, second: str) -> FloatArray:
        """Covariance (6, 6) of xi = (rho, phi) in ``T(first, second) @ Exp(xi)``, m and rad.

        It is that of the answer for both, with the allowance. Without one it is the sum of those
        with the first sensor: rather too large, as it has that sensor's errors twice.
        """
        return self._covariance(first, second, with_allowance=True)

    def covariance_measured(self, first: str, second: str) -> FloatArray:
        """The part (6, 6) of :meth:`covariance` that the recordings show."""
        return self._covariance(first, second, with_allowance=False)

    def _covariance(self, first: str, second: str, with_allowance: bool) -> FloatArray:
        near, far = sorted(map(self.sensors.index, (first, second)))
        if near == far:
            return np.zeros((6, 6))
        answers = [(self.calibrations[at - 1], self.Xs[at]) for at in (near, far) if at]
        if 0 < near == far - 1:
            answers = [(self.neighbours[near - 1], self.Xs[far])]
        to_second = se3.adjoint(self.T(second, self.sensors[0]))
        in_first = np.sum([_moved(*each, with_allowance) for each in answers], axis=0)
        return np.asarray(to_second @ in_first @ to_second.T)

    def to_dict(self) -> Document:
        """Everything in plain values."""
        return {
            "format": "hand_eye_calib/rig",
            "version": 1,
            "sensors": list(self.sensors),
            "verdict": self.verdict.value,
            "closures": [plain(each) | {"closes": each.closes} for each in self.closures],
            "calibrations": {each.child_frame: each.to_dict() for each in self.calibrations},
        }


def _moved(calibration: Calibration, X: FloatArray, with_allowance: bool = False) -> FloatArray:
    """Covariance (6, 6) of an answer in the frame that its child has the pose X (4, 4) in; the
    measured part, unless the allowance is asked for.
    """
    adjoint = se3.adjoint(X)
    covariance = calibration.covariance_measured + _ROUNDING * np.eye(6)
    if with_allowance:
        covariance = covariance + calibration.covariance_allowance
    return np.asarray(adjoint @ covariance @ adjoint.T)


def closure(to_second: Calibration, on: Calibration, to_third: Calibration) -> Closure:
    """How the answers for a -> b, b -> c and a -> c close."""
    ahead = to_second.T_parent_child @ on.T_parent_child
    covariance = _moved(to_second, to_second.T_parent_child) + _moved(on, ahead)
    covariance += _moved(to_third, to_third.T_parent_child)
    variances, axes = np.linalg.eigh(covariance)
    is_known = variances < _UNKNOWN
    along = axes[:, is_known].T @ se3.log(ahead @ to_third.T_child_parent)
    miss = axes[:, is_known] @ along
    return Closure(
        sensors=(to_second.parent_frame, to_second.child_frame, to_third.child_frame),
        translation_m=float(np.linalg.norm(miss[:3])),
        rotation_rad=float(np.linalg.norm(miss[3:])),
        chi2=float((along**2 / variances[is_known]).sum()),
        dof=int(is_known.sum()),
    )
