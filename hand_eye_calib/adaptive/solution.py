"""The adaptive estimator's answer, and what it says in words about the noise it found."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive.increments import nuisance_values
from hand_eye_calib.adaptive.noise import NoiseLevels

_TURNING = {
    "sensors": "",
    "child": ", its rotation about the origin of the child's world, as of a camera that sees a target",
    "parent": ", its rotation about the origin of the parent's world, as of a camera that sees a target",
}


@dataclass(frozen=True)
class AdaptiveSolution:
    """Answer of the adaptive estimator.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi = (rho, phi) in ``X exp(xi)`` under the model, nuisance parameters and
        misfit accounted for.
    unseen : (6, U) array
        Directions of xi that no increment says anything about.
    noise : NoiseLevels
    centre : {"sensors", "child", "parent"}
        What white rotation noise turns the trajectories about: the sensors, or the origin of the
        child's or the parent's world.
    nuisance : str
        Which systematic errors the data asks for, one of ``increments.NUISANCES``.
    parameters : (k,) array
        Their parameters, see :attr:`scale`, :attr:`biases` and :attr:`time_offset_s`.
    jumps : (n,) bool array
        Increments (from pose i to i + 1) across which a trajectory jumped for good.
    spikes : (n + 1,) bool array
        Poses that are wrong by themselves, and left out.
    used : (n + 1,) bool array
        Poses that the answer rests on: without spikes, and where noise drowns the motion from pose
        to pose, only every so many.
    misfit : float
        How many times larger the errors' variance over longer times is than the noise levels have
        it, 1 if the difference may be chance. The covariance has this factor in it.
    metres_per_pose : float
        Path of the parent from pose to pose.
    objective : float
        Negative log likelihood.
    converged : bool
    iterations : int
        Generalised least-squares steps.
    """

    T_parent_child: np.ndarray
    cov_parent_child_in_child: np.ndarray
    unseen: np.ndarray
    noise: NoiseLevels
    centre: str
    nuisance: str
    parameters: np.ndarray
    jumps: np.ndarray
    spikes: np.ndarray
    used: np.ndarray
    misfit: float
    metres_per_pose: float
    objective: float
    converged: bool
    iterations: int

    @property
    def scale(self):
        """Factor from the child's lengths to the parent's."""
        return 1.0 + float(nuisance_values(self.nuisance, self.parameters)[0])

    @property
    def biases(self):
        """(2, 3) array: error of the child's and of the parent's path per metre travelled, each
        along the axes of its sensor.
        """
        return nuisance_values(self.nuisance, self.parameters)[1]

    @property
    def time_offset_s(self):
        """Seconds to add to the child's stamps."""
        return -float(nuisance_values(self.nuisance, self.parameters)[2])

    @property
    def left_out(self):
        """(n,) bool array: increments that are no evidence, across a jump or at a spike."""
        return self.jumps | self.spikes[1:] | self.spikes[:-1]

    @property
    def _after_a_metre(self):
        """How many times larger a random walk is after a metre than after the path between two
        poses.
        """
        return (1.0 / max(self.metres_per_pose, 1e-9)) ** 0.5

    def describe(self, stamps_ns):
        """The noise in plain numbers and strings: levels per axis, systematic errors, when
        trajectories went wrong (ns), all of it in words.
        """
        return {
            "rotation_white_rad": self.noise.rotation_white,
            "translation_white_m": self.noise.translation_white,
            "rotation_drift_rad_per_pose": self.noise.rotation_drift,
            "translation_drift_m_per_pose": self.noise.translation_drift,
            "rotation_drift_rad_after_a_metre": self.noise.rotation_drift * self._after_a_metre,
            "translation_drift_m_after_a_metre": self.noise.translation_drift * self._after_a_metre,
            "rotation_turns_about": self.centre,
            "systematic": self.nuisance,
            "systematic_parameters": self.parameters.tolist(),
            "jumps_before_stamp_ns": stamps_ns[1:][self.jumps].tolist(),
            "spikes_at_stamp_ns": stamps_ns[self.spikes].tolist(),
            "misfit": self.misfit,
            "in_words": self._in_words(stamps_ns),
        }

    def _in_words(self, stamps_ns):
        noise, turning, per_metre = self.noise, _TURNING[self.centre], self._after_a_metre
        said = [
            f"each pose is off by {_length(noise.translation_white)} and {_angle(noise.rotation_white)} per axis (both sensors "
            f"together){turning}",
            f"what stays grows by {_length(noise.translation_drift)} and {_angle(noise.rotation_drift)} from pose to pose, that is by "
            f"{_length(noise.translation_drift * per_metre)} and {_angle(noise.rotation_drift * per_metre)} in the first metre, "
            "ten times that in a hundred",
        ]
        systematic = self.nuisance.split("+")
        if "scale" in systematic:
            off = 100 * (self.scale - 1)
            said.append(
                f"the child's lengths are {abs(off):.2f} % {'shorter' if off > 0 else 'longer'} than the parent's"
            )
        for name, sensor, bias in zip(
            ("bias", "parent bias"), ("child", "parent"), self.biases, strict=True
        ):
            if name in systematic:
                along = ", ".join(
                    f"{axis} {1000 * value:.2g}" for axis, value in zip("xyz", bias, strict=True)
                )
                said.append(
                    f"the {sensor}'s path is off by {along} mm per metre travelled, along its own axes"
                )
        if "time" in systematic:
            offset_ms = 1000 * self.time_offset_s
            said.append(
                f"the child's stamps are {abs(offset_ms):.1f} ms {'early' if offset_ms > 0 else 'late'}"
            )
        said += _when(
            "jump of a trajectory, just before",
            "jumps of a trajectory, just before",
            stamps_ns[1:][self.jumps],
        )
        said += _when(
            "pose wrong by itself and left out, at",
            "poses wrong by themselves and left out, at",
            stamps_ns[self.spikes],
        )
        if np.mean(self.used | self.spikes) < 1.0:
            every = round(1.0 / np.mean(self.used | self.spikes))
            said.append(f"noise drowns the motion from pose to pose: one pose in {every} is used")
        if self.misfit > 1.0:
            said.append(
                f"errors last longer than this noise would: the standard deviations are made {np.sqrt(self.misfit):.1f} times larger for it"
            )
        return said


def _length(metres):
    return f"{100 * metres:.2g} cm"


def _angle(radians):
    return f"{np.degrees(radians):.2g} deg"


def _when(one, several, stamps_ns):
    """A line, or none, about what happened at these times."""
    if not len(stamps_ns):
        return []
    shown = ", ".join(f"{stamp_ns * 1e-9:.3f}" for stamp_ns in stamps_ns[:5].tolist())
    return [
        f"{len(stamps_ns)} {one if len(stamps_ns) == 1 else several} {shown}{' ...' if len(stamps_ns) > 5 else ''} s"
    ]
