"""Poses that were written in another convention than they were read in, put right."""

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3


def put_right(Ts: FloatArray, invert: str = "none", quaternion: str = "xyzw") -> FloatArray:
    """Poses (N, 4, 4) in another convention.

    Parameters
    ----------
    Ts : (N, 4, 4) array
    invert : {"none", "poses", "orientations"}
        What was written the other way round: of the world in the sensor.
    quaternion : {"xyzw", "wxyz"}
        Order in which quaternions were written that were read as x y z w.
    """
    if quaternion == "wxyz":
        quats = np.roll(se3.to_quat_xyzw(Ts), -1, axis=-1)
        Ts = se3.from_quat_xyzw(Ts[..., :3, 3], quats)
    if invert == "poses":
        return se3.inverse(Ts)
    if invert == "orientations":
        Ts = Ts.copy()
        Ts[..., :3, :3] = np.swapaxes(Ts[..., :3, :3], -1, -2)
    return Ts
