"""The answers of the core, for poses and for positions, and what they say in words about the noise
found.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.gls.increments import BIAS, RATE, SCALE, SYSTEMATIC, TIME
from hand_eye_calib.gls.noise_model import (
    JITTER,
    N_FAST,
    ROTATION,
    TRANSLATION,
    WALK_ROTATION,
    WALK_TRANSLATION,
    NoiseModel,
)
from hand_eye_calib.results.records import CorrelatedError, Noise
from hand_eye_calib.text import angle, length

_TURNING = {
    "sensors": "",
    "child": (
        ", its rotation about the origin of the child's world, as of a camera that sees a target"
    ),
    "parent": (
        ", its rotation about the origin of the parent's world, as of a camera that sees a target"
    ),
}
_FIXED_TO = {"body": "the child's body", "world": "the parent's world"}

# Stamps that jitter by less are not worth a sentence (s).
_NOTABLE_JITTER_S = 1e-4

# An answer to acceleration is, beyond so many standard deviations.
_PLAIN = 3.0


@dataclass(frozen=True)
class NoiseLevels:
    """Standard deviations per axis, of both sensors' trajectories together.

    Attributes
    ----------
    rotation_white, translation_white : float
        Independent error of each pose, rad and m.
    rotation_drift, translation_drift : float
        What an error that stays grows by in a typical interval between poses, rad and m.
    jitter_s : float
        Of the stamps.
    walk_by : {"time", "distance"}
        What the errors that stay grow with.
    centre : {"sensors", "child", "parent"}
        What white rotation noise turns the trajectories about: the sensors, or the origin of the
        child's or the parent's world.
    slow : tuple of CorrelatedError
    interval_s : float
        Typical interval between poses.
    """

    rotation_white: float
    translation_white: float
    rotation_drift: float
    translation_drift: float
    jitter_s: float
    walk_by: str
    centre: str
    slow: tuple[CorrelatedError, ...]
    interval_s: float

    @classmethod
    def of(cls, model: NoiseModel, levels: FloatArray) -> NoiseLevels:
        """From log levels."""
        sigmas = np.exp(0.5 * levels)
        slow = tuple(
            CorrelatedError(
                kind=process.kind,
                part=process.part,
                sigma=float(sigmas[at]),
                tau_s=float(np.exp(levels[at + 1])),
            )
            for process, at in zip(model.slow, range(N_FAST, len(levels), 2), strict=True)
        )
        return cls(
            rotation_white=float(sigmas[ROTATION]),
            translation_white=float(sigmas[TRANSLATION]),
            rotation_drift=float(sigmas[WALK_ROTATION]),
            translation_drift=float(sigmas[WALK_TRANSLATION]),
            jitter_s=float(sigmas[JITTER]),
            walk_by=model.walk_by,
            centre=model.centre,
            slow=slow,
            interval_s=model.extent.interval_s,
        )

    def rotation_variance(self, n_intervals: IntArray | int) -> FloatArray:
        """Variance (rad^2) per axis of the rotation over so many typical intervals."""
        variance = 2 * self.rotation_white**2 + n_intervals * self.rotation_drift**2
        for slow in self.slow:
            if slow.part == "rotation":
                ratio = n_intervals * self.interval_s / slow.tau_s
                variance = variance - 2 * slow.sigma**2 * np.expm1(-ratio)
        return np.asarray(variance)


@dataclass(frozen=True, kw_only=True)
class AdaptiveSolution:
    """Answer of the adaptive estimator.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi = (rho, phi) in ``X exp(xi)`` under the model, systematic errors and misfit
        accounted for.
    unseen : (6, U) array
        Directions of xi that no increment says anything about.
    model : NoiseModel
    levels : (m,) array
        Log levels of the model.
    weights : (n + 1,) array
        Of the poses' white errors; other than 1 where tails are heavy.
    systematic : str
        Which systematic errors the data asks for, one of ``increments.SYSTEMATIC``.
    parameters : (8,) array
        Parameters of all systematic errors, see :attr:`scale`, :attr:`biases` and
        :attr:`time_offset_s`; zero for those that are not assumed.
    parameter_sigmas : (8,) array
        Their standard deviations: for those not assumed, what they would be known to.
    jumps : (n,) bool array
        Increments (from pose i to i + 1) across which a trajectory jumped for good.
    spikes : (n + 1,) bool array
        Poses that are wrong by themselves, and left out.
    is_drowned : bool
        Whether single poses are noisier than the rotation between them: only some were used.
    heavy_tails : bool
        Whether white errors are weighed as of Student's t distribution.
    misfit : float
        Weighted squared residual over its degrees of freedom. The covariance has this factor in it.
    metres_per_pose : float
        Path of the parent from pose to pose.
    part_products : (K, p + 1, p + 1) array
        What each part of the recording adds, see :mod:`~hand_eye_calib.gls.parts`.
    by_scale : (6,) array
        Derivative of xi by the logarithm of the scale of the child's path.
    scale_variance : float
        Of that scale, by the data; zero if it is in the model.
    objective : float
        Negative log likelihood.
    converged : bool
    iterations : int
        Evaluations of the likelihood.
    """

    T_parent_child: FloatArray
    cov_parent_child_in_child: FloatArray
    unseen: FloatArray
    model: NoiseModel
    levels: FloatArray
    weights: FloatArray
    systematic: str
    parameters: FloatArray
    parameter_sigmas: FloatArray
    jumps: BoolArray
    spikes: BoolArray
    heavy_tails: bool
    misfit: float
    metres_per_pose: float
    part_products: FloatArray
    by_scale: FloatArray
    scale_variance: float
    objective: float
    converged: bool
    iterations: int
    is_drowned: bool = False

    @cached_property
    def noise(self) -> NoiseLevels:
        """Noise levels in plain units."""
        return NoiseLevels.of(self.model, self.levels)

    @property
    def scale(self) -> float:
        """Factor from the child's lengths to the parent's."""
        return 1.0 + float(self.parameters[SCALE])

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale."""
        return float(self.parameter_sigmas[SCALE])

    @property
    def bias(self) -> FloatArray:
        """(3,) array: error of the child's path per metre travelled, along its axes."""
        return self.parameters[BIAS]

    @property
    def rate_bias(self) -> FloatArray:
        """(2, 3) array: bias of the child's rates less that of the parent's, along the axes of the
        child, and its standard deviations, rad/s.
        """
        return np.stack([self.parameters[RATE], self.parameter_sigmas[RATE]])

    @property
    def time_offset_s(self) -> float:
        """Seconds to add to the child's stamps."""
        return -float(self.parameters[TIME])

    @property
    def time_offset_sigma_s(self) -> float:
        """Standard deviation of the time offset."""
        return float(self.parameter_sigmas[TIME])

    @property
    def left_out(self) -> BoolArray:
        """(n,) bool array: increments that are no evidence, across a jump or at a spike."""
        return self.jumps | self.spikes[1:] | self.spikes[:-1]

    @property
    def _after_a_metre(self) -> float:
        """How many times larger a random walk is after a metre than after the path between two
        poses.
        """
        return float((1.0 / max(self.metres_per_pose, 1e-9)) ** 0.5)

    def describe(self, stamps_ns: IntArray) -> Noise:
        """The noise in plain numbers and strings: levels per axis, systematic errors, when
        trajectories went wrong (ns), all of it in words.
        """
        noise = self.noise
        return Noise(
            rotation_white_rad=noise.rotation_white,
            translation_white_m=noise.translation_white,
            rotation_drift_rad_per_pose=noise.rotation_drift,
            translation_drift_m_per_pose=noise.translation_drift,
            rotation_drift_rad_after_a_metre=noise.rotation_drift * self._after_a_metre,
            translation_drift_m_after_a_metre=noise.translation_drift * self._after_a_metre,
            drift_grows_with=noise.walk_by,
            stamp_jitter_s=noise.jitter_s,
            lasting=noise.slow,
            rotation_turns_about=noise.centre,
            heavy_tails=self.heavy_tails,
            systematic=self.systematic,
            systematic_parameters=tuple(self.parameters.tolist()),
            scale=self.scale,
            scale_sigma=self.scale_sigma,
            time_offset_s=self.time_offset_s,
            time_offset_sigma_s=self.time_offset_sigma_s,
            jumps_before_stamp_ns=tuple(stamps_ns[1:][self.jumps].tolist()),
            spikes_at_stamp_ns=tuple(stamps_ns[self.spikes].tolist()),
            misfit=self.misfit,
            in_words=tuple(self._in_words(stamps_ns)),
        )

    def _in_words(self, stamps_ns: IntArray) -> list[str]:
        return [
            *self._noise_in_words(),
            *self._systematic_in_words(),
            *_when(
                "jump of a trajectory, just before",
                "jumps of a trajectory, just before",
                stamps_ns[1:][self.jumps],
            ),
            *_when(
                "pose wrong by itself and left out, at",
                "poses wrong by themselves and left out, at",
                stamps_ns[self.spikes],
            ),
        ]

    def _noise_in_words(self) -> list[str]:
        noise, per_metre = self.noise, self._after_a_metre
        if not self.metres_per_pose:
            return [
                f"Noise: {angle(noise.rotation_white)} per axis of each pose (both sensors "
                f"together). Drift: {angle(noise.rotation_drift)} from pose to pose.",
                *map(_slow_in_words, (slow for slow in noise.slow if slow.part == "rotation")),
            ]
        said = [
            f"Noise: {length(noise.translation_white)} and {angle(noise.rotation_white)} per axis "
            f"of each pose (both sensors together){_TURNING[noise.centre]}.",
            f"Drift: {length(noise.translation_drift * per_metre)} and "
            f"{angle(noise.rotation_drift * per_metre)} after 1 m, "
            f"{length(10 * noise.translation_drift * per_metre)} and "
            f"{angle(10 * noise.rotation_drift * per_metre)} after 100 m.",
        ]
        said += [_slow_in_words(slow) for slow in noise.slow]
        if noise.jitter_s > _NOTABLE_JITTER_S:
            said.append(f"stamps jitter by {1000 * noise.jitter_s:.2g} ms")
        if self.heavy_tails:
            said.append("Some poses are outliers and get less weight.")
        return said

    def _systematic_in_words(self) -> list[str]:
        said, systematic = [], self.systematic.split("+")
        if "scale" in systematic:
            off = 100 * (self.scale - 1)
            than = "shorter" if off > 0 else "longer"
            said.append(
                f"the child's lengths are {abs(off):.2f} +/- {100 * self.scale_sigma:.2g} % "
                f"{than} than the parent's"
            )
        if "bias" in systematic:
            along = ", ".join(
                f"{axis} {1000 * value:.2g}" for axis, value in zip("xyz", self.bias, strict=True)
            )
            said.append(
                f"the child's path is off by {along} mm per metre travelled, along its axes"
            )
        if "rate" in systematic:
            bias, sigmas = np.degrees(self.rate_bias)
            told = ", ".join(
                f"{axis} {value:.3g} +/- {sigma:.1g}"
                for axis, value, sigma in zip("xyz", bias, sigmas, strict=True)
            )
            said.append(f"bias of the angular rates, along the child's axes: {told} deg/s")
        if "time" in systematic and self.systematic in SYSTEMATIC:
            offset_ms = 1000 * self.time_offset_s
            said.append(
                f"the child's stamps are {abs(offset_ms):.1f} +/- "
                f"{1000 * self.time_offset_sigma_s:.2g} ms {'early' if offset_ms > 0 else 'late'}"
            )
        return said


