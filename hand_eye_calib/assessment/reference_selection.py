"""``reference: auto``: of the references with nearly the smallest predicted error, the one nearest
to the adaptive estimator's answer.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive import estimator
from hand_eye_calib.adaptive.prediction import ReferencePredictor
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.pairing.motion_pairs import motion_pairs

CANDIDATES = ("B1", "B2", "B3", "B5", "B7", "B10", "B15", "B20", "C5", "C10")

# References whose predicted error is within this factor of the smallest are told apart by their
# answers.
_NEARLY_AS_GOOD = 1.3

# Fewer poses say too little about the noise to choose by it.
_FEWEST_POSES = 13


@dataclass(frozen=True)
class ReferenceChoice:
    """A reference and why it was chosen.

    Attributes
    ----------
    reference : str
    predicted_m : dict of str to float
        Root mean square translation error in m that is expected of every candidate.
    alike : tuple of str
        The candidates with nearly the smallest of these, among which their answers decided.
    """

    reference: str
    predicted_m: dict
    alike: tuple = ()

    def reason(self):
        """One sentence for a person."""
        worst = max(self.predicted_m, key=self.predicted_m.get)
        decided = (
            f"; of {', '.join(self.alike)} its answer is nearest to the adaptive estimator's"
            if len(self.alike) > 1
            else ""
        )
        return (
            f"{self.reference} of {', '.join(self.predicted_m)}: from the noise of these trajectories a translation error of "
            f"{self.predicted_m[self.reference]:.3g} m is expected with it, {self.predicted_m[worst]:.3g} m with {worst}{decided}"
        )


def select_reference(pose_pairs, method, candidates=CANDIDATES):
    """Choose the reference for a method.

    The residual cannot tell which reference is best (Välimäki et al. 2023, section 4.2). The noise
    can: once the adaptive estimator has found how strong it is and how it wanders, the error of
    every reference follows from it. Where several are expected to do about equally well, chance
    decides which of them does best on these poses; the one whose answer is nearest to the adaptive
    estimator's is the best guess: that estimator's own error is the smaller one and, being that of
    the best linear estimator, independent of how far the others lie from it.

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
        Where there are too few poses to choose.
    """
    if len(pose_pairs) < _FEWEST_POSES:
        raise NotEnoughDataError(
            f"reference auto needs at least {_FEWEST_POSES} synchronised poses, found {len(pose_pairs)}; "
            "drive on, or name a reference"
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
        # Nothing to choose by: the motion leaves a direction open with every reference.
        return ReferenceChoice("B1", {"B1": float("inf")})
    limit = _NEARLY_AS_GOOD * min(predicted_m.values())
    alike = tuple(reference for reference, expected in predicted_m.items() if expected <= limit)
    return ReferenceChoice(
        _nearest(pose_pairs, method, alike, solution.T_parent_child), predicted_m, alike
    )


def _nearest(pose_pairs, method, references, T_parent_child):
    """The reference with which the method's translation is nearest to a given answer's."""
    if len(references) == 1:
        return references[0]
    fast = dataclasses.replace(method, backend="fast")

    def distance(reference):
        T = fast.solve(
            motion_pairs(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, reference)
        ).T_parent_child
        return float(np.linalg.norm(T[:3, 3] - T_parent_child[:3, 3]))

    return min(references, key=distance)
