"""The answers of the core, for poses and for positions, and what they say in words about the noise
found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.gls.increments import BIAS, PARAMETERS, RATE, SCALE, TIME
from hand_eye_calib.gls.noise_model import (
    N_FAST,
    ROTATION,
    TRANSLATION,
    WALK_ROTATION,
    WALK_TRANSLATION,
    NoiseModel,
)
from hand_eye_calib.gls.tuning import TUNING
from hand_eye_calib.results.records import CorrelatedError, Noise
from hand_eye_calib.text import angle, length

_FIXED_TO = {"body": "the child's body", "world": "the parent's world"}


@dataclass(frozen=True, kw_only=True)
class ModelSolution:
    """What the answers for poses and for positions have in common.

    Attributes
    ----------
    model : NoiseModel
    levels : (m,) array
        Log levels of the model.
    parameters, parameter_sigmas : (8 or more,) arrays
        Parameters of all systematic errors, see :mod:`~hand_eye_calib.gls.increments`, and their
        standard deviations; zero for those that are not there.
    scale, scale_sigma : float
        Factor from the child's lengths to the parent's, and its standard deviation.
    time_offset_s, time_offset_sigma_s : float
        Seconds to add to the child's stamps, and their standard deviation.
    jumps : (n,) bool array
        Increments (from pose i to i + 1) across which a trajectory jumped for good.
    spikes : (n + 1,) bool array
        Poses that are wrong by themselves, and left out.
    misfit : float
        Weighted squared residual over its degrees of freedom. The covariance has this factor in it.
    part_products : (K, p + 1, p + 1) array
        What each part of the recording adds, see
        :func:`~hand_eye_calib.gls.state_space.Posterior.part_products`.
    objective : float
        Negative log likelihood.
    converged : bool
    """

    model: NoiseModel
    levels: FloatArray
    parameters: FloatArray
    parameter_sigmas: FloatArray
    scale: float
    scale_sigma: float
    time_offset_s: float
    time_offset_sigma_s: float
    jumps: BoolArray
    spikes: BoolArray
    misfit: float
    part_products: FloatArray
    objective: float
    converged: bool

    def events(self, stamps_ns: IntArray) -> list[str]:
        """Jumps and outliers in words, with the times (s) of the first."""
        said, found = (
            [],
            {
                "jumps of a trajectory, just before": stamps_ns[1:][self.jumps],
                "poses wrong by themselves and left out, at": stamps_ns[self.spikes],
            },
        )
        for what, at_ns in found.items():
            if count := len(at_ns):
                first = ", ".join(f"{each * 1e-9:.3f}" for each in at_ns[:5].tolist())
                said.append(f"{count} {what} {first}{' ...' if count > 5 else ''} s")
        return said


def parts_of(parameters: FloatArray, sigmas: FloatArray, unit: float = 1.0) -> dict[str, Any]:
    """The fields of a solution that parameters make, with the factor of the child's lengths that
    was taken out before.
    """
    return {
        "parameters": parameters,
        "parameter_sigmas": sigmas,
        "scale": unit * (1.0 + float(parameters[SCALE])),
        "scale_sigma": unit * float(sigmas[SCALE]),
        "time_offset_s": -float(parameters[TIME]),
        "time_offset_sigma_s": float(sigmas[TIME]),
    }


@dataclass(frozen=True, kw_only=True)
class AdaptiveSolution(ModelSolution):
    """Answer of the adaptive estimator.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi = (rho, phi) in ``X exp(xi)`` under the model, systematic errors and misfit
        accounted for.
    unseen : (6, U) array
        Directions of xi that no increment says anything about.
    weights : (n + 1,) array
        Of the poses' white errors; other than 1 where tails are heavy.
    is_drowned : bool
        Whether single poses are noisier than the rotation between them: only some were used.
    heavy_tails : bool
        Whether white errors are weighed as of Student's t distribution.
    metres_per_pose : float
        Path of the parent from pose to pose.
    """

    T_parent_child: FloatArray
    cov_parent_child_in_child: FloatArray
    unseen: FloatArray
    weights: FloatArray
    heavy_tails: bool
    metres_per_pose: float
    is_drowned: bool = False

    @property
    def systematic(self) -> str:
        """Systematic errors that the data show beyond doubt, joined by ``+``; ``none``."""
        shown = np.abs(self.parameters) > TUNING.plain * self.parameter_sigmas
        return "+".join(name for name, at in PARAMETERS.items() if shown[at].any()) or "none"

    @property
    def rate_bias(self) -> FloatArray:
        """(2, 3) array: bias of the child's rates less that of the parent's, along the axes of the
        child, and its standard deviations, rad/s.
        """
        return np.stack([self.parameters[RATE], self.parameter_sigmas[RATE]])

    def rotation_variance(self, n_intervals: IntArray | int) -> FloatArray:
        """Variance (rad^2) per axis of the rotation over so many typical intervals."""
        white, walk = np.exp(self.levels[[ROTATION, WALK_ROTATION]])
        variance = 2 * white + n_intervals * walk
        for slow in self.noise.lasting:
            if slow.part == "rotation":
                ratio = n_intervals * self.model.interval_s / slow.tau_s
                variance = variance - 2 * slow.sigma**2 * np.expm1(-ratio)
        return np.asarray(variance)

    @cached_property
    def noise(self) -> Noise:
        """The noise in plain numbers: standard deviations per axis, systematic errors."""
        sigmas = np.exp(0.5 * self.levels)
        lasting = tuple(
            CorrelatedError(
                kind=process.kind,
                part=process.part,
                sigma=float(sigmas[at]),
                tau_s=float(np.exp(self.levels[at + 1])),
            )
            for process, at in zip(self.model.slow, range(N_FAST, len(sigmas), 2), strict=True)
        )
        return Noise(
            in_words=(),
            rotation_white_rad=float(sigmas[ROTATION]),
            translation_white_m=float(sigmas[TRANSLATION]),
            rotation_drift_rad_per_pose=float(sigmas[WALK_ROTATION]),
            translation_drift_m_per_pose=float(sigmas[WALK_TRANSLATION]),
            lasting=lasting,
            heavy_tails=self.heavy_tails,
            systematic=self.systematic,
            misfit=self.misfit,
        )

    def describe(self, stamps_ns: IntArray) -> Noise:
        """The noise in plain numbers and in words, with the times of jumps and outliers."""
        said = [*self._noise_in_words(), *self._systematic_in_words(), *self.events(stamps_ns)]
        return replace(self.noise, in_words=tuple(said))

    def _noise_in_words(self) -> list[str]:
        sigmas, lasting = np.exp(0.5 * self.levels), self.noise.lasting
        white, drift = angle(sigmas[ROTATION]), f"{angle(sigmas[WALK_ROTATION])} from pose to pose"
        if self.metres_per_pose:
            white = f"{length(sigmas[TRANSLATION])} and {white}"
            by_m, by_rad = sigmas[[WALK_TRANSLATION, WALK_ROTATION]] / self.metres_per_pose**0.5
            drift = f"{length(by_m)} and {angle(by_rad)} after 1 m, ten times that after 100 m"
        else:
            lasting = tuple(slow for slow in lasting if slow.part == "rotation")
        return [
            f"Noise: {white} per axis of each pose (both sensors together).",
            f"Drift: {drift}.",
            *map(_slow_in_words, lasting),
        ]

    def _systematic_in_words(self) -> list[str]:
        systematic, said = self.systematic.split("+"), []
        if "scale" in systematic:
            off, sigma = 100 * (self.scale - 1), 100 * self.scale_sigma
            than = f"{'shorter' if off > 0 else 'longer'} than the parent's"
            said.append(f"the child's lengths are {abs(off):.2f} +/- {sigma:.2g} % {than}")
        if "bias" in systematic:
            bias = zip("xyz", 1000 * self.parameters[BIAS], strict=True)
            along = ", ".join(f"{axis} {value:.2g}" for axis, value in bias)
            said.append(
                f"the child's path is off by {along} mm per metre travelled, along its axes"
            )
        if "rate" in systematic:
            rates = zip("xyz", *np.degrees(self.rate_bias), strict=True)
            about = ", ".join(f"{axis} {bias:.3g} +/- {sigma:.1g}" for axis, bias, sigma in rates)
            said.append(f"bias of the angular rates, along the child's axes: {about} deg/s")
        elif "time" in systematic:
            ms, sigma = 1000 * self.time_offset_s, 1000 * self.time_offset_sigma_s
            late = "early" if ms > 0 else "late"
            said.append(f"the child's stamps are {abs(ms):.1f} +/- {sigma:.2g} ms {late}")
        return said


@dataclass(frozen=True, kw_only=True)
class LeverArmSolution(ModelSolution):
    """A lever arm and what it rests on.

    Attributes
    ----------
    lever_arm : (3,) array
        m, in the axes of the sensor with poses.
    covariance : (3, 3) array
        Under the model, misfit accounted for.
    response : (float, float)
        What positions less odometry are per m/s^2 of acceleration, s^2, and its sigma.
    worse : (N,) bool array
        Positions that are left out, for those around are far less precise than the best.
    """

    lever_arm: FloatArray
    covariance: FloatArray
    response: tuple[float, float]
    worse: BoolArray

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
        said = [
            f"each position is off by {length(white)} per axis, and the odometry drifts by "
            f"{length(walk)} and {angle(turned)} from one to the next"
        ]
        if self.worse.any():
            share = f"{self.worse.mean():.0%} of the positions"
            said.append(f"{share} are far less precise, and are left out")
        response, sigma = 1e3 * np.array(self.response)
        if abs(response) > TUNING.plain * sigma:
            said.append(
                f"the positions answer to acceleration by {response:.1f} +/- {sigma:.1g} mm per "
                "m/s^2 (one of the sensors smooths); what that may do is in the +/- values"
            )
        said += self.events(stamps_ns)
        return Noise(
            translation_white_m=white,
            translation_drift_m_per_pose=walk,
            rotation_drift_rad_per_pose=turned,
            misfit=self.misfit,
            in_words=tuple(said),
        )


def _slow_in_words(slow: CorrelatedError) -> str:
    if slow.kind == "scale":
        return f"the scale drifts by {100 * slow.sigma:.2g} % within {slow.tau_s:.2g} s"
    size = length(slow.sigma) if slow.part == "translation" else angle(slow.sigma)
    return f"errors of {size} per axis last for {slow.tau_s:.2g} s, fixed to {_FIXED_TO[slow.kind]}"
