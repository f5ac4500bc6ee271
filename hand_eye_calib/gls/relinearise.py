"""Derivatives from poses freed of their errors, as far as these are known.

Everything else is of first order in the errors. Where noise is not small beside the motion from
pose to pose, the derivatives themselves are noise, and draw the answer (errors in variables). So
the errors c are smoothed and split between the sensors. White errors are split by

    Ad(X^-1) a = S' (S' + S)^-1 c,     b = -S (S' + S)^-1 c

with the white covariances S' of the parent and S of the child, in the child's frame: with a lever
arm, a translation says which of the sensors rotated. This holds for errors of these covariances
only. A lasting error of some centimetres beside white noise of a millimetre would be taken for
large and opposite rotations, so other errors are split in halves. The poses are corrected by
``Exp(-a)`` and ``Exp(-b)``, derivatives are taken there, and what was taken out of the residuals is
put back.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.chunks import chunks
from hand_eye_calib.gls.increments import Linearisation, Streams, turned


@dataclass(frozen=True)
class SensorWhite:
    """Covariances (1 or N, 6, 6) of the white errors of both sensors, in the child's frame."""

    of_parent: FloatArray
    of_child: FloatArray

    def __getitem__(self, part: slice) -> SensorWhite:
        of_parent, of_child = (
            of_sensor if len(of_sensor) == 1 else of_sensor[part]
            for of_sensor in (self.of_parent, self.of_child)
        )
        return SensorWhite(of_parent, of_child)

    def share_of_parent(self) -> FloatArray:
        """Matrices (1 or N, 6, 6) from the white error of both sensors to that of the parent."""
        both = self.of_parent + self.of_child
        return np.swapaxes(np.linalg.solve(both, self.of_parent), 1, 2)


def corrected(
    streams: Streams,
    white_error: FloatArray,
    other_error: FloatArray,
    T_parent_child: FloatArray,
    white: SensorWhite,
) -> Streams:
    """Streams without the errors c (N, 6): the white ones split by the white covariances of both
    sensors, the others in halves.
    """
    Ts_pw_p, Ts_cw_c = np.empty_like(streams.Ts_pw_p), np.empty_like(streams.Ts_cw_c)
    to_parent = se3.adjoint(T_parent_child).T
    for part in chunks(len(streams)):
        by_parent = turned(white[part].share_of_parent(), white_error[part])
        by_child = by_parent - white_error[part]
        by_parent = by_parent + 0.5 * other_error[part]
        by_child = by_child - 0.5 * other_error[part]
        Ts_pw_p[part] = streams.Ts_pw_p[part] @ se3.exp(-by_parent @ to_parent)
        Ts_cw_c[part] = streams.Ts_cw_c[part] @ se3.exp(-by_child)
    return Streams(streams.stamps_s, Ts_pw_p, Ts_cw_c)


def restored(linearisation: Linearisation, error: FloatArray) -> Linearisation:
    """A linearisation at corrected poses with the error c (N, 6) back in its residuals."""
    columns = linearisation.columns.copy()
    columns[:, :, -1] += error[1:] - turned(linearisation.adjoints, error[:-1])
    return dataclasses.replace(linearisation, columns=columns)
