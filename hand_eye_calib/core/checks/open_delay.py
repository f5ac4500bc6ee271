"""Covariance of an extrinsic for a delay of positions that a recording neither proves nor excludes.

The positions of a stream may be later than its orientations. At constant speed such a delay equals
a lever arm, so even a long recording determines the delay only to some milliseconds. A delay below
the limit of a finding still shifts the extrinsic.

Model: the delay of a stream is normal with mean zero. In most streams its standard deviation is
FLOOR_TRAVEL_S, which the allowance covers; in a few faulty streams it is _FAULTY_S. The estimate of
the regression has a normal error. Bayes' rule returns the probability of a fault and the mean
square of the delay by this fault. The covariance is the product of both, times the squared change
of the extrinsic for a delay of 1 s.
"""

from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.common_mode import FLOOR_TRAVEL_S
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.checks.fault_regression import Regression
from hand_eye_calib.core.checks.findings import (
    LIMITS,
    Finding,
    Severity,
    finding,
)
from hand_eye_calib.core.geometry import se3

_STREAMS = ("child", "parent")

# Share of the streams whose positions are late by a fault: an assumption.
_FAULTY_SHARE = 0.1
# Standard deviation (s) of the delays of such streams.
_FAULTY_S = 0.03
# An estimated delay with a larger standard deviation (s) than this is ignored: the allowance was
# measured on such recordings, so it covers such delays.
_MAX_SIGMA_S = 0.015


class OpenDelay(NamedTuple):
    """Delay of positions that a recording leaves open.

    Attributes
    ----------
    covariance : (6, 6) array
        Covariance of xi = (rho, phi) in ``T_parent_child @ exp(xi)``, in m and rad, in addition to
        the allowance.
    found : Finding or None
        A note if the covariance is large; otherwise None.
    """

    covariance: FloatArray
    found: Finding | None = None


#: Result if no delay is open.
NO_DELAY = OpenDelay(np.zeros((6, 6)))


def open_delay(fast: Regression, X: FloatArray) -> OpenDelay:
    """Return the open delay with the largest covariance of the extrinsic.

    Parameters
    ----------
    fast : Regression
        Regression with the groups ``late_child`` and ``late_parent``.
    X : (4, 4) array
        Extrinsic of the regression.
    """
    # A late child and an early parent are nearly the same, so only the larger covariance counts.
    delays = [_of_stream(fast, stream, X) for stream in _STREAMS]
    return max(
        delays, key=lambda delay: float(np.trace(delay.covariance[:3, :3]))
    )


def _of_stream(fast: Regression, stream: str, X: FloatArray) -> OpenDelay:
    """Return the open delay of the positions of one stream."""
    group = f"late_{stream}"
    delays_s, sigmas_s = fast.fit(group)
    delay_s = float(delays_s[0])
    sigma_s = float(sigmas_s[0])
    if not sigma_s < _MAX_SIGMA_S:
        return NO_DELAY
    variance_s2 = faulty_variance(delay_s, sigma_s)
    # Change of X in the parent's axes for a delay of 1 s: lever arm (m) and rotation (rad).
    response = fast.response(group)[:, 0]
    R_child_parent = se3.rotation_of(X).T
    by_delay = np.concatenate(
        [R_child_parent @ response[:3], R_child_parent @ response[3:]]
    )
    covariance = variance_s2 * np.outer(by_delay, by_delay)
    shift_m = float(np.sqrt(np.trace(covariance[:3, :3])))
    if shift_m < LIMITS["late"].note:
        return OpenDelay(covariance)
    note = finding(
        "maybe_late",
        stream,
        Severity.NOTE,
        part="positions" if delay_s > 0 else "orientations",
        others="orientations" if delay_s > 0 else "positions",
        delay_s=abs(delay_s),
        sigma_s=sigma_s,
        shift_m=shift_m,
    )
    return OpenDelay(covariance, note)


def faulty_variance(delay_s: float, sigma_s: float) -> float:
    """Return the mean square (s^2) of a delay by a fault, times the probability of the fault.

    Parameters
    ----------
    delay_s, sigma_s : float
        Estimate of the delay and its standard deviation.
    """
    # Index 0: streams without a fault. Index 1: faulty streams.
    prior_variances = np.array([FLOOR_TRAVEL_S**2, _FAULTY_S**2])
    variances = prior_variances + sigma_s**2
    log_posterior = np.log([1.0 - _FAULTY_SHARE, _FAULTY_SHARE])
    log_posterior -= 0.5 * (np.log(variances) + delay_s**2 / variances)
    fault_probability = 1.0 / (
        1.0 + np.exp(log_posterior[0] - log_posterior[1])
    )
    # Posterior of the delay of a faulty stream: mean, and variance ``shrinkage * sigma_s**2``.
    shrinkage = prior_variances[1] / variances[1]
    mean_s = shrinkage * delay_s
    return float(fault_probability * (mean_s**2 + shrinkage * sigma_s**2))
