"""Views of a flat target, whose normal is the z axis of its frame.

A camera measures the tilt of a flat target by its foreshortening, which is the cosine of the angle
between normal and line of sight. So the error of a tilt is in inverse proportion to the sine of
this angle. A target seen from the front may appear tilted or mirrored without any fault.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops

# Smallest sine of the angle between normal and line of sight (3 deg). At smaller angles the
# foreshortening is of second order.
_MIN_SINE = 0.05

# Shortest line of sight (m). It keeps divisors positive.
_TINY_M = 1e-12


def sines_of_views(Ts_target_camera: FloatArray) -> FloatArray:
    """Return the sine (N,) of the angle between normal and line of sight; at least _MIN_SINE."""
    positions = se3.translation_of(Ts_target_camera)
    lengths = np.linalg.norm(positions, axis=1)
    across = np.linalg.norm(positions[:, :2], axis=1)
    return np.asarray(
        np.maximum(across / np.maximum(lengths, _TINY_M), _MIN_SINE)
    )


def usual_sine(stops: Stops) -> float:
    """Return the median of :func:`sines_of_views` over the stops."""
    return float(median(sines_of_views(stops.Ts_world_child)))
