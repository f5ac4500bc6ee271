"""What every solver returns."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Solution:
    """A solver's answer to AX = XB.

    Attributes
    ----------
    T_parent_child : (4, 4) array
        X. Directions that the motion does not excite at all are left at zero translation or at the
        start's rotation.
    objective : float
        The method's own cost at X.
    converged : bool
        False is an answer too: the iteration ended before it settled, and X is only the best point
        seen.
    iterations : int
        Iterations of the method's main loop.
    weights : (K,) array
        Weight of each motion pair, 1 for all pairs of methods without outlier rejection.
    """

    T_parent_child: np.ndarray
    objective: float
    converged: bool
    iterations: int
    weights: np.ndarray
