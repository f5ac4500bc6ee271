"""Sentences about the noise that the adaptive estimator found.

The numbers are those of a solution of :mod:`hand_eye_calib.core.noise`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.text import angle, counted, length
from hand_eye_calib.core.noise.estimator import AdaptiveSolution, ModelSolution
from hand_eye_calib.core.noise.increments import BIAS
from hand_eye_calib.core.noise.noise_model import fast_sigmas
from hand_eye_calib.core.results.records import CorrelatedError, Noise

# Smallest jitter of stamps (ms) that is printed.
_MIN_REPORTED_JITTER_MS = 0.1

_FIXED_TO = {"body": "the child's body", "world": "the parent's world"}


def noise_in_words(
    solution: AdaptiveSolution,
    stamps_ns: IntArray,
    offset_s: float | None = None,
    scale: float | None = None,
) -> Noise:
    """Return the noise as numbers and as sentences, with the times of jumps and outliers.

    Parameters
    ----------
    solution : AdaptiveSolution
    stamps_ns : (N,) int64 array
        Stamps of the poses.
    offset_s, scale : float, optional
        Time offset and scale that were applied to the poses before. The solution refines them.
    """
    sentences = _errors_in_words(solution) + _systematic_in_words(
        solution, offset_s, scale
    )
    sentences += events(solution, stamps_ns)
    return replace(solution.noise, in_words=tuple(sentences))


def _errors_in_words(solution: AdaptiveSolution) -> list[str]:
    """Return sentences about white noise, drift, time-correlated errors and jitter."""
    sigmas = fast_sigmas(solution.levels)
    processes = solution.noise.lasting
    white = angle(sigmas.rotation_rad)
    drift = f"{angle(sigmas.walk_rotation_rad)} from pose to pose"
    if solution.metres_per_pose:
        white = f"{length(sigmas.translation_m)} and {white}"
        root_metres = solution.metres_per_pose**0.5
        after_1_m = length(sigmas.walk_translation_m / root_metres)
        turned_after_1_m = angle(sigmas.walk_rotation_rad / root_metres)
        drift = (
            f"{after_1_m} and {turned_after_1_m} after 1 m at the mean speed, "
            "ten times that after 100 m"
        )
    else:
        # Streams of rotations have no translation errors.
        processes = tuple(
            process for process in processes if process.part == "rotation"
        )
    sentences = [
        f"Noise: {white} per axis of each pose (both sensors together).",
        f"Drift: {drift}.",
        *map(_process_in_words, processes),
    ]
    jitter_ms = 1e3 * sigmas.jitter_s
    if jitter_ms > _MIN_REPORTED_JITTER_MS:
        sentences.append(f"stamps jitter by {jitter_ms:.2g} ms")
    return sentences


def _systematic_in_words(
    solution: AdaptiveSolution, offset_s: float | None, scale: float | None
) -> list[str]:
    """Return sentences about the significant systematic errors, see :func:`noise_in_words`."""
    systematic = solution.systematic.split("+")
    sentences = []
    if "scale" in systematic and scale is not None:
        value = f"{scale * solution.scale:.4f} +/- {scale * solution.scale_sigma:.4f}"
        sentences.append(f"the scale is {value}, refined from {scale:.4f}")
    elif "scale" in systematic:
        percent = 100 * (solution.scale - 1)
        sigma = 100 * solution.scale_sigma
        size = f"{abs(percent):.2f} +/- {sigma:.2g} %"
        # If the scale exceeds 1, the measured lengths of the child are too short.
        comparison = "shorter" if percent > 0 else "longer"
        sentences.append(
            f"the child's lengths are {size} {comparison} than the parent's"
        )
    if "bias" in systematic:
        bias = zip("xyz", 1000 * solution.parameters[BIAS], strict=True)
        along = ", ".join(f"{axis} {value:.2g}" for axis, value in bias)
        sentences.append(
            f"the child's path is off by {along} mm per metre travelled, along its axes"
        )
    if "rate" in systematic:
        rates = zip("xyz", *np.degrees(solution.rate_bias), strict=True)
        about = ", ".join(
            f"{axis} {bias:.3g} +/- {sigma:.1g}" for axis, bias, sigma in rates
        )
        sentences.append(
            f"bias of the angular rates, along the child's axes: {about} deg/s"
        )
    if "time" in systematic and offset_s is not None:
        value = f"{offset_s + solution.time_offset_s:.4f} +/- {solution.time_offset_sigma_s:.4f} s"
        sentences.append(
            f"the time offset is {value}, refined from {offset_s:.4f} s"
        )
    elif "time" in systematic:
        ms = 1000 * solution.time_offset_s
        sigma = 1000 * solution.time_offset_sigma_s
        early_or_late = "early" if ms > 0 else "late"
        sentences.append(
            f"the child's stamps are {abs(ms):.1f} +/- {sigma:.2g} ms {early_or_late}"
        )
    return sentences


def _process_in_words(process: CorrelatedError) -> str:
    """Return a sentence about a time-correlated error."""
    duration = f"{process.tau_s:.2g} s"
    if process.part == "scale":
        return (
            f"the scale drifts by {100 * process.sigma:.2g} % within {duration}"
        )
    if process.part == "direction":
        return f"the direction of travel drifts by {angle(process.sigma)} within {duration}"
    size = (
        length(process.sigma)
        if process.part == "translation"
        else angle(process.sigma)
    )
    frame = _FIXED_TO[process.kind]
    return f"errors of {size} per axis, correlated over {duration}, keep their direction in {frame}"


def events(solution: ModelSolution, stamps_ns: IntArray) -> list[str]:
    """Return sentences about jumps and outliers, with the times (s) of up to five of them."""
    stamps_s = np.asarray(stamps_ns * 1e-9, dtype=np.float64)
    jumps_s = stamps_s[1:][solution.jumps]
    outliers_s = stamps_s[solution.spikes]
    sentences = []
    if len(jumps_s):
        jumps = counted(len(jumps_s), "jump")
        sentences.append(
            f"{jumps} of a trajectory, just before {_first_times(jumps_s)} s"
        )
    if len(outliers_s):
        outlier_poses = counted(len(outliers_s), "outlier pose")
        sentences.append(
            f"{outlier_poses}, left out, at {_first_times(outliers_s)} s"
        )
    return sentences


def _first_times(times_s: FloatArray) -> str:
    """Return up to five times (s) as text."""
    times = ", ".join(f"{time_s:.3f}" for time_s in times_s[:5].tolist())
    return f"{times} ..." if len(times_s) > 5 else times
