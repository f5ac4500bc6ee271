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

from __future__ import annotations

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.increments import (
    N_SYSTEMATIC,
    Streams,
    course_of,
    linearise,
    motions,
    turned,
)
from hand_eye_calib.gls.solution import AdaptiveSolution
from hand_eye_calib.gls.state_space import Covariance
from hand_eye_calib.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.solvers import dnl, dnlo


class ReferencePredictor:
    """Predicts the error of DNL or DNLO for any reference.

    Parameters
    ----------
    stamps_ns, Ts_pw_p, Ts_cw_c
        As for :func:`hand_eye_calib.gls.estimator.solve`.
    solution : AdaptiveSolution
        Its answer for them.
    threshold, min_inlier_fraction : float, optional
        Those of dnlo; without a threshold all pairs count.
    """

    def __init__(
        self,
        stamps_ns: IntArray,
        Ts_pw_p: FloatArray,
        Ts_cw_c: FloatArray,
        solution: AdaptiveSolution,
        threshold: float | None = None,
        min_inlier_fraction: float = 0.0,
    ) -> None:
        self._poses = Ts_pw_p, Ts_cw_c
        self._solution = solution
        self._rejection = threshold, min_inlier_fraction
        streams = Streams((stamps_ns - stamps_ns[0]) * 1e-9, Ts_pw_p, Ts_cw_c)
        X = solution.T_parent_child
        course = course_of(streams, X)
        # As the method sees them: systematic errors are part of the residual, not taken out.
        plain = linearise(streams, course, X, np.zeros(N_SYSTEMATIC), ())
        modelled = plain.residuals
        if solution.parameters.any():
            modelled = linearise(streams, course, X, solution.parameters, ()).residuals
        cut = np.zeros(len(streams) - 1, dtype=bool)
        space = solution.model.state_space(streams, plain, course.twists, X, solution.weights, cut)
        self._increments = Covariance(space, solution.levels)
        left_out = solution.left_out[:, None]
        self._systematic = np.where(left_out, 0.0, plain.residuals - modelled)
        self._jumps = np.where(left_out, plain.residuals, 0.0)
        # The way to a pose that is wrong by itself and the way back are one event.
        self._events = np.flatnonzero(np.r_[True, ~solution.spikes[1:-1]])
        self._into_world = Ts_pw_p[:, :3, :3] @ X[:3, :3]
        steps = turned(self._into_world[:-1], motions(Ts_cw_c)[:, :3, 3])
        self._path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        self._arms = se3.skew(self._path[1:])

    def covariance(self, reference: str) -> FloatArray | None:
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
        flat = pushes.reshape(-1, 6)
        systematic = self._systematic.ravel() @ flat
        jumps = np.add.reduceat((self._jumps[:, None] @ pushes)[:, 0], self._events, axis=0)
        pushed = (
            self._increments.products(pushes) + np.outer(systematic, systematic) + jumps.T @ jumps
        )
        pull = self._pull(pairs, weights)
        return np.linalg.solve(hessian, np.linalg.solve(hessian, pushed).T) + np.outer(pull, pull)

    def _pull(self, pairs: MotionPairs, weights: FloatArray) -> FloatArray:
        """(6,) array: expected pull of the translation towards zero by rotation noise."""
        rotation, translation = (
            self._solution.T_parent_child[:3, :3],
            self._solution.T_parent_child[:3, 3],
        )
        # The parent's share of the noise is half of its variance.
        total = 0.5 * float(weights @ self._solution.noise.rotation_variance(pairs.j - pairs.i))
        moved = pairs.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
        turning = (weights[:, None, None] * moved).reshape(-1, 3).T @ moved.reshape(-1, 3)
        return np.r_[
            -2.0 * total * (rotation.T @ np.linalg.pinv(turning, hermitian=True) @ translation),
            np.zeros(3),
        ]

    def _weights(self, pairs: MotionPairs) -> FloatArray:
        threshold, fraction = self._rejection
        if threshold is None:
            return np.ones(len(pairs))
        return dnlo.truncate(
            dnl.pair_costs(pairs, self._solution.T_parent_child), threshold, fraction * len(pairs)
        )[0]

    def _pushes(self, pairs: MotionPairs, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Half the cost's second derivative by xi, (6, 6), and (n, 6, 6): by how much each
        increment pushes xi against it.
        """
        i, j, path = pairs.i, pairs.j, self._path
        # Of r_t by xi; of r_R by phi alone, the same as of r_t by rho.
        jacobian = np.empty((len(pairs), 3, 6))
        np.subtract(self._into_world[j], self._into_world[i], out=jacobian[:, :, :3])
        jacobian[:, :, 3:] = self._into_world[i] @ se3.skew(pairs.Ts_childi_childj[:, :3, 3])
        weighted = np.empty((len(pairs), 6, 6))  # r_R before r_t
        np.multiply(weights[:, None, None], jacobian, out=weighted[:, 3:])
        hessian = weighted[:, 3:].reshape(-1, 6).T @ jacobian.reshape(-1, 6)
        hessian[3:, 3:] += 2.0 * hessian[:3, :3]
        # What a rotation error does to the path still ahead, from its own increment's end to the
        # pair's.
        np.matmul(se3.skew(path[j]), weighted[:, 3:], out=weighted[:, :3])
        weighted[:, :3, 3:] += 2.0 * weighted[:, 3:, :3]
        pushes = _sum_over_spans(weighted, i, j, len(path) - 1)
        pushes[:, :3] -= self._arms @ pushes[:, 3:]
        # Increments are translation before rotation, along the child's axes at their ends.
        back, found = np.swapaxes(self._into_world[1:], 1, 2), np.empty_like(pushes)
        np.matmul(back, pushes[:, 3:], out=found[:, :3])
        np.matmul(back, pushes[:, :3], out=found[:, 3:])
        return hessian, found


def _sum_over_spans(values: FloatArray, i: IntArray, j: IntArray, n_increments: int) -> FloatArray:
    """For each increment the sum of the values (K, ...) of all pairs (i, j) that span it, both in
    order.
    """
    sums = np.zeros((len(values) + 1, *values.shape[1:]))
    np.cumsum(values, axis=0, out=sums[1:])
    increments = np.arange(n_increments)
    spans = sums.take(np.searchsorted(i, increments, side="right"), axis=0)
    spans -= sums.take(np.searchsorted(j, increments, side="right"), axis=0)
    return spans
