"""Second opinions: robust least squares estimates that test the result of the noise model.

Model: if the noise model is right, its result has the smallest variance of all estimates. The
difference d of another estimate from the result then has the variance

    Var(d) = Var(other estimate) - Var(result)

(J. A. Hausman, *Specification tests in econometrics*, Econometrica 46, 1978). The estimates differ
in their stride, the number of poses that a motion spans. The excess of an estimate is ``d^2 -
Var(d)``, or zero if this is negative. The median excess is the variance that the noise model
misses.
"""

from collections.abc import Sequence

import numpy as np

from hand_eye_calib.core.assessment.covariance import (
    Assessment,
    combined,
    model_covariance,
)
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import medians
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import turned
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers.robust import RobustSolution, solve_strides

# The excess of an estimate is zero if its standard deviation exceeds that of the result by this
# factor: it may be far from the result by chance. Chosen among 2, 3 and no limit on recordings of
# KinHEC 1.1 and on the simulated classes: smallest widening at equal coverage.
_MAX_SIGMA_RATIO = 2.0

# The iteration ends if the step is below this share of the standard deviation of the estimate.
_STEP_TOLERANCE = 0.1


def second_opinions(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, T_parent_child: FloatArray
) -> tuple[Assessment, ...]:
    """Return estimates of the extrinsic by robust least squares, one for each of several strides.

    A stride is the number of poses that a motion spans. A stride whose solve does not converge is
    omitted.

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Synchronised poses of both sensors. The time offset and the scale of the result are already
        applied.
    T_parent_child : (4, 4) array
        Result of the noise model. The solves start there.
    """
    strides = solve_strides(Ts_pw_p, Ts_cw_c, T_parent_child, _STEP_TOLERANCE)
    return tuple(
        assess_robust(stride.pairs, stride.solution)
        for stride in strides
        if stride.solution.converged
    )


def assess_robust(pairs: MotionPairs, solution: RobustSolution) -> Assessment:
    """Return the standard deviations and unknown directions of a robust solution."""
    _, unknown = model_covariance(pairs, solution)
    return combined(
        solution.T_parent_child, solution.cov_parent_child_in_child, unknown
    )


def excess_covariance(
    answer: Assessment, opinions: Sequence[Assessment]
) -> FloatArray:
    """Return the covariance that the noise model misses, estimated from the second opinions.

    Parameters
    ----------
    answer : Assessment
        Result of the noise model.
    opinions : sequence of Assessment
        Estimates of :func:`second_opinions`. If empty, the covariance is zero.

    Returns
    -------
    (6, 6) array
        Covariance of xi = (rho, phi) in ``T_parent_child @ exp(xi)``, in m and rad. Along
        the axes of the parent it is diagonal, and zero on axes that the result does not determine.
    """
    if not opinions:
        return np.zeros((6, 6))
    is_known = np.isfinite(answer.sigmas)
    sigmas = np.where(is_known, answer.sigmas, 0.0)
    excesses = []
    for opinion in opinions:
        difference = se3.deviation(
            opinion.T_parent_child, answer.T_parent_child
        )
        expected = np.maximum(opinion.sigmas**2 - sigmas**2, 0.0)
        is_comparable = opinion.sigmas < _MAX_SIGMA_RATIO * sigmas
        excesses.append(
            np.where(
                is_comparable, np.maximum(difference**2 - expected, 0.0), 0.0
            )
        )
    variances = medians(np.array(excesses).T)
    return turned(se3.rotation_of(answer.T_parent_child).T, np.diag(variances))
