"""Second opinions on an answer of the noise model: robust least squares on the same poses.

Model: if the noise model is right, its answer has the smallest variance of all. The difference d of
another answer then has the variance

    Var(d) = Var(other) - Var(answer)

(J. A. Hausman, *Specification tests in econometrics*, Econometrica 46, 1978). Motions over each of
several numbers of poses have an answer. The excess of an answer is ``d^2 - Var(d)``, and at least
zero. The median of the excesses is the variance that the noise model misses.
"""

from collections.abc import Sequence

import numpy as np

from hand_eye_calib.core.assessment.covariance import Assessment, combined, model_covariance
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import medians
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers.robust import RobustSolution, solve_strides

# An answer with more than this many standard deviations of the noise model's answer has no excess.
# Chance alone makes its distance large. Chosen among 2, 3 and no limit on recordings of KinHEC 1.1
# and on the simulated classes: the smallest widening at equal coverage.
_COMPARABLE = 2.0

# A step below this share of a standard deviation of the answer ends the iteration.
_STEP_TOLERANCE = 0.1


def second_opinions(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, T_parent_child: FloatArray
) -> tuple[Assessment, ...]:
    """Solve by robust least squares, once for each of several strides.

    A stride is the number of poses that a motion spans. Solutions that do not
    converge are left out.

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Synchronised poses of both sensors, with the time offset and the scale of the answer.
    T_parent_child : (4, 4) array
        The answer, from which the solves start.
    """
    strides = solve_strides(Ts_pw_p, Ts_cw_c, T_parent_child, _STEP_TOLERANCE)
    return tuple(
        assess_robust(stride.pairs, stride.solution)
        for stride in strides
        if stride.solution.converged
    )


def assess_robust(pairs: MotionPairs, solution: RobustSolution) -> Assessment:
    """Assess a robust solution of motion pairs by its own covariance."""
    _, unknown = model_covariance(pairs, solution)
    return combined(solution.T_parent_child, solution.cov_parent_child_in_child, unknown)


def excess_covariance(answer: Assessment, opinions: Sequence[Assessment]) -> FloatArray:
    """Return the covariance that the noise model misses, by second opinions on its answer.

    Returns
    -------
    (6, 6) array
        Covariance of xi = (rho, phi) in ``T_parent_child @ exp(xi)``, in m and rad. It is diagonal
        in the axes of the parent, and zero on axes that the answer does not determine.
    """
    if not opinions:
        return np.zeros((6, 6))
    is_known = np.isfinite(answer.sigmas)
    sigmas = np.where(is_known, answer.sigmas, 0.0)
    excesses = []
    for opinion in opinions:
        difference = se3.deviation(opinion.T_parent_child, answer.T_parent_child)
        expected = np.maximum(opinion.sigmas**2 - sigmas**2, 0.0)
        is_comparable = opinion.sigmas < _COMPARABLE * sigmas
        excesses.append(np.where(is_comparable, np.maximum(difference**2 - expected, 0.0), 0.0))
    variances = medians(np.array(excesses).T)
    return se3.turned(se3.rotation_of(answer.T_parent_child).T, np.diag(variances))
