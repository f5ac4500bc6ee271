"""Derivatives from poses freed of their errors, as far as these are known.

Everything else is of first order in the errors. Where noise is not small beside the motion from
pose to pose, the derivatives themselves are noise, and draw the answer (errors in variables). So
the errors c are smoothed and split between the sensors,

    a = Ad(X) S' (S' + S)^-1 c,     b = -S (S' + S)^-1 c,     S' = Ad(X^-1) S Ad(X^-1)',

S being the white covariance of one sensor; the poses are corrected by ``Exp(-a)`` and ``Exp(-b)``,
derivatives are taken there, and what was taken out of the residuals is put back.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from hand_eye_calib.adaptive.increments import Linearisation, Streams, turned
from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3


def corrected(
    streams: Streams, error: FloatArray, T_parent_child: FloatArray, white: FloatArray
) -> Streams:
    """Streams without the error c (N, 6), split by the white covariance (6, 6) of one sensor."""
    to_child = se3.adjoint(se3.inverse(T_parent_child))
    of_parent = to_child @ white @ to_child.T
    by_parent = error @ np.linalg.solve(of_parent + white, of_parent)
    by_child = by_parent - error
    at_parent = by_parent @ se3.adjoint(T_parent_child).T
    return Streams(
        streams.stamps_s,
        streams.Ts_pw_p @ se3.exp(-at_parent),
        streams.Ts_cw_c @ se3.exp(-by_child),
    )


def restored(linearisation: Linearisation, error: FloatArray) -> Linearisation:
    """A linearisation at corrected poses with the error c (N, 6) back in its residuals."""
    residuals = linearisation.residuals + error[1:] - turned(linearisation.adjoints, error[:-1])
    return dataclasses.replace(linearisation, residuals=residuals)
