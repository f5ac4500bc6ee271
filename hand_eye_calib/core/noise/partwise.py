"""Posterior of a long recording, computed in consecutive parts.

A :class:`~hand_eye_calib.core.noise.state_space.Posterior` needs about 9 kB of memory a pose. A
:class:`PartwisePosterior` computes the posteriors of the parts in turn, adds their normal
equations, and stores only what a step of the parameters needs. The states of different parts are
independent: increments between parts are not used. The parts are so long that the lost information
is negligible.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.noise.normal import NormalEquations
from hand_eye_calib.core.noise.state_space import (
    MAX_BLOCKS,
    Posterior,
    StateSpace,
    combined,
)

# Largest number of poses of a recording that is not divided. Batches of residuals are as large.
MAX_POSES = 10_000
# Largest number of poses of a part. The posterior of such a part needs about 45 MB. For a simulated
# drive of 100,000 poses, parts of 20,000 increase the sigmas by 0.05 %.
PART_POSES = 5_000


class PartwisePosterior:
    """Posterior of states and parameters in parts, with the attributes of ``Posterior``.

    Parameters
    ----------
    space_of : callable
        Return the state space of a subset of the poses, given by indices.
    n_poses : int
        Number of all poses.
    prior : (p + 1, p + 1) array
        Prior of the parameters, as in
        :class:`~hand_eye_calib.core.noise.state_space.StateSpace`.
    levels : (m,) array
    """

    def __init__(
        self,
        space_of: Callable[[IntArray], StateSpace],
        n_poses: int,
        prior: FloatArray,
        levels: FloatArray,
    ) -> None:
        n_parts = -(-n_poses // PART_POSES)
        self._poses_of_parts = np.array_split(np.arange(n_poses), n_parts)
        self._space_of = space_of
        self._prior = prior
        self._levels = levels
        self.products = prior.copy()
        self.log_determinant = 0.0
        # Lambda^-1 U' W [J e] of each part, (m, d, p + 1).
        self._solved_columns = []
        for part in self._parts():
            self.products += part.products
            self.log_determinant += part.log_determinant
            self._solved_columns.append(part.factor.restore(part.whitened))
        self.normal = NormalEquations(self.products)
        determinants = self.log_determinant + self.normal.log_determinant
        self.loss = 0.5 * float(determinants + self.normal.cost)

    def parts(self) -> Iterator[Posterior]:
        """Compute the posterior of each part again, now with the parameters from all parts."""
        for part in self._parts():
            part.normal = self.normal
            yield part

    def _parts(self) -> Iterator[Posterior]:
        """Compute the posterior of each part. The parameters have no prior."""
        for poses in self._poses_of_parts:
            space = self._space_of(poses)
            yield Posterior(
                replace(space, prior=np.zeros_like(self._prior)), self._levels
            )

    def states_after(self, step: FloatArray) -> FloatArray:
        """Return the posterior mean (N, d) of the states after a step (p,) of the parameters."""
        mixing = np.r_[step, 1.0][:, None]
        states = [combined(columns, mixing) for columns in self._solved_columns]
        return np.concatenate(states)[:, :, 0]

    def part_products(self) -> FloatArray:
        """Return the contribution of each block of time to ``products``, for the jackknife."""
        n_blocks = max(MAX_BLOCKS // len(self._poses_of_parts), 1)
        products = np.concatenate(
            [part.part_products(n_blocks) for part in self._parts()]
        )
        return products + self._prior / len(products)
