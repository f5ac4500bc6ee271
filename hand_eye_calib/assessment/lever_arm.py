"""Directions of the lever arm that the rotations do not reveal.

A rotation R moves the end of a lever arm d by (R - I) d. Over K motions the mean square is d' S d,
with S = mean (R - I)'(R - I). If all rotations are about one axis, d along that axis does not move:
the translation of the child sensor along it stays unknown. This is the one rule for that; the
covariance, the stream checks and the hints to the driver all use it.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray

# A direction counts as revealed if the rotations move it with this many times the power of the
# rotation errors. With less, noise alone would look like that motion.
_MIN_SIGNAL_TO_NOISE = 3.0

# Nor is it revealed if it moves less than this share of the direction that moves most: all rotation
# is then about that direction to within 2.3 deg. Odometry errors of a per cent or two of the
# rotation are common. They are systematic, so that the residuals do not show them.
MIN_SHARE = 0.04

# Rotation errors are never taken to be smaller than this (rad): rounding, not motion.
ROUNDING_ANGLE = 1e-6

# An axis is hidden if this share of it lies in directions that are not revealed.
HIDDEN_SHARE = 0.1


@dataclass(frozen=True)
class LeverArms:
    """How far rotations move lever arms of 1 m.

    Attributes
    ----------
    powers : (3,) array
        Mean square displacement along three orthogonal directions, ascending, in m^2.
    directions : (3, 3) array
        The directions, one a column.
    information : (3, 3) array
        S: ``d' S d`` is the mean square displacement of the lever arm d.
    """

    powers: FloatArray
    directions: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, chords: FloatArray, weights: FloatArray | None = None) -> "LeverArms":
        """The lever arms of motions with these chords (K, 3, 3): R - I of each, or (R - I) Q for
        lever arms in a frame that Q rotates from; and their weights (K,), 1 by default.
        """
        weights = np.ones(len(chords)) if weights is None else weights
        information = weighted_products(weights, chords) / max(float(weights.sum()), 1.0)
        powers, directions = np.linalg.eigh(information)
        return cls(powers, directions, information)

    def hidden_directions(
        self, cov_rotation: FloatArray | None = None, least_share: float = MIN_SHARE
    ) -> FloatArray:
        """The directions (3, U) that the rotations do not reveal.

        Parameters
        ----------
        cov_rotation : (3, 3) array, optional
            Covariance C of the rotation errors, rad^2, in the frame of the lever arms. An error e
            moves a lever arm d by ``e x d``, with the mean square ``d' (tr(C) I - C) d``.
        least_share : float
            Least displacement, as a share of that along the direction that moves most.
        """
        cov_rotation = np.zeros((3, 3)) if cov_rotation is None else cov_rotation
        noise = np.trace(cov_rotation) * np.eye(3) - cov_rotation + ROUNDING_ANGLE**2 * np.eye(3)
        noise_powers = np.array([d @ noise @ d for d in self.directions.T])
        least = np.maximum(_MIN_SIGNAL_TO_NOISE * noise_powers, least_share**2 * self.powers[-1])
        return self.directions[:, self.powers < least]

    def hidden_axes(self, cov_rotation: FloatArray | None = None) -> tuple[str, ...]:
        """Names of the axes x, y, z that lie too far in the hidden directions to be known."""
        shares = (self.hidden_directions(cov_rotation) ** 2).sum(axis=1)
        return tuple(
            axis for axis, share in zip("xyz", shares, strict=True) if share > HIDDEN_SHARE
        )


def weighted_products(weights: FloatArray, jacobian: FloatArray) -> FloatArray:
    """``sum w J'J`` (p, p) of derivatives J (K, r, p) with weights (K,)."""
    size = jacobian.shape[2]
    weighted = weights[:, None, None] * jacobian
    return weighted.reshape(-1, size).T @ jacobian.reshape(-1, size)
