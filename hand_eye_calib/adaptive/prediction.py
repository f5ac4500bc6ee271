"""How well a method of the paper would do with a given reference, predicted from the noise that the
adaptive estimator found.

DNL and DNLO minimise ``sum w (|r_t|^2 + 2 |r_R|^2)`` over pairs (i, j). To first order the residual
of a pair is the sum of the increments between i and j, written in the parent world's axes, plus
what their rotation errors do to the path that is still ahead:

    r_R(i, j) = sum_l r_R(l)          r_t(i, j) = sum_l r_t(l) + r_R(l) x (G_j - G_{l+1})

with G the path of the child so far. The error of the answer is therefore linear in the increments,
whose covariance is known: white noise, drift, and what is left of jumps and systematic errors that
the method does not model.

One effect of second order is too large to leave out: noise in R_A looks like motion and pulls t
towards zero, the more so the less the sensors turn between i and j. With noise of variance s^2 per
axis in the rotations of w pairs, t is off by ``-2 s^2 w (sum w (R_A - I)'(R_A - I))^-1 t``.
"""

import numpy as np

from hand_eye_calib.adaptive.block_tridiagonal import BLOCK, blocks_below, diagonal_blocks
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

    def __init__(
        self, stamps_ns, Ts_pw_p, Ts_cw_c, solution, threshold=None, min_inlier_fraction=0.0
    ):
        self._poses = Ts_pw_p, Ts_cw_c
        self._solution = solution
        self._rejection = threshold, min_inlier_fraction
        increments = Increments(stamps_ns, Ts_pw_p, Ts_cw_c, solution.centre)
        # As the method sees them: systematic errors are part of the residual, not taken out.
        T_parent_child = solution.T_parent_child
        bands = increments.components(T_parent_child).covariance(solution.noise.variances())
        self._diagonal, self._below = diagonal_blocks(bands), blocks_below(bands)
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
        """(6, 6) mean squared error of xi = (rho, phi) expected with a reference; None where it
        leaves too few pairs.
        """
        pairs = motion_pairs(*self._poses, reference)
        if len(pairs) < 6:
            return None
        weights = self._weights(pairs)
        hessian, pushes = self._pushes(pairs, weights)
        if np.linalg.cond(hessian) > 1e12:
            return None
        flat = pushes.reshape(-1, BLOCK)
        systematic = self._systematic.ravel() @ flat
        jumps = np.add.reduceat((self._jumps[:, None] @ pushes)[:, 0], self._events, axis=0)
        pushed = (
            flat.T @ self._of_noise(pushes).reshape(-1, BLOCK)
            + np.outer(systematic, systematic)
            + jumps.T @ jumps
        )
        pull = self._pull(pairs, weights)
        return np.linalg.solve(hessian, np.linalg.solve(hessian, pushed).T) + np.outer(pull, pull)

    def _of_noise(self, columns):
        """The increments' covariance times columns (n, 6, k)."""
        product = self._diagonal @ columns
        product[1:] += self._below @ columns[:-1]
        product[:-1] += np.swapaxes(self._below, 1, 2) @ columns[1:]
        return product

    def _pull(self, pairs, weights):
        """(6,) array: by how much rotation noise is expected to pull the translation towards zero."""
        rotation, translation = (
            self._solution.T_parent_child[:3, :3],
            self._solution.T_parent_child[:3, 3],
        )
        noise = self._solution.noise
        spans = float(weights @ (pairs.j - pairs.i))
        # The parent's share of the noise: half of either variance; white noise enters at both ends
        # of a motion.
        total = (
            float(weights.sum()) * noise.rotation_white**2 + 0.5 * spans * noise.rotation_drift**2
        )
        moved = pairs.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
        turning = (weights[:, None, None] * moved).reshape(-1, 3).T @ moved.reshape(-1, 3)
        return np.r_[
            -2.0 * total * (rotation.T @ np.linalg.pinv(turning, hermitian=True) @ translation),
            np.zeros(3),
        ]

    def _weights(self, pairs):
        threshold, fraction = self._rejection
        if threshold is None:
            return np.ones(len(pairs))
        return dnlo.truncate(
            dnl.pair_costs(pairs, self._solution.T_parent_child), threshold, fraction * len(pairs)
        )[0]

    def _pushes(self, pairs, weights):
        """Half the cost's second derivative by xi, (6, 6), and (n, 6, 6): by how much each
        increment's (r_R, r_t) pushes xi against it.
        """
        i, j, path = pairs.i, pairs.j, self._path
        turned = self._into_world[j] - self._into_world[i]
        jacobian = np.zeros((len(pairs), 6, 6))  # of r_R before r_t, by xi
        jacobian[:, :3, 3:] = jacobian[:, 3:, :3] = turned
        jacobian[:, 3:, 3:] = self._into_world[i] @ se3.skew(pairs.Ts_childi_childj[:, :3, 3])
        weighted = weights[:, None, None] * jacobian
        weighted[:, :3] *= 2
        hessian = weighted.reshape(-1, 6).T @ jacobian.reshape(-1, 6)
        # What a rotation error does to the path still ahead, from its own increment's end to the
        # pair's.
        weighted[:, :3] += se3.skew(path[j]) @ weighted[:, 3:]
        pushes = _sum_over_spans(weighted, i, j, len(path) - 1)
        pushes[:, :3] -= se3.skew(path[1:]) @ pushes[:, 3:]
        return hessian, pushes


def _sum_over_spans(values, i, j, n_increments):
    """For each increment the sum of the values (K, ...) of all pairs (i, j) that span it, both in
    order.
    """
    sums = np.zeros((len(values) + 1, *values.shape[1:]))
    np.cumsum(values, axis=0, out=sums[1:])
    increments = np.arange(n_increments)
    return (
        sums[np.searchsorted(i, increments, side="right")]
        - sums[np.searchsorted(j, increments, side="right")]
    )
