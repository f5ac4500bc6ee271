"""``reference: auto``: of the references with nearly the smallest predicted error, the one nearest
to the adaptive estimator's answer.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive import estimator
from hand_eye_calib.adaptive.prediction import ReferencePredictor
from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.registry import Method

CANDIDATES = ("B1", "B2", "B3", "B5", "B7", "B10", "B15", "B20", "C5", "C10")

# Among references with a predicted error within this factor of the smallest, their answers decide.
_NEARLY_AS_GOOD = 1.3

# Fewest poses from which the noise can be estimated.
_MIN_POSES = 13


@dataclass(frozen=True)
class ReferenceChoice:
    """A reference and why it was chosen.

    Attributes
    ----------
    reference : str
    predicted_m : dict of str to float
        Candidate to its predicted root mean square translation error, m.
    alike : tuple of str
        The candidates with nearly the smallest error, among which their answers decided.
    """

    reference: str
    predicted_m: dict[str, float]
    alike: tuple[str, ...] = ()

    def reason(self) -> str:
        """The reason in one sentence."""
        worst = max(self.predicted_m, key=lambda reference: self.predicted_m[reference])
        decided = (
            f"; of {', '.join(self.alike)} its answer is nearest to the adaptive estimator's"
            if len(self.alike) > 1
            else ""
        )
        return (
            f"{self.reference} of {', '.join(self.predicted_m)}: with the noise of these "
            "trajectories its predicted translation error is "
            f"{self.predicted_m[self.reference]:.3g} m, that of {worst} "
            f"{self.predicted_m[worst]:.3g} m{decided}"
        )


def select_reference(
    pose_pairs: PosePairs, method: Method, candidates: Sequence[str] = CANDIDATES
) -> ReferenceChoice:
    """Choose the reference for a method.

    The residual cannot tell which reference is best (Välimäki et al. 2023, section 4.2). The noise
    can: the adaptive estimator identifies its level and drift, and the expected error of every
    reference follows from them. If several references have about the same expected error, chance
    decides which of them does best on these poses. The best guess is then the one whose answer is
    nearest to the adaptive estimator's: the error of that estimator is smaller and, as that of the
    best linear estimator, uncorrelated with the distance of the other answers from it.

    Parameters
    ----------
    pose_pairs : PosePairs
    method : Method
    candidates : sequence of str

    Returns
    -------
    ReferenceChoice

    Raises
    ------
    NotEnoughDataError
        If there are too few poses to choose.
    """
    if len(pose_pairs) < _MIN_POSES:
        raise NotEnoughDataError(
            f"reference auto needs at least {_MIN_POSES} synchronised poses, "
            f"found {len(pose_pairs)}; drive on, or name a reference"
        )
    poses = pose_pairs.stamps_ns, pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c
    solution = estimator.solve(*poses)
    predictor = ReferencePredictor(*poses, solution, *method.rejection)
    covariances = {reference: predictor.covariance(reference) for reference in candidates}
    predicted_m = {
        reference: float(np.sqrt(np.trace(covariance[:3, :3])))
        for reference, covariance in covariances.items()
        if covariance is not None
    }
    if not predicted_m:
        # No prediction: with every reference the motion leaves a direction unobservable.
        return ReferenceChoice("B1", {"B1": float("inf")})
    limit = _NEARLY_AS_GOOD * min(predicted_m.values())
    alike = tuple(reference for reference, expected in predicted_m.items() if expected <= limit)
    return ReferenceChoice(
        _nearest(pose_pairs, method, alike, solution.T_parent_child), predicted_m, alike
    )


def _nearest(
    pose_pairs: PosePairs, method: Method, references: Sequence[str], T_parent_child: FloatArray
) -> str:
    """The reference with which the method's translation is nearest to that of a transform."""
    if len(references) == 1:
        return references[0]
    fast = dataclasses.replace(method, backend="fast")

    def distance(reference: str) -> float:
        T = fast.solve(
            motion_pairs(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, reference)
        ).T_parent_child
        return float(np.linalg.norm(T[:3, 3] - T_parent_child[:3, 3]))

    return min(references, key=distance)
