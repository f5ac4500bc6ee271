"""Extrinsics of three sensors or more, and the closure test.

Model: X_1k is the pose of sensor k in the frame of the first sensor. The first sensor is calibrated
with each other sensor, which yields X_1k. From the second sensor on, each sensor is calibrated with
the next sensor in the list, which yields X_k(k+1). Without errors, X_1k X_k(k+1) = X_1(k+1). The
difference is the closure error. Weighted least squares distributes it among the X_1k.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    NotEnoughDataError,
    require_type,
)
from hand_eye_calib.core.base.plain import Document, plain
from hand_eye_calib.core.base.stats import CHI2
from hand_eye_calib.core.base.text import angle, frame_name, length, listing
from hand_eye_calib.core.checks import independence
from hand_eye_calib.core.checks.findings import finding
from hand_eye_calib.core.checks.stream_pair import StreamPair
from hand_eye_calib.core.engine.attempts import Attempt
from hand_eye_calib.core.engine.estimation import solve_poses
from hand_eye_calib.core.engine.run import run
from hand_eye_calib.core.engine.snapshot import Snapshot, whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import synchronise
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.records import Finding, gravest_first

# Beginnings of the names of options that a rig does not have, because they concern two sensors.
_OF_ONE_PAIR = ("parent_", "child_", "base_frame", "prior")
#: Options of two sensors that a rig has: the kind of the first sensor, and that of all others.
KINDS = ("parent_kind", "child_kind")


def calibrate_rig(
    trajectories: Mapping[str, Trajectory],
    options: Mapping[str, Any] | None = None,
    *,
    time_offset: str | None = None,
    scale: str | None = None,
) -> RigCalibration:
    """Estimate the poses of all sensors of a rig in the frame of the first sensor.

    Each other sensor is calibrated with the first sensor, as by
    :func:`~hand_eye_calib.offline.calibrate.calibrate`, and with its neighbour in the list. The
    closure errors test these results. Then the closure errors are distributed, so that all chains
    of extrinsics between two sensors agree.

    Parameters
    ----------
    trajectories : mapping of str to Trajectory
        Poses of each sensor in its own world, by the name of its frame; at least three.
    options : mapping of str to value, optional
        Options by their public names, such as method, max_gap or target.translation; see
        :class:`~hand_eye_calib.core.base.config.CalibratorConfig`. ``parent_kind`` is the kind of
        the first sensor, ``child_kind`` that of all others.
    time_offset, scale : str, optional
        "estimate"; for the scale also "auto" or "none". The option applies to each sensor relative
        to the first sensor.

    Raises
    ------
    ConfigError, InputError
        If an option is not allowed, or there are fewer than three trajectories.
    NotEnoughDataError
        If too few poses of two sensors are synchronous.

    Examples
    --------
    >>> rig = hec.calibrate_rig({"lidar": parent, "camera": child, "rear": other})
    >>> len(rig.calibrations)
    2
    """
    options = dict(options or {})
    if time_offset is not None:
        options["time_offset"] = time_offset
    if scale is not None:
        options["scale"] = scale
    return calibrated(trajectories, options, lambda snapshot: snapshot)


def calibrated(
    trajectories: Mapping[str, Trajectory],
    options: Mapping[str, Any],
    complete: Callable[[Snapshot], Snapshot],
) -> RigCalibration:
    """Calibrate a rig; see :func:`calibrate_rig`.

    ``complete`` adds measurements in addition to motion to the snapshot of two sensors.
    """
    _require_rig(trajectories, options)
    first, *others = [
        replace(trajectory, sensor_frame=frame_name(name))
        for name, trajectory in trajectories.items()
    ]
    attempts = []
    for other in others:
        snapshot = complete(whole_snapshot(first, other, options))
        try:
            attempts.append(run(snapshot))
        except NotEnoughDataError as error:
            raise NotEnoughDataError(
                f"{other.sensor_frame} (child) with {first.sensor_frame} (parent): {error}"
            ) from None
    # Results with the first sensor, and the other trajectories on the clock and in the unit of the
    # first trajectory.
    star = [attempt.calibration for attempt in attempts]
    aligned = [
        _aligned(other, attempt)
        for other, attempt in zip(others, attempts, strict=True)
    ]
    config = attempts[0].snapshot.config
    neighbours = [
        _between(parent, child, calibration.method, config)
        for calibration, parent, child in zip(
            star, aligned, aligned[1:], strict=False
        )
    ]
    sensors = (
        first.sensor_frame,
        *(calibration.child_frame for calibration in star),
    )
    star = _with_copies(star, others, aligned, config)
    return RigCalibration.of(sensors, star, neighbours)


def _with_copies(
    star: Sequence[Calibration],
    others: Sequence[Trajectory],
    aligned: Sequence[Trajectory],
    config: CalibratorConfig,
) -> list[Calibration]:
    """Return the results with a finding in both results of two sensors that are copies.

    Copies of the first sensor already have a finding, from the calibration with the first sensor.
    Here, the other sensors are compared with each other.

    Parameters
    ----------
    star : sequence of Calibration
        Each other sensor in the frame of the first sensor.
    others, aligned : sequence of Trajectory
        The other sensors' streams as recorded, and on the clock of the first sensor.
    config : CalibratorConfig
        Options of the first result: the longest interval that is interpolated, and the kind of the
        other sensors.
    """
    results = list(star)
    for i, k in combinations(range(len(star)), 2):
        if Verdict.DO_NOT_USE in (star[i].verdict, star[k].verdict):
            # Streams with another fault differ by this fault, or have their finding already.
            continue
        copied = independence.check_copies(
            StreamPair(others[i], others[k], config.max_gap),
            StreamPair(aligned[i], aligned[k], config.max_gap),
            are_exact=config.child_kind == "exact",
        )
        for of_pair in copied:
            names = {
                "first": star[i].child_frame,
                "second": star[k].child_frame,
            }
            values = {**of_pair.values, **names}
            named = replace(of_pair, key="copied_in_rig", values=values)
            for number in (i, k):
                findings = gravest_first([named, *results[number].findings])
                results[number] = replace(results[number], findings=findings)
    return results


def _aligned(child: Trajectory, attempt: Attempt) -> Trajectory:
    """Return the poses of a child, corrected by the conventions, scale and clock of an attempt.

    The sensor's frame is that of the result. The frame of the stream differs if its poses are
    inverted, such as poses of a marker in a camera.
    """
    config = attempt.snapshot.config
    calibration = attempt.calibration
    poses = se3.put_right(
        child.poses, config.child_invert, config.child_quaternion
    )
    child = replace(child, poses=poses, sensor_frame=calibration.child_frame)
    return child.scaled(calibration.scale).shifted(calibration.time_offset_s)


def _between(
    parent: Trajectory, child: Trajectory, method: str, config: CalibratorConfig
) -> Calibration:
    """Calibrate two neighbours in the list, which already have the same clock and unit.

    ``config`` has the options of the first result. Both neighbours are of the kind ``child_kind``.
    """
    pairs = synchronise(parent, child, config.max_gap)
    if len(pairs) < config.min_pairs:
        raise NotEnoughDataError(
            f"{parent.sensor_frame} and {child.sensor_frame} have {len(pairs)} poses at common "
            "times: leave one of these sensors out"
        )
    of_neighbours = CalibratorConfig(
        method=method,
        max_pairs=max(len(pairs), 10),
        parent_kind=config.child_kind,
        child_kind=config.child_kind,
    )
    calibration = solve_poses(pairs, of_neighbours).calibration()
    return replace(
        calibration,
        parent_frame=parent.sensor_frame,
        child_frame=child.sensor_frame,
    )


def _require_rig(
    trajectories: Mapping[str, Trajectory], options: Mapping[str, Any]
) -> None:
    """Raise an InputError or a ConfigError if trajectories or options are not those of a rig."""
    require_type(
        "trajectories",
        trajectories,
        Mapping,
        remedy="pass {name: trajectory} of all sensors",
    )
    for trajectory in trajectories.values():
        require_type(
            "each trajectory",
            trajectory,
            Trajectory,
            remedy="read a file with hand_eye_calib.read_trajectory",
        )
    if len(trajectories) < 3:
        raise InputError(
            f"a rig needs at least three sensors; found {len(trajectories)}: "
            "calibrate two sensors as parent and child"
        )
    for name, trajectory in trajectories.items():
        if trajectory.measures != "poses":
            raise InputError(
                f"{name} measures {trajectory.measures} only, but a rig needs "
                "poses: calibrate this sensor with one of the others"
            )
    for name, value in options.items():
        if _is_of_one_pair(name):
            raise ConfigError(
                f"{name} applies to two sensors; omit it for a rig, or calibrate the first sensor "
                "with one of the others"
            )
        if name in ("time_offset", "scale") and not isinstance(value, str):
            raise ConfigError(
                f"{name} {value} applies to two sensors; for a rig, set {name} estimate, or "
                "correct the trajectories before"
            )


# Directions with a larger variance (m^2, rad^2) are not determined, and not part of a closure.
_UNKNOWN = 1.0

# Added to the variances (m^2, rad^2) of a result, which are zero for poses without noise.
_ROUNDING = 1e-16


@dataclass(frozen=True)
class Closure:
    """Closure error of the three results for pairs of three sensors a, b and c.

    Attributes
    ----------
    sensors : (str, str, str)
        Frames of a, b and c.
    translation_m, rotation_rad : float
        Norms of the translation and rotation of ``T_ab T_bc T_ca``, which is the identity without
        errors. Only directions that all three results determine are counted.
    chi2 : float
        Squared Mahalanobis distance of this product from the identity, as if the three results were
        independent. Results of the same sensor have common errors, so chi2 tends to be too small.
    dof : int
        Number of the determined directions: degrees of freedom of chi2.
    """

    sensors: tuple[str, str, str]
    translation_m: float
    rotation_rad: float
    chi2: float
    dof: int

    @property
    def closes(self) -> bool:
        """Whether chi2 is below the limit that chance exceeds in 1 % of cases."""
        return self.dof == 0 or self.chi2 <= CHI2[0.01][self.dof]

    @property
    def sentence(self) -> str:
        """The closure error in one sentence for the user."""
        outcome = "closes" if self.closes else "DOES NOT CLOSE"
        return (
            f"{' - '.join(self.sensors)} {outcome}: off by {length(self.translation_m)} and "
            f"{angle(self.rotation_rad)}, chi-square {self.chi2:.1f} with "
            f"{self.dof} degrees of freedom"
        )

    @property
    def finding(self) -> Finding:
        """The finding of a loop that does not close."""
        first, second, third = self.sensors
        return finding(
            "not_closed",
            first=first,
            second=second,
            third=third,
            distance_mm=1e3 * self.translation_m,
            rotation_deg=np.rad2deg(self.rotation_rad),
            chi2=self.chi2,
            dof=self.dof,
        )


def advice_for_pair(calibration: Calibration) -> str:
    """Return the advice to calibrate two sensors alone; empty without need.

    Other advice on the result may name options of two sensors, which a rig does not have.
    """
    names = [name for reason in calibration.reasons for name in reason.options]
    if not any(map(_is_of_one_pair, names)):
        return ""
    return (
        f"these options are for two sensors: calibrate {calibration.parent_frame} and "
        f"{calibration.child_frame} alone"
    )


def _is_of_one_pair(option: str) -> bool:
    """Return whether an option exists for two sensors only, and not for a rig."""
    return option.startswith(_OF_ONE_PAIR) and option not in KINDS


@dataclass(frozen=True)
class RigCalibration:
    """Extrinsics of all sensors of a rig.

    Attributes
    ----------
    sensors : tuple of str
        Frames of the S sensors. All extrinsics are poses in the first frame.
    calibrations : tuple of Calibration
        S - 1 results: each other sensor in the frame of the first sensor.
    neighbours : tuple of Calibration
        S - 2 results: each sensor from the third on, in the frame of the sensor before it.
    closures : tuple of Closure
        S - 2 closure errors: the first sensor with two neighbours in the list.

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
        """Return a rig, with the closure errors of these results distributed.

        The results of a loop that does not close have a finding, ``not_closed``.

        Parameters
        ----------
        sensors : tuple of str
            Frames of the sensors.
        star : sequence of Calibration
            Each other sensor in the frame of the first sensor.
        neighbours : sequence of Calibration
            Each sensor from the third on, in the frame of the sensor before it.
        """
        triangles = zip(star, neighbours, star[1:], strict=False)
        closures = tuple(closure(*results) for results in triangles)
        rig = cls(sensors, tuple(star), tuple(neighbours), closures)
        calibrations = tuple(
            replace(
                calibration,
                T_parent_child=se3.exp(step) @ calibration.T_parent_child,
            )
            for calibration, step in zip(star, rig._steps(), strict=True)
        )
        return replace(rig, calibrations=calibrations)._with_findings()

    def _with_findings(self) -> RigCalibration:
        """Return the rig with a finding in both results of each loop that does not close.

        A result that is DO NOT USE already explains why its loop does not close. The other result
        of this loop may be good, and gets no finding.
        """
        calibrations = list(self.calibrations)
        for loop, closure in enumerate(self.closures):
            results = self.calibrations[loop : loop + 2]
            has_bad_result = any(
                result.verdict is Verdict.DO_NOT_USE for result in results
            )
            if closure.closes or has_bad_result:
                continue
            for k in (loop, loop + 1):
                findings = (*calibrations[k].findings, closure.finding)
                calibrations[k] = replace(calibrations[k], findings=findings)
        return replace(self, calibrations=tuple(calibrations))

    @property
    def headline(self) -> str:
        """The verdict; if the sensors differ, each verdict with its sensors, the gravest first."""
        texts = []
        for verdict in reversed(Verdict):
            frames = [
                result.child_frame
                for result in self.calibrations
                if result.verdict is verdict
            ]
            if frames:
                texts.append(f"{verdict.value}: {listing(frames)}")
        if len(texts) == 1:
            return f"{self.verdict.value}: {len(self.sensors)} sensors"
        return (
            f"{texts[0]} of {len(self.sensors)} sensors; {'; '.join(texts[1:])}"
        )

    def __repr__(self) -> str:
        return self.headline

    def with_warnings(self, warnings: Sequence[str]) -> RigCalibration:
        """Return the rig with these warnings added to each extrinsic."""
        calibrations = [
            replace(calibration, warnings=(*calibration.warnings, *warnings))
            for calibration in self.calibrations
        ]
        return replace(self, calibrations=tuple(calibrations))

    @property
    def verdict(self) -> Verdict:
        """Worst verdict of all extrinsics."""
        verdicts = [calibration.verdict for calibration in self.calibrations]
        return max(verdicts, key=[*Verdict].index)

    @cached_property
    def Xs(self) -> FloatArray:
        """Poses (S, 4, 4) of the sensors in the frame of the first sensor."""
        Xs = [calibration.T_parent_child for calibration in self.calibrations]
        return np.array([np.eye(4), *Xs])

    def _steps(self) -> FloatArray:
        """Return the changes (S - 1, 6) of the extrinsics that distribute the closure errors.

        The change x_k of X_1k is in the frame of the first sensor: ``Exp(x_k) X_1k``. A neighbour
        with the closure error e_k adds the equation ``x_(k+1) - x_k = e_k``. The changes solve the
        normal equations ``H x = s`` of weighted least squares.
        """
        K = len(self.calibrations)
        H = np.zeros((K, 6, K, 6))
        s = np.zeros((K, 6))
        for k, calibration in enumerate(self.calibrations):
            H[k, :, k] += np.linalg.inv(_in_first(calibration, self.Xs[k + 1]))
        for k, neighbour in enumerate(self.neighbours):
            parent = self.Xs[k + 1]
            child = self.Xs[k + 2]
            error = se3.log(
                parent @ neighbour.T_parent_child @ se3.inverse(child)
            )
            weight = np.linalg.inv(_in_first(neighbour, child))
            for row, sign in ((k + 1, 1.0), (k, -1.0)):
                s[row] += sign * weight @ error
                H[row, :, k + 1] += sign * weight
                H[row, :, k] -= sign * weight
        steps = np.linalg.solve(H.reshape(6 * K, 6 * K), s.ravel())
        return np.asarray(steps.reshape(K, 6))

    def T(self, first: str, second: str) -> FloatArray:
        """Return the pose (4, 4) of the sensor ``second`` in the frame of the sensor ``first``."""
        places = [self.sensors.index(first), self.sensors.index(second)]
        X_first, X_second = self.Xs[places]
        return se3.inverse(X_first) @ X_second

    def covariance(self, first: str, second: str) -> FloatArray:
        """Return the covariance (6, 6) of xi = (rho, phi) in ``T(first, second) @ Exp(xi)``.

        The covariance (m, rad) includes the allowance. If there is a result for these two sensors,
        the covariance is from this result. Otherwise, it is the sum of the covariances of both
        sensors relative to the first sensor, and contains the errors of the first sensor twice.
        """
        return self._covariance(first, second, with_allowance=True)

    def covariance_measured(self, first: str, second: str) -> FloatArray:
        """Return :meth:`covariance` without the allowance."""
        return self._covariance(first, second, with_allowance=False)

    def _covariance(
        self, first: str, second: str, with_allowance: bool
    ) -> FloatArray:
        """Return :meth:`covariance`, with or without the allowance."""
        numbers = [self.sensors.index(first), self.sensors.index(second)]
        low, high = sorted(numbers)
        if low == high:
            return np.zeros((6, 6))
        # Results whose covariances are added, with the poses of their child sensors.
        if low > 0 and high == low + 1:
            results = [(self.neighbours[low - 1], self.Xs[high])]
        else:
            results = [
                (self.calibrations[k - 1], self.Xs[k])
                for k in (low, high)
                if k > 0
            ]
        # Add in the frame of the rig's first sensor, and transform the sum to the second sensor.
        to_second = se3.adjoint(self.T(second, self.sensors[0]))
        in_first = np.sum(
            [_in_first(*result, with_allowance) for result in results], axis=0
        )
        return to_second @ in_first @ to_second.T

    def to_dict(self) -> Document:
        """Return the rig in plain values."""
        return {
            "format": "hand_eye_calib/rig",
            "version": 1,
            "sensors": list(self.sensors),
            "verdict": self.verdict.value,
            "closures": [
                plain(closure) | {"closes": closure.closes}
                for closure in self.closures
            ],
            "calibrations": {
                calibration.child_frame: calibration.to_dict()
                for calibration in self.calibrations
            },
        }


