"""An extrinsic that somebody states: what is installed, or what a calibration found."""

from dataclasses import dataclass, field

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3


def _exact() -> FloatArray:
    return np.zeros((6, 6))


@dataclass(frozen=True)
class Extrinsic:
    """Pose of the child sensor in the parent sensor's frame, as stated by a source.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    origin : str
        Where it comes from, for a person.
    covariance : (6, 6) array
        Of the error xi in ``T_parent_child @ exp(xi)``; zero if the source states none.
    is_calibration : bool
        Whether it was found from motion, with the same sensors.
    """

    T_parent_child: FloatArray
    origin: str
    covariance: FloatArray = field(default_factory=_exact)
    is_calibration: bool = False

    @property
    def values(self) -> FloatArray:
        """(6,) array: x, y, z (m) and roll, pitch, yaw (rad)."""
        rpy = se3.rotation_to_rpy(self.T_parent_child[:3, :3])
        return np.r_[self.T_parent_child[:3, 3], rpy]

    @property
    def covariance_in_parent(self) -> FloatArray:
        """(6, 6) array: covariance of the errors along and about the axes of the parent's frame."""
        to_parent = np.kron(np.eye(2), self.T_parent_child[:3, :3])
        return np.asarray(to_parent @ self.covariance @ to_parent.T)
