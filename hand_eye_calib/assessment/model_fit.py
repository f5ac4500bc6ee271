"""Whether the adaptive estimator's noise model fits a recording, with DNLO's answer as the witness:
the choice of ``method: auto``.

A model that fits gives the better answer. One that does not can be wrong by any amount, while DNLO,
which only assumes that most motion pairs are good, stays near the truth.
"""

import numpy as np

from hand_eye_calib.adaptive.estimator import AdaptiveSolution
from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import Assessment
from hand_eye_calib.geometry import se3

# Largest share of the increments that may be jumps: with jumps at a tenth of the poses of both
# trajectories it is a fifth.
MAX_JUMPS = 0.25

# Largest weighted squared residual per degree of freedom: it is 1 if the model holds, and less if
# there is no noise.
MAX_MISFIT = 2.0

# Largest distance of both answers, squared, in units of their joint covariance: a chi-squared with
# 6 degrees of freedom exceeds it once in a thousand recordings.
_MAX_DISAGREEMENT = 22.46

# Answers that differ by less (m, rad) are the same: with data without noise, no statistic means
# anything.
_ROUNDING = 1e-6


def why_not(
    model: AdaptiveSolution,
    of_model: Assessment,
    dnlo: tuple[FloatArray, Assessment],
    floor: FloatArray,
) -> str:
    """What speaks against the noise model, in words; empty if it fits.

    Parameters
    ----------
    model : AdaptiveSolution
    of_model : Assessment
        Of its answer.
    dnlo : (4, 4) array and Assessment
        DNLO's answer.
    floor : (6, 6) array
        Covariance of what neither covariance knows of, see
        :func:`~hand_eye_calib.assessment.floor.common_mode_floor`. Errors of that kind, and they
        are not the model's fault, move the answers apart: their weights differ.
    """
    T_dnlo, of_dnlo = dnlo
    difference = se3.log(se3.inverse(model.T_parent_child) @ T_dnlo)
    if np.abs(difference).max() < _ROUNDING:
        return ""
    if not model.converged:
        return "its answer did not converge"
    if model.is_drowned:
        return "the noise of the poses drowns the rotation between them, and it is of first order"
    jumps = float(np.mean(model.jumps))
    if jumps > MAX_JUMPS:
        return f"{jumps:.0%} of the increments are jumps (at most {MAX_JUMPS:.0%} may be)"
    if model.misfit > MAX_MISFIT:
        return f"its residuals have {model.misfit:.2g} times the variance that it predicts"
    joint = of_model.cov_parent_child_in_child + of_dnlo.cov_parent_child_in_child
    apart = squared_distance(difference, joint + floor)
    if apart > _MAX_DISAGREEMENT:
        return (
            f"its answer is {np.sqrt(apart / 6):.1f} joint standard deviations (root mean square "
            "over the axes) from that of dnlo"
        )
    return ""


def squared_distance(difference: FloatArray, joint: FloatArray) -> float:
    """Square of a difference (6,) of two answers in units of their joint covariance (6, 6): about 6
    or less if that is right. Directions that are unknown to either hardly count.
    """
    return float(difference @ np.linalg.pinv(joint, hermitian=True) @ difference)