def _in_first(
    calibration: Calibration, X: FloatArray, with_allowance: bool = False
) -> FloatArray:
    """Return the covariance (6, 6) of a result in another frame than that of its child.

    X is the pose (4, 4) of the child in this frame.
    """
    adjoint = se3.adjoint(X)
    covariance = calibration.covariance_measured + _ROUNDING * np.eye(6)
    if with_allowance:
        covariance = covariance + calibration.covariance_allowance
    return adjoint @ covariance @ adjoint.T


def closure(
    to_second: Calibration, between: Calibration, to_third: Calibration
) -> Closure:
    """Return the closure error of three sensors a, b and c.

    Parameters
    ----------
    to_second, between, to_third : Calibration
        Results for b in a, c in b, and c in a.
    """
    chain = to_second.T_parent_child @ between.T_parent_child
    covariance = _in_first(to_second, to_second.T_parent_child) + _in_first(
        between, chain
    )
    covariance += _in_first(to_third, to_third.T_parent_child)
    variances, axes = np.linalg.eigh(covariance)
    is_determined = variances < _UNKNOWN
    directions = axes[:, is_determined]
    # Components of the closure error along the determined directions.
    components = directions.T @ se3.log(chain @ to_third.T_child_parent)
    error = directions @ components
    return Closure(
        sensors=(
            to_second.parent_frame,
            to_second.child_frame,
            to_third.child_frame,
        ),
        translation_m=float(np.linalg.norm(error[:3])),
        rotation_rad=float(np.linalg.norm(error[3:])),
        chi2=float((components**2 / variances[is_determined]).sum()),
        dof=len(components),
    )
