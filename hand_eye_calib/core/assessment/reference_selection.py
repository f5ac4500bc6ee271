"""Option ``reference: auto``: choose the reference with the answer nearest to ``adaptive``."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import estimator
from hand_eye_calib.core.noise.estimator import AdaptiveSolution
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, motion_pairs
from hand_eye_calib.core.solvers.registry import Method

# References that are compared.
_CANDIDATES = ("B1", "B2", "B3", "B5", "B7", "B10", "B15", "B20", "C5", "C10")

# Fewest poses from which the noise is estimated.
MIN_POSES = 13
# Fewest motion pairs of a candidate that is compared.
_MIN_PAIRS = 6


@dataclass(frozen=True)
class ReferenceChoice:
    """Chosen reference, and the candidates for it.

    Attributes
    ----------
    reference : str
    distances : dict of str to float
        Distance of the answer of each candidate from the answer of the adaptive estimator, in
        standard deviations of the adaptive estimator.
    model : AdaptiveSolution
        The answer of the adaptive estimator.
    """

    reference: str
    distances: dict[str, float]
    model: AdaptiveSolution

    def reason(self) -> str:
        """Return the reason for the choice in one sentence."""
        distances = self.distances.values()
        return (
            f"{self.reference} of {', '.join(self.distances)}: its estimate is nearest to the "
            f"adaptive estimator's, {min(distances):.1f} standard deviations off; the farthest is "
            f"{max(distances):.1f} off"
        )


def select_reference(
    pose_pairs: PosePairs,
    method: Method,
    solution: AdaptiveSolution | None = None,
) -> ReferenceChoice:
    """Choose the reference for a method.

    The residual does not reveal the best reference (Välimäki et al. 2023, section 4.2), but the
    answer X0 of the adaptive estimator does. X0 has a smaller error than the candidates. As the
    best linear estimator, its error is uncorrelated with the distances between X0 and the
    candidates. So the candidate nearest to X0 is probably the best.

    Parameters
    ----------
    pose_pairs : PosePairs
    method : Method
    solution : AdaptiveSolution, optional
        Solution of the adaptive estimator for these poses; computed if left out.

    Raises
    ------
    NotEnoughDataError
        If there are too few poses to choose.
    """
    if len(pose_pairs) < MIN_POSES:
        raise NotEnoughDataError(
            f"reference auto needs at least {MIN_POSES} synchronised poses, "
            f"found {len(pose_pairs)}; record longer, or name a reference such as B1"
        )
    poses = pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c
    solution = solution or estimator.solve(
        pose_pairs.stamps_ns, *poses, quick=True
    )
    information = np.linalg.pinv(
        solution.cov_parent_child_in_child, hermitian=True
    )
    back = se3.inverse(solution.T_parent_child)
    distances: dict[str, float] = {}
    for reference in _CANDIDATES:
        pairs = motion_pairs(*poses, reference)
        if len(pairs) >= _MIN_PAIRS:
            answer = method.solve(pairs).T_parent_child
            deviation = se3.log(back @ answer)
            square = float(deviation @ information @ deviation)
            distances[reference] = max(square, 0.0) ** 0.5
    nearest = min(distances, key=distances.__getitem__)
    return ReferenceChoice(nearest, distances, solution)
