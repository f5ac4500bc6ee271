"""Error metrics of Välimäki et al. 2023, section 3.3. Metres and radians."""

from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry.se3 import absolute_errors
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs


class Errors(NamedTuple):
    """Errors of a calibration: translations (m) and rotations (rad).

    ``e_rt`` and ``e_rR`` are the mean relative errors over the motion pairs. Relative errors need
    no ground truth, but a smaller one does not mean that a calibration is nearer to the truth.
    ``e_at`` and ``e_aR`` are the absolute errors against the ground truth.
    """

    e_rt: float
    e_rR: float
    e_at: float
    e_aR: float


def errors(
    pairs: MotionPairs,
    T_parent_child: FloatArray,
    truth_T_parent_child: FloatArray,
) -> Errors:
    """Return all four metrics of a calibration."""
    return Errors(
        *relative_errors(pairs, T_parent_child),
        *absolute_errors(T_parent_child, truth_T_parent_child),
    )


def relative_errors(
    pairs: MotionPairs, T_parent_child: FloatArray
) -> tuple[float, float]:
    """Return the mean relative errors e_rt (m) and e_rR (rad) of motion pairs, eqs 6 and 7.

    There must be at least one motion pair.
    """
    translation, rotation = pairs.residuals(T_parent_child)
    return (
        float(np.linalg.norm(translation, axis=1).mean()),
        float(np.linalg.norm(rotation, axis=1).mean()),
    )
