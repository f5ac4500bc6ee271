"""``reference: auto``: the reference whose answer is nearest to the adaptive estimator's."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import estimator
from hand_eye_calib.core.noise.estimator import AdaptiveSolution
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, motion_pairs
from hand_eye_calib.core.solvers.registry import Method

_CANDIDATES = ("B1", "B2", "B3", "B5", "B7", "B10", "B15", "B20", "C5", "C10")

# Fewest poses from which the noise can be estimated; fewest pairs that say something.
MIN_POSES = 13
_MIN_PAIRS = 6


@dataclass(frozen=True)
class ReferenceChoice:
    """A reference; by candidate, the distance of its answer from the adaptive estimator's, in
    standard deviations of that; and the adaptive estimator's.
    """

    reference: str
    distances: dict[str, float]
    model: AdaptiveSolution

    def reason(self) -> str:
        """The reason in one sentence."""
        nearest, farthest = (choose(self.distances.values()) for choose in (min, max))
        return (
            f"{self.reference} of {', '.join(self.distances)}: its estimate is nearest to the "
            f"adaptive estimator's, {nearest:.1f} standard deviations off; the farthest is "
            f"{farthest:.1f} off"
        )


def select_reference(
    pose_pairs: PosePairs, method: Method, solution: AdaptiveSolution | None = None
) -> ReferenceChoice:
    """Choose the reference for a method; ``solution`` is the adaptive estimator's for these poses,
    if it is known.

    The residual cannot tell which reference is best (Välimäki et al. 2023, section 4.2). The
    adaptive estimator can: its error is smaller and, as that of the best linear estimator,
    uncorrelated with the distance of other answers from it. So the answer nearest to it is
    probably the best one.

    Raises
    ------
    NotEnoughDataError
        If there are too few poses to choose.
    """
    if len(pose_pairs) < MIN_POSES:
        raise NotEnoughDataError(
            f"reference auto needs at least {MIN_POSES} synchronised poses, "
            f"found {len(pose_pairs)}; drive on, or name a reference"
        )
    poses = pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c
    solution = solution or estimator.solve(pose_pairs.stamps_ns, *poses, quick=True)
    information = np.linalg.pinv(solution.cov_parent_child_in_child, hermitian=True)
    to_answer = se3.inverse(solution.T_parent_child)
    distances = {}
    for reference in _CANDIDATES:
        pairs = motion_pairs(*poses, reference)
        if len(pairs) >= _MIN_PAIRS:
            error = se3.log(to_answer @ method.solve(pairs).T_parent_child)
            distances[reference] = max(float(error @ information @ error), 0.0) ** 0.5
    return ReferenceChoice(min(distances, key=distances.__getitem__), distances, solution)
