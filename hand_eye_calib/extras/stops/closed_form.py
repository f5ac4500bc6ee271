"""Closed form of X and Z from stops, ``A_i X = Z B_i``, from which the fit starts.

A_i and B_i are the poses of parent and child, each in its own world. The rotations maximise the sum
of ``tr(R_X' R_A_i' R_Z R_B_i)``: M. Shah, *Solving the robot-world/hand-eye calibration problem
using the Kronecker product*, Journal of Mechanisms and Robotics 5(3), 2013, eq. 18. The
translations follow from ``R_A_i t_X - t_Z = R_Z t_B_i - t_A_i`` by linear least squares.
"""

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.geometry import se3

# Number of starts from random subsets of stops. If half of the stops are outliers, the probability
# that each of 60 subsets has an outlier is 0.03 % (0.875 to the 60th power).
_N_STARTS = 60
# Number of stops in a subset.
_STOPS_PER_START = 3

# Starts are compared by this quantile of the errors of all stops: fewer than half of the stops may
# be right.
_COMPARED_QUANTILE = 0.4


@dataclass(frozen=True)
class Stops:
    """Poses of both sensors at N stops.

    Parameters
    ----------
    Ts_world_parent : (N, 4, 4) array
        A_i: poses of the parent sensor in its world.
    Ts_world_child : (N, 4, 4) array
        B_i: poses of the child sensor in its world.
    has_target : bool
        Whether the child is a camera whose world is a flat target. The normal of the target is its
        z axis.
    """

    Ts_world_parent: FloatArray
    Ts_world_child: FloatArray
    has_target: bool = False

    def __len__(self) -> int:
        return len(self.Ts_world_parent)

    def __getitem__(self, rows: IntArray | BoolArray) -> "Stops":
        return replace(
            self,
            Ts_world_parent=self.Ts_world_parent[rows],
            Ts_world_child=self.Ts_world_child[rows],
        )


def closest_rotations(
    R_a: FloatArray, R_b: FloatArray, weights: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the rotations X and Z (3, 3) that minimise the differences of ``R_a X`` and ``Z R_b``.

    Parameters
    ----------
    R_a, R_b : (N, 3, 3) arrays
        Rotations of both sensors at the stops.
    weights : (N,) array, optional
        Weights of the stops.
    """
    weighted = R_a if weights is None else weights[:, None, None] * R_a
    # The sum of tr(X' R_a' Z R_b) is vec(X)' form vec(Z). The largest singular vectors of the form
    # are X and Z, up to length and a common sign. The sign is chosen for positive determinants.
    form = np.einsum("nji,nka->iajk", weighted, R_b).reshape(9, 9)
    left_vectors, _, right_vectors = np.linalg.svd(form)
    matrix_X = left_vectors[:, 0].reshape(3, 3)
    matrix_Z = right_vectors[0].reshape(3, 3)
    sign = -1.0 if np.linalg.det(matrix_X) < 0 else 1.0
    X, Z = se3.nearest_rotation(sign * np.stack([matrix_X, matrix_Z]))
    return X, Z


def _closed_form(stops: Stops) -> tuple[FloatArray, FloatArray]:
    """Return the least squares X and Z (4, 4) of all stops: rotations first, then translations."""
    R_A = se3.rotation_of(stops.Ts_world_parent)
    R_B = se3.rotation_of(stops.Ts_world_child)
    R_X, R_Z = closest_rotations(R_A, R_B)
    # R_A t_X - t_Z = R_Z t_B - t_A
    minus_one = -np.broadcast_to(np.eye(3), (len(stops), 3, 3))
    columns = np.concatenate([R_A, minus_one], axis=2)
    t_A = se3.translation_of(stops.Ts_world_parent)
    values = se3.translation_of(stops.Ts_world_child) @ R_Z.T - t_A
    translations, *_ = np.linalg.lstsq(
        columns.reshape(-1, 6), values.ravel(), rcond=1e-9
    )
    X = se3.from_rotation_translation(R_X, translations[:3])
    Z = se3.from_rotation_translation(R_Z, translations[3:])
    return X, Z


def starts_of(stops: Stops) -> list[tuple[FloatArray, FloatArray]]:
    """Return X and Z (4, 4) from the closed forms of all stops and of a few stops.

    The few stops are the random subset with the smallest errors of the other stops. If the closed
    form of all stops is better, it is the only start.
    """
    random = np.random.default_rng(0)
    n = len(stops)
    starts = [_closed_form(stops)]
    if n > _STOPS_PER_START:
        for _ in range(_N_STARTS):
            rows = random.choice(n, _STOPS_PER_START, replace=False)
            starts.append(_closed_form(stops[rows]))
    between = se3.inverse(stops.Ts_world_child)
    errors = np.stack(
        [
            between @ se3.inverse(Z) @ stops.Ts_world_parent @ X
            for X, Z in starts
        ]
    )
    best = int(np.argmin(_costs(errors)))
    return starts[:1] if best == 0 else [starts[0], starts[best]]


def _costs(errors: FloatArray) -> FloatArray:
    """Return the costs (M,) of M candidates with errors (M, N, 4, 4) at N stops.

    The cost is the logarithm of the product of two quantiles: of the distances and of the angles. A
    subset fits its own stops, so the quantile is larger than their share.
    """
    tiny = np.finfo(float).tiny
    n = errors.shape[1]
    rank = min(max(_STOPS_PER_START, int(_COMPARED_QUANTILE * n)), n - 1)
    lengths_m = np.linalg.norm(se3.translation_of(errors), axis=-1)
    distances_m = np.sort(lengths_m, axis=1)[:, rank]
    angles_rad = se3.rotation_angle(se3.rotation_of(errors))
    angles_rad = np.sort(angles_rad, axis=1)[:, rank]
    return np.asarray(np.log(distances_m + tiny) + np.log(angles_rad + tiny))
