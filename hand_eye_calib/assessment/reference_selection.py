"""``reference: auto``: the reference with the smallest predicted error."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive import estimator
from hand_eye_calib.adaptive.prediction import ReferencePredictor
from hand_eye_calib.errors import NotEnoughDataError

CANDIDATES = ("B1", "B2", "B3", "B5", "B7", "B10", "B15", "B20", "C5", "C10")

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
    """

    reference: str
    predicted_m: dict

    def reason(self):
        """One sentence for a person."""
        worst = max(self.predicted_m, key=self.predicted_m.get)
        return (
            f"{self.reference} of {', '.join(self.predicted_m)}: from the noise of these trajectories a translation error of "
            f"{self.predicted_m[self.reference]:.3g} m is expected with it, {self.predicted_m[worst]:.3g} m with {worst}"
        )


def select_reference(pose_pairs, method, candidates=CANDIDATES):
    """Choose the reference for a method.

    The residual cannot tell which reference is best (Välimäki et al. 2023, section 4.2). The noise can: once the adaptive estimator
    has found how strong it is and how it wanders, the error of every reference follows from it.

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
    solution = estimator.solve(*poses, nuisances=("none",))
    rejection = (method.threshold, method.min_inlier_fraction) if method.name == "dnlo" else ()
    predictor = ReferencePredictor(*poses, solution, *rejection)
    covariances = {reference: predictor.covariance(reference) for reference in candidates}
    predicted_m = {
        reference: float(np.sqrt(np.trace(covariance[:3, :3])))
        for reference, covariance in covariances.items()
        if covariance is not None
    }
    if not predicted_m:
        # Nothing to choose by: the motion leaves a direction open with every reference.
        return ReferenceChoice("B1", {"B1": float("inf")})
    return ReferenceChoice(min(predicted_m, key=predicted_m.get), predicted_m)
