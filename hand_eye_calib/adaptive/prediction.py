"""How well a method of the paper would do with a given reference, predicted from the noise that the adaptive estimator found.

DNL and DNLO minimise ``sum w (|r_t|^2 + 2 |r_R|^2)`` over pairs (i, j). To first order the residual of a pair is the sum of the
increments between i and j, written in the parent world's axes, plus what their rotation errors do to the path that is still ahead:

    r_R(i, j) = sum_l r_R(l)          r_t(i, j) = sum_l r_t(l) + r_R(l) x (G_j - G_{l+1})

with G the path of the child so far. The error of the answer is therefore linear in the increments, whose covariance is known: white
noise, drift, and what is left of jumps and systematic errors that the method does not model.

One effect of second order is too large to leave out: noise in R_A looks like motion and pulls t towards zero, the more so the less
the sensors turn between i and j. With noise of variance s^2 per axis in the rotations of w pairs, t is off by
``-2 s^2 w (sum w (R_A - I)'(R_A - I))^-1 t``.
"""

import numpy as np

from hand_eye_calib.adaptive.increments import Increments
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers import dnl, dnlo


class ReferencePredictor:
    """Predicts the error of DNL or DNLO for any reference.

    Parameters
    ----------
    stamps_ns, Ts_pw_p, Ts_cw_c
        As for :func:`hand_eye_calib.adaptive.estimator.solve`.
    solution : AdaptiveSolution
        Its answer for them.
    threshold, min_inlier_fraction : float, optional
        Those of dnlo; without a threshold all pairs count.
    """

    def __init__(self, stamps_ns, Ts_pw_p, Ts_cw_c, solution, threshold=None, min_inlier_fraction=0.0):
        self._poses = Ts_pw_p, Ts_cw_c
        self._solution = solution
        self._rejection = threshold, min_inlier_fraction
        increments = Increments(stamps_ns, Ts_pw_p, Ts_cw_c, solution.centre)
        # As the method sees them: systematic errors are part of the residual, not taken out.
        T_parent_child = solution.T_parent_child
        self._bands = np.tensordot(solution.noise.variances(), increments.components(T_parent_child), axes=1)
        modelled = increments.residuals(T_parent_child, solution.nuisance, solution.parameters)
        plain = increments.residuals(T_parent_child)
        self._systematic = np.where(solution.left_out[:, None], 0.0, plain - modelled)
        self._jumps = np.where(solution.left_out[:, None], plain, 0.0)
        # The way to a pose that is wrong by itself and the way back are one event.
        self._events = np.flatnonzero(np.r_[True, ~solution.spikes[1:-1]])
        self._into_world = Ts_pw_p[:, :3, :3] @ T_parent_child[:3, :3]
        steps = (self._into_world[:-1] @ increments.translation_b[:, :, None])[:, :, 0]
        self._path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def covariance(self, reference):
        """(6, 6) mean squared error of xi = (rho, phi) expected with a reference; None where it leaves too few pairs."""
        pairs = motion_pairs(*self._poses, reference)
        if len(pairs) < 6:
            return None
        weights = self._weights(pairs)
        gain = self._gain(pairs, weights)
        if gain is None:
            return None
        flat = gain.reshape(6, -1)
        expected = flat @ _band_product(self._bands, flat.T)
        systematic = np.einsum("anb,nb->a", gain, self._systematic)
        jumps = np.add.reduceat(np.einsum("anb,nb->na", gain, self._jumps), self._events, axis=0)
        pull = self._pull(pairs, weights)
        return expected + np.outer(systematic, systematic) + jumps.T @ jumps + np.outer(pull, pull)

    def _pull(self, pairs, weights):
        """(6,) array: by how much rotation noise is expected to pull the translation towards zero."""
        rotation, translation = self._solution.T_parent_child[:3, :3], self._solution.T_parent_child[:3, 3]
        noise = self._solution.noise
        spans = float(weights @ (pairs.j - pairs.i))
        # The parent's share of the noise: half of either variance; white noise enters at both ends of a motion.
        total = float(weights.sum()) * noise.rotation_white**2 + 0.5 * spans * noise.rotation_drift**2
        moved = pairs.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
        turning = np.einsum("k,kai,kaj->ij", weights, moved, moved)
        return np.r_[-2.0 * total * (rotation.T @ np.linalg.pinv(turning, hermitian=True) @ translation), np.zeros(3)]

    def _weights(self, pairs):
        threshold, fraction = self._rejection
        if threshold is None:
            return np.ones(len(pairs))
        return dnlo.truncate(dnl.pair_costs(pairs, self._solution.T_parent_child), threshold, fraction * len(pairs))[0]

    def _gain(self, pairs, weights):
        """(6, n, 6) array: change of xi by each increment's (r_R, r_t); None where the pairs do not determine xi."""
        i, j = pairs.i, pairs.j
        turned = self._into_world[j] - self._into_world[i]
        jacobian_t = np.concatenate([turned, self._into_world[i] @ se3.skew(pairs.Ts_childi_childj[:, :3, 3])], axis=2)
        jacobian_r = np.concatenate([np.zeros_like(turned), turned], axis=2)
        per_t = weights[:, None, None] * np.swapaxes(jacobian_t, 1, 2)
        per_r = 2 * weights[:, None, None] * np.swapaxes(jacobian_r, 1, 2)
        hessian = (per_t @ jacobian_t + per_r @ jacobian_r).sum(axis=0)
        if np.linalg.cond(hessian) > 1e12:
            return None
        path = self._path
        over_t = _sum_over_spans(per_t, i, j, len(path) - 1)
        over_r = _sum_over_spans(per_r - per_t @ se3.skew(path[j]), i, j, len(path) - 1)
        from_r = over_r + over_t @ se3.skew(path[1:])
        gain = -np.linalg.solve(hessian, np.concatenate([from_r, over_t], axis=2))
        return np.swapaxes(gain, 0, 1)


def _sum_over_spans(values, i, j, n_increments):
    """For each increment the sum of the values (K, ...) of all pairs (i, j) that span it."""
    changes = np.zeros((n_increments + 1, *values.shape[1:]))
    np.add.at(changes, i, values)
    np.subtract.at(changes, j, values)
    return np.cumsum(changes[:-1], axis=0)


def _band_product(bands, columns):
    """Product of a symmetric matrix in lower bands with columns (m, k)."""
    product = bands[0][:, None] * columns
    size = len(columns)
    for offset in range(1, len(bands)):
        band = bands[offset, : size - offset, None]
        product[offset:] += band * columns[: size - offset]
        product[: size - offset] += band * columns[offset:]
    return product