@dataclass(frozen=True, kw_only=True)
class LeverArmSolution:
    """A lever arm and what it rests on.

    Attributes
    ----------
    lever_arm : (3,) array
        m, in the axes of the sensor with poses.
    covariance : (3, 3) array
        Under the model, misfit accounted for.
    beyond : (3, 3) array
        Covariance by what is not in the model and differs from recording to recording: what the
        positions answer to acceleration, and errors that last.
    common : (3, 3) array
        Covariance by a scale and a direction of the odometry that are the same all the time.
    response : (float, float)
        What positions less odometry are per m/s^2 of acceleration, s^2, and its sigma.
    clock_rate, clock_rate_sigma : float
        By how much the time offset grows each second.
    time_offset_s, time_offset_sigma_s, scale, scale_sigma : float
        As of an AdaptiveSolution.
    model, levels
        Noise model and its log levels.
    worse : (N,) bool array
        Positions that are left out, for those around are far less precise than the best.
    jumps : (n,) bool array
    spikes : (N,) bool array
    part_products : (K, p + 1, p + 1) array
    misfit, objective : float
    converged : bool
    """

    lever_arm: FloatArray
    covariance: FloatArray
    beyond: FloatArray
    common: FloatArray
    response: tuple[float, float]
    clock_rate: float
    clock_rate_sigma: float
    time_offset_s: float
    time_offset_sigma_s: float
    scale: float
    scale_sigma: float
    model: NoiseModel
    levels: FloatArray
    worse: BoolArray
    jumps: BoolArray
    spikes: BoolArray
    part_products: FloatArray
    misfit: float
    objective: float
    converged: bool

    @property
    def rotation_walk(self) -> float:
        """Variance (rad^2) per axis that the drift of the odometry's rotation grows by from pose to
        pose.
        """
        return float(np.exp(self.levels[WALK_ROTATION]))

    def describe(self, stamps_ns: IntArray) -> Noise:
        """The noise in plain values and in words, as of an AdaptiveSolution."""
        sigmas = np.exp(0.5 * self.levels)
        white, walk = (float(sigmas[level]) for level in (TRANSLATION, WALK_TRANSLATION))
        turned = float(sigmas[WALK_ROTATION])
        worse = float(np.mean(self.worse))
        said = [
            f"each position is off by {length(white)} per axis, and the odometry drifts by "
            f"{length(walk)} and {angle(turned)} from one to the next"
        ]
        if worse:
            said.append(f"{worse:.0%} of the positions are far less precise, and are left out")
        response, sigma = 1e3 * np.array(self.response)
        if abs(response) > _PLAIN * sigma:
            said.append(
                f"the positions answer to acceleration by {response:.1f} +/- {sigma:.1g} mm per "
                "m/s^2 (one of the sensors smooths); what that may do is in the +/- values"
            )
        for what, found in (("jumps", self.jumps), ("positions wrong by themselves", self.spikes)):
            if found.any():
                said.append(f"{int(found.sum())} {what}")
        return Noise(
            translation_white_m=white,
            translation_drift_m_per_pose=walk,
            rotation_drift_rad_per_pose=turned,
            drift_grows_with=self.model.walk_by,
            share_of_worse_positions=worse,
            jumps_before_stamp_ns=tuple(stamps_ns[1:][self.jumps].tolist()),
            spikes_at_stamp_ns=tuple(stamps_ns[self.spikes].tolist()),
            misfit=self.misfit,
            in_words=tuple(said),
        )


def _slow_in_words(slow: CorrelatedError) -> str:
    if slow.kind == "scale":
        return f"the scale drifts by {100 * slow.sigma:.2g} % within {slow.tau_s:.2g} s"
    size = length(slow.sigma) if slow.part == "translation" else angle(slow.sigma)
    return f"errors of {size} per axis last for {slow.tau_s:.2g} s, fixed to {_FIXED_TO[slow.kind]}"


def _when(one: str, several: str, stamps_ns: IntArray) -> list[str]:
    """A line, or none, about what happened at these times."""
    if not len(stamps_ns):
        return []
    shown = ", ".join(f"{stamp_ns * 1e-9:.3f}" for stamp_ns in stamps_ns[:5].tolist())
    return [
        f"{len(stamps_ns)} {one if len(stamps_ns) == 1 else several} "
        f"{shown}{' ...' if len(stamps_ns) > 5 else ''} s"
    ]
