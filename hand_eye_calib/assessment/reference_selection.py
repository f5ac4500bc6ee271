"""``reference: auto``: of the references with nearly the smallest predicted error, of translation
and rotation together, the one nearest to the adaptive estimator's answer.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.metrics import absolute_errors
from hand_eye_calib.assessment.mount_change import PossibleShift, possible_shift
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.gls import estimator
from hand_eye_calib.gls.estimator import AdaptiveSolution
from hand_eye_calib.gls.prediction import ReferencePredictor
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.solvers.solution import Solution

CANDIDATES = ("B1", "B2", "B3", "B5", "B7", "B10", "B15", "B20", "C5", "C10")

# Among references with a predicted error within this factor of the smallest, their answers decide.
_NEARLY_AS_GOOD = 1.3

# Of these, answers whose distances from the adaptive estimator's are within this factor of the
# smallest are alike, and the predicted error decides.
_NEARLY_AS_NEAR = 1.1

# Fewest poses from which the noise can be estimated.
MIN_POSES = 13

# Smallest predicted error (m, rad) to divide by: noise-free data has none.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class ReferenceChoice:
    """A reference and why it was chosen.

    Attributes
    ----------
    reference : str
    predicted_m, predicted_rad : dict of str to float
        Candidate to its predicted root mean square translation (m) and rotation error (rad).
    alike : tuple of str
        The candidates with nearly the smallest joint error, among which their answers decided.
    answer : ((4, 4) array, (6, 6) array) or None
        The adaptive estimator's answer and its covariance, if it knows all axes.
    shift : PossibleShift or None
        Of the mount within the recording, by that estimator.
    solution : Solution or None
        The method's answer with the reference, if it was compared with others.
    """

    reference: str
    predicted_m: dict[str, float]
    predicted_rad: dict[str, float]
    alike: tuple[str, ...] = ()
    answer: tuple[FloatArray, FloatArray] | None = None
    shift: PossibleShift | None = None
    solution: Solution | None = None

    def joint_errors(self) -> dict[str, float]:
        """Candidate to its predicted error in translation and rotation together: the root mean
        square of both, each in units of the smallest one of any candidate.
        """
        least_m, least_rad = self._least()
        return {
            reference: float(
                np.hypot(metres / least_m, self.predicted_rad[reference] / least_rad) / np.sqrt(2)
            )
            for reference, metres in self.predicted_m.items()
        }

    def distance(self, T_parent_child: FloatArray, T_other: FloatArray) -> float:
        """Distance of two answers in the units of :meth:`joint_errors`."""
        metres, radians = absolute_errors(T_parent_child, T_other)
        least_m, least_rad = self._least()
        return float(np.hypot(metres / least_m, radians / least_rad))

    def reason(self) -> str:
        """The reason in one sentence."""
        joint = self.joint_errors()
        worst = max(joint, key=lambda reference: joint[reference])
        decided = (
            f"; of {', '.join(self.alike)} its answer is nearest to the adaptive estimator's"
            if len(self.alike) > 1
            else ""
        )
        return (
            f"{self.reference} of {', '.join(joint)}: with the noise of these trajectories its "
            f"predicted error is {self._errors(self.reference)}, that of {worst} "
            f"{self._errors(worst)}{decided}"
        )

    def _errors(self, reference: str) -> str:
        degrees = np.degrees(self.predicted_rad[reference])
        return f"{self.predicted_m[reference]:.3g} m and {degrees:.2g} deg"

    def _least(self) -> tuple[float, float]:
        return (
            max(min(self.predicted_m.values()), _ROUNDING),
            max(min(self.predicted_rad.values()), _ROUNDING),
        )


def select_reference(
    pose_pairs: PosePairs,
    method: Method,
    candidates: Sequence[str] = CANDIDATES,
    solution: AdaptiveSolution | None = None,
) -> ReferenceChoice:
    """Choose the reference for a method.

    The residual cannot tell which reference is best (Välimäki et al. 2023, section 4.2). The
    noise can: the adaptive estimator identifies its level and drift, and the expected error of
    every reference follows from them, in translation and rotation together. If several references
    have about the same expected error, chance decides which of them does best on these poses. The
    best guess is then the one whose answer is nearest to the adaptive estimator's: the error of
    that estimator is smaller and, as that of the best linear estimator, uncorrelated with the
    distance of the other answers from it.

    Parameters
    ----------
    pose_pairs : PosePairs
    method : Method
    candidates : sequence of str
    solution : AdaptiveSolution, optional
        The adaptive estimator's answer for these poses, if it is known.

    Returns
    -------
    ReferenceChoice

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
    poses = pose_pairs.stamps_ns, pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c
    # The choice of a pair's length asks for the fast errors: white noise, drift, jumps.
    solution = solution or estimator.solve(*poses, quick=True)
    predictor = ReferencePredictor(*poses, solution, *method.rejection)
    predicted = {reference: predictor.covariance(reference) for reference in candidates}
    covariances = {name: found for name, found in predicted.items() if found is not None}
    if not covariances:
        # No prediction: with every reference the motion leaves a direction unobservable.
        return ReferenceChoice("B1", {"B1": float("inf")}, {"B1": float("inf")})
    choice = ReferenceChoice("", _rms(covariances, slice(0, 3)), _rms(covariances, slice(3, 6)))
    joint = choice.joint_errors()
    limit = _NEARLY_AS_GOOD * min(joint.values())
    alike = tuple(reference for reference, expected in joint.items() if expected <= limit)
    found = _nearest(pose_pairs, method, dataclasses.replace(choice, alike=alike), solution)
    if not solution.converged or solution.unseen.size:
        return found
    answer = solution.T_parent_child, solution.cov_parent_child_in_child
    shift = possible_shift(solution.part_products, solution.misfit)
    return dataclasses.replace(found, answer=answer, shift=shift)


def _rms(covariances: Mapping[str, FloatArray], part: slice) -> dict[str, float]:
    """Root mean square error of a part of xi by reference."""
    return {
        reference: float(np.sqrt(np.trace(covariance[part, part])))
        for reference, covariance in covariances.items()
    }


def _nearest(
    pose_pairs: PosePairs, method: Method, choice: ReferenceChoice, solution: AdaptiveSolution
) -> ReferenceChoice:
    """With the one of the alike references with which the method's answer is nearest to a solution;
    of those that are about as near, the one with the smallest predicted error.
    """
    if len(choice.alike) == 1:
        return dataclasses.replace(choice, reference=choice.alike[0])
    fast = dataclasses.replace(method, backend="fast")
    answers = {
        reference: fast.solve(motion_pairs(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, reference))
        for reference in choice.alike
    }
    distances = {
        reference: choice.distance(answer.T_parent_child, solution.T_parent_child)
        for reference, answer in answers.items()
    }
    limit, joint = _NEARLY_AS_NEAR * min(distances.values()), choice.joint_errors()
    nearest = min((name for name in distances if distances[name] <= limit), key=joint.__getitem__)
    answer = answers[nearest] if method == fast else None
    return dataclasses.replace(choice, reference=nearest, solution=answer)
