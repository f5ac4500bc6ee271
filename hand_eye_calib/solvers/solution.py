"""Solutions of AX = XB."""

from dataclasses import dataclass

from hand_eye_calib.arrays import FloatArray


@dataclass(frozen=True)
class Solution:
    """Solution of AX = XB for K motion pairs.

    Attributes
    ----------
    T_parent_child : (4, 4) array
        X. Directions that the motion does not excite at all keep zero translation or the rotation
        of the start.
    objective : float
        The method's own cost at X.
    converged : bool
        Whether the iteration settled. If not, X is the best point it reached.
    weights : (K,) array
        Weight of each motion pair; 1 for all with methods that do not reject outliers.
    """

    T_parent_child: FloatArray
    objective: float
    converged: bool
    weights: FloatArray
