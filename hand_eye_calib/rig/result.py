"""The result for a rig: a tree of extrinsics, the noise of every sensor, and the closure test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.results.calibration import Calibration, Verdict
from hand_eye_calib.rig.solution import RigSolution
from hand_eye_calib.stats import CHI2_HUNDREDTH
from hand_eye_calib.text import angle, length

_FORMAT, _VERSION = "hand_eye_calib/rig", 1

# Variances (m^2, rad^2) of directions that are unknown are larger.
_UNKNOWN = 1.0

_GRAVITY = (Verdict.DO_NOT_USE, Verdict.USE_WITH_CARE, Verdict.USE)


@dataclass(frozen=True)
class Closure:
    """By how much the pairwise answers of three sensors miss closing.

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
        return self.dof == 0 or self.chi2 <= CHI2_HUNDREDTH[self.dof]

    @property
    def sentence(self) -> str:
        """In words."""
        how = "closes" if self.closes else "DOES NOT CLOSE"
        return (
            f"{' - '.join(self.sensors)} {how}: off by {length(self.translation_m)} and "
            f"{angle(self.rotation_rad)}, chi-square {self.chi2:.1f} with "
            f"{self.dof} degrees of freedom"
        )


@dataclass(frozen=True)
class RigCalibration:
    """The extrinsics of all sensors of a rig from one solve.

    Attributes
    ----------
    sensors : tuple of str
        Frames of the S sensors. All extrinsics are stated in the first one's.
    calibrations : tuple of Calibration
        Of every other sensor in the frame of the first one: S - 1.
    pairwise : tuple of Calibration
        What each of these pairs gives by itself.
    closures : tuple of Closure
        Of answers for two sensors at a time, the first and two neighbours in the list each.
    solution : RigSolution
        Noise of every sensor and joint covariance.
    """

    sensors: tuple[str, ...]
    calibrations: tuple[Calibration, ...]
    pairwise: tuple[Calibration, ...]
    closures: tuple[Closure, ...]
    solution: RigSolution

    def __repr__(self) -> str:
        lines = [
            f" {each.child_frame}: {each.headline}, translation "
            f"{each.T_parent_child[:3, 3].round(4).tolist()}"
            for each in self.calibrations
        ]
        return "\n".join([f"<RigCalibration in {self.sensors[0]}", *lines]) + ">"

    @property
    def verdict(self) -> Verdict:
        """The gravest verdict of all extrinsics."""
        return min((each.verdict for each in self.calibrations), key=_GRAVITY.index)

    def T(self, first: str, second: str) -> FloatArray:
        """Pose (4, 4) of the second sensor in the frame of the first."""
        return self.solution.T(self.sensors.index(first), self.sensors.index(second))

    def covariance(self, first: str, second: str) -> FloatArray:
        """Covariance (6, 6) of xi = (rho, phi) in ``T(first, second) @ Exp(xi)``, m and rad."""
        return self.solution.covariance_of(self.sensors.index(first), self.sensors.index(second))

    def tree(self) -> list[str]:
        """The sensors and where they are, one a line."""
        lines = [self.sensors[0]]
        last = len(self.calibrations) - 1
        for index, each in enumerate(self.calibrations):
            x, y, z = each.T_parent_child[:3, 3]
            roll, pitch, yaw = np.degrees(se3.rotation_to_rpy(each.T_parent_child[:3, :3]))
            branch = "`-" if index == last else "|-"
            lines.append(
                f"{branch} {each.child_frame}: x {x:.3f} y {y:.3f} z {z:.3f} m, "
                f"roll {roll:.2f} pitch {pitch:.2f} yaw {yaw:.2f} deg, {each.verdict.value}"
            )
        return lines

    def noise_in_words(self) -> list[str]:
        """A line for every sensor."""
        return [
            f"{name}: each pose is off by {length(noise.translation_white)} and "
            f"{angle(noise.rotation_white)} per axis; drift: {length(noise.translation_drift)} and "
            f"{angle(noise.rotation_drift)} from pose to pose; "
            f"{noise.n_jumps} jumps, {noise.n_spikes} poses left out"
            for name, noise in zip(self.sensors, self.solution.noise, strict=True)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Everything in plain values."""
        return {
            "format": _FORMAT,
            "version": _VERSION,
            "sensors": list(self.sensors),
            "verdict": self.verdict.value,
            "walk_grows_with": self.solution.walk_by,
            "misfit": self.solution.misfit,
            "noise": {
                name: vars(noise).copy()
                for name, noise in zip(self.sensors, self.solution.noise, strict=True)
            },
            "closures": [
                vars(each) | {"sensors": list(each.sensors), "closes": each.closes}
                for each in self.closures
            ],
            "calibrations": {each.child_frame: each.to_dict() for each in self.calibrations},
            "pairwise": {each.child_frame: each.to_dict() for each in self.pairwise},
        }


def closure(
    sensors: tuple[str, str, str], to_second: Calibration, on: Calibration, to_third: Calibration
) -> Closure:
    """How the answers for a -> b, b -> c and a -> c close."""
    ahead = to_second.T_parent_child @ on.T_parent_child
    error = ahead @ to_third.T_child_parent
    covariance = np.zeros((6, 6))
    for each, T in (
        (to_second, to_second.T_parent_child),
        (on, ahead),
        (to_third, to_third.T_parent_child),
    ):
        adjoint = se3.adjoint(T)
        covariance += adjoint @ each.covariance @ adjoint.T
    variances, axes = np.linalg.eigh(covariance)
    known = axes[:, variances < _UNKNOWN]
    along = known.T @ se3.log(error)
    miss = known @ along
    return Closure(
        sensors=sensors,
        translation_m=float(np.linalg.norm(miss[:3])),
        rotation_rad=float(np.linalg.norm(miss[3:])),
        chi2=float((along**2 / variances[variances < _UNKNOWN]).sum()),
        dof=known.shape[1],
    )


def closures(
    sensors: Sequence[str], star: Sequence[Calibration], chain: Sequence[Calibration]
) -> tuple[Closure, ...]:
    """Closures of the first sensor with two neighbours each.

    Parameters
    ----------
    sensors : sequence of str
    star : sequence of Calibration
        Of every other sensor in the frame of the first one.
    chain : sequence of Calibration
        Of every sensor from the third one on in the frame of the one before it.
    """
    return tuple(
        closure((sensors[0], sensors[at], sensors[at + 1]), star[at - 1], on, star[at])
        for at, on in enumerate(chain, start=1)
    )
