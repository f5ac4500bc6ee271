"""Simulated recordings whose noise is a random mixture, beyond the fixed classes."""

from dataclasses import replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from reproduction.coverage import motions
from reproduction.coverage.classes import RecordingClass, Simulated, simulate
from reproduction.coverage.sensor_errors import (
    GaussMarkov,
    SensorErrors,
    Tail,
    sigmas,
)

# Motion, lever arm (m), factor of the errors, and whether the drift grows with the distance.
_KINDS = {
    "mixed_hand": (motions.hand_held, 0.3, 1.0, False),
    "mixed_car": (motions.car, 1.2, 4.0, True),
    "mixed_agv": (motions.agv, 0.6, 2.0, True),
    "mixed_drone": (motions.drone, 0.25, 1.5, False),
    "mixed_arm": (motions.arm, 0.12, 0.5, False),
}
MIXED = tuple(_KINDS)

_TAILS = (
    Tail("student", factor=4.0),
    Tail("spikes", 0.03, 15.0),
    Tail("bursts", 0.1, 8.0),
)
_RATES_HZ = (5.0, 10.0, 15.0, 20.0, 30.0)
_MOST_POSES = 2500


def make(name: str, *seeds: int) -> Simulated:
    """Simulate the recording of a platform with these seeds."""
    key = (*seeds, MIXED.index(name))
    kind = drawn_class(name, np.random.default_rng(key))
    return simulate(kind, key)


def drawn_class(name: str, rng: np.random.Generator) -> RecordingClass:
    """Draw a class of recordings: rate, duration, lever arm and noise."""
    motion, lever_m, size, by_metre = _KINDS[name]
    rate_hz = float(rng.choice(_RATES_HZ))
    duration_s = min(_between(rng, 40.0, 300.0), _MOST_POSES / rate_hz)
    parent, child = (_drawn_errors(rng, size, by_metre) for _ in range(2))
    if not (child.walk.any() or child.walk_by_metre.any()):
        # Jumps and a drifting scale only make sense for an odometry that drifts.
        child = replace(child, walk=sigmas(0.0003 * size, 0.003))
    return RecordingClass(
        motion=motion,
        duration_s=duration_s,
        rate_hz=rate_hz,
        parent=parent,
        child=child,
        lever_m=lever_m * _between(rng, 0.5, 2.0),
    )


def _drawn_errors(
    rng: np.random.Generator, size: float, by_metre: bool
) -> SensorErrors:
    """Draw the errors of a sensor; each kind of error is present with its own probability."""
    rotation_factor = 0.3 if by_metre else 1.0
    metres = _between(rng, 0.0005, 0.006) * size * _by_axis(rng)
    degrees = _between(rng, 0.02, 0.25) * rotation_factor * _by_axis(rng)
    errors = SensorErrors(white=sigmas(metres, degrees))
    if rng.random() < 0.55:
        errors = _drifting(errors, rng, size, by_metre)
    if rng.random() < 0.5:
        errors = _slow(
            errors, rng, (0.15, 10.0), (0.001 * size, 0.01 * size), False
        )
    if rng.random() < 0.4:
        errors = _slow(
            errors, rng, (2.0, 40.0), (0.005 * size, 0.05 * size), True
        )
    if rng.random() < 0.2:
        sigma = _between(rng, 0.002, 0.015)
        tau_s = _between(rng, 5.0, 60.0)
        errors = replace(errors, scale=(sigma, tau_s))
    if rng.random() < 0.15:
        errors = replace(errors, jitter_s=_between(rng, 0.0005, 0.004))
    if rng.random() < 0.25:
        tail = _TAILS[rng.integers(len(_TAILS))]
        errors = replace(errors, tail=tail)
    if rng.random() < 0.12:
        errors = replace(
            errors, jumps_per_s=0.05, jump=sigmas(0.05 * size, 0.5)
        )
    return errors


def _drifting(
    errors: SensorErrors, rng: np.random.Generator, size: float, by_metre: bool
) -> SensorErrors:
    metres = _between(rng, 0.001, 0.01) * size * _by_axis(rng)
    degrees = _between(rng, 0.01, 0.08) * _by_axis(rng)
    if by_metre:
        walk_by_metre = sigmas(metres / 2, degrees / 4)
        return replace(errors, walk_by_metre=walk_by_metre)
    return replace(errors, walk=sigmas(metres, degrees))


def _slow(
    errors: SensorErrors,
    rng: np.random.Generator,
    tau_s: tuple[float, float],
    metres: tuple[float, float],
    in_world: bool,
) -> SensorErrors:
    sigma_m = _between(rng, *metres)
    sigma_deg = _between(rng, 0.03, 0.3)
    process = GaussMarkov(
        _between(rng, *tau_s), sigmas(sigma_m, sigma_deg), in_world
    )
    return replace(errors, slow=(*errors.slow, process))


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number from a log-uniform distribution."""
    return float(low * (high / low) ** rng.random())


def _by_axis(rng: np.random.Generator) -> FloatArray:
    """Draw factors (3,) near 1, one for each axis."""
    return np.exp(0.35 * rng.standard_normal(3))
