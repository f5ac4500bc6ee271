"""From synchronised poses to a calibration: settle the scale, choose the motion pairs, solve,
assess, add what is known beforehand, judge.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive import estimator as adaptive_estimator
from hand_eye_calib.adaptive.estimator import AdaptiveSolution
from hand_eye_calib.alignment.alignment import MOST_UNEXPLAINED, Scale, estimate_scale
from hand_eye_calib.assessment.covariance import Assessment, assess, assess_adaptive
from hand_eye_calib.assessment.prior import fuse, widened
from hand_eye_calib.assessment.reference_selection import select_reference
from hand_eye_calib.calibration import Calibration, DofVerdict, SolveStatus
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.solvers.solution import Solution

# Beyond this share of jumps the trajectories' errors are not the noise that the adaptive estimator
# models.
_MOST_JUMPS = 0.1


# Tried in turn where the reference that auto chose leaves something unobservable.
_LONGER_REFERENCES = ("B5", "B20")


@dataclass(frozen=True)
class _Evaluation:
    """What solving and assessing gave, whatever the method."""

    solution: Solution | AdaptiveSolution
    assessment: Assessment
    reference: str
    weights: np.ndarray
    reference_reason: str = ""
    noise: dict | None = None
    scale_correction: float = 1.0
    time_correction_s: float = 0.0


def estimate_extrinsic(pose_pairs, config, time_offset=None):
    """Solve and assess synchronised poses.

    Parameters
    ----------
    pose_pairs : PosePairs
        Brought to one clock already.
    config : CalibratorConfig
    time_offset : TimeOffset, optional
        How the child's clock was brought to the parent's, where that was estimated and not given.

    Returns
    -------
    Calibration
        Without frame names.

    Raises
    ------
    NotEnoughDataError
        Where there are too few poses for the reference, or for the scale that was asked for.
    """
    scale, scale_warnings = _settle_scale(pose_pairs, config)
    Ts_cw_c = pose_pairs.Ts_cw_c.copy()
    Ts_cw_c[:, :3, 3] *= scale.value
    scaled = PosePairs(pose_pairs.stamps_ns, pose_pairs.Ts_pw_p, Ts_cw_c)
    evaluation = (
        _solve_adaptive(scaled, config)
        if not METHODS[config.method].uses_reference
        else _solve_pairs(scaled, config)
    )
    solution = evaluation.solution
    spread = _spread_by_nuisances(scale, time_offset)
    assessment = widened(evaluation.assessment, solution.T_parent_child[:3, :3], spread)
    fused = fuse(solution.T_parent_child, assessment, config.prior())
    status, warnings = _judge(solution, fused)
    if evaluation.noise is not None and np.mean(evaluation.weights < 0.5) > _MOST_JUMPS:
        warnings += (
            f"{np.mean(evaluation.weights < 0.5):.0%} of the increments are jumps: these errors are hardly the noise that method adaptive "
            "models; compare with method dnlo",
        )
    return Calibration(
        T_parent_child=fused.T_parent_child,
        covariance=fused.assessment.cov_parent_child_in_child,
        status=status,
        observability=fused.assessment.observability,
        objective=solution.objective,
        method=config.method,
        reference=evaluation.reference,
        reference_reason=evaluation.reference_reason,
        noise=evaluation.noise,
        backend=config.backend,
        n_poses=len(pose_pairs),
        n_pairs=len(evaluation.weights),
        n_inliers=int((evaluation.weights > 0.5).sum()),
        time_offset_s=(time_offset.seconds if time_offset else config.time_offset)
        + evaluation.time_correction_s,
        time_offset_sigma_s=time_offset.sigma_s if time_offset else 0.0,
        scale=scale.value * evaluation.scale_correction,
        scale_sigma=scale.sigma,
        stamp_ns=int(pose_pairs.stamps_ns[-1]),
        warnings=scale_warnings + warnings,
    )


def _solve_pairs(pose_pairs, config):
    """A method of the paper on the motion pairs of one reference."""
    method = Method(config.method, config.threshold, config.min_inlier_fraction, config.backend)
    if config.reference != "auto":
        return _solve_reference(pose_pairs, method, config.reference)
    choice = select_reference(pose_pairs, method)
    chosen = _solve_reference(pose_pairs, method, choice.reference, choice.reason())
    for reference in _LONGER_REFERENCES:
        # Where noise drowns what the motion reveals, longer baselines may still lift it out: the
        # prediction assumes noise without spikes, and is too kind to short ones where there are
        # any.
        if not _unobservable(chosen.assessment):
            break
        if len(pose_pairs) < 2 * int(reference[1:]):
            continue
        longer = _solve_reference(
            pose_pairs,
            method,
            reference,
            f"{reference}: {chosen.reference}, from which less error is predicted, leaves more axes unobservable",
        )
        if len(_unobservable(longer.assessment)) < len(_unobservable(chosen.assessment)):
            chosen = longer
    return chosen


def _solve_reference(pose_pairs, method, reference, reason=""):
    pairs = motion_pairs(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, reference)
    solution = method.solve(pairs)
    assessment = assess(
        pairs, solution, lambda left_out: method.solve_without(pairs, solution, left_out)
    )
    return _Evaluation(solution, assessment, reference, solution.weights, reason)


def _unobservable(assessment):
    return [dof.name for dof in assessment.observability if dof.verdict is DofVerdict.UNOBSERVABLE]


def _solve_adaptive(pose_pairs, config):
    """The adaptive estimator, which has no use for a reference."""
    METHODS[config.method].require_backend(config.backend)
    solution = adaptive_estimator.solve(
        pose_pairs.stamps_ns, pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c
    )
    return _Evaluation(
        solution,
        assess_adaptive(pose_pairs, solution),
        "increments",
        (~solution.jumps).astype(float),
        noise=solution.describe(pose_pairs.stamps_ns),
        scale_correction=solution.scale,
        time_correction_s=solution.time_offset_s,
    )


def _settle_scale(pose_pairs, config):
    """The Scale to use, and what is to be said about it."""
    if config.scale == "none":
        return Scale(1.0, 0.0, None), ()
    if config.scale not in ("auto", "estimate"):
        return Scale(config.scale, 0.0, None), ()
    try:
        scale = estimate_scale(pose_pairs)
    except NotEnoughDataError:
        if config.scale == "estimate":
            raise
        return Scale(1.0, 0.0, None), ()
    if not scale.is_explained:
        if config.scale == "estimate":
            raise NotEnoughDataError(
                f"the scale cannot be estimated: even with one, {scale.unexplained:.0%} of the motion stays unexplained (at most "
                f"{MOST_UNEXPLAINED:.0%} may); check the streams, or give scale"
            )
        return Scale(1.0, 0.0, None), ()
    if config.scale == "auto" and not scale.differs:
        return Scale(1.0, 0.0, None), ()
    said = f"the child's lengths are multiplied by {scale.value:.4f} +/- {scale.sigma:.4f}, as estimated from the motion"
    return scale, (said,) if config.scale == "auto" else ()


def _spread_by_nuisances(scale, time_offset):
    """Covariance (6, 6) that an estimated scale and time offset bring into the extrinsic."""
    spread = np.zeros((6, 6))
    if scale.sigma:
        spread += (
            np.outer(scale.fit.sensitivity[:, 0], scale.fit.sensitivity[:, 0])
            * (scale.sigma / scale.value) ** 2
        )
    if time_offset and time_offset.fit:
        spread += (
            np.outer(time_offset.fit.sensitivity[:, 1], time_offset.fit.sensitivity[:, 1])
            * time_offset.sigma_s**2
        )
    return spread


def _judge(solution, fused):
    names = {
        verdict: [dof.name for dof in fused.assessment.observability if dof.verdict is verdict]
        for verdict in (DofVerdict.UNOBSERVABLE, DofVerdict.PRIOR)
    }
    warnings = []
    if unobservable := names[DofVerdict.UNOBSERVABLE]:
        warnings.append(
            f"the motion does not reveal {', '.join(unobservable)} of the child sensor in the parent sensor's frame: do not use "
            "these values; drive curves over slopes, or measure them by hand and give them as "
            + " and ".join(f"prior {name}=VALUE+/-SIGMA" for name in unobservable)
        )
    if names[DofVerdict.PRIOR]:
        warnings.append(
            f"{', '.join(names[DofVerdict.PRIOR])} of the child sensor: mostly from the prior, not from the motion"
        )
    for axis, distance in fused.contradictions.items():
        warnings.append(
            f"the prior on {axis} is {distance:.1f} standard deviations from what the motion says: check its value, unit and sign"
        )
    if not solution.converged:
        warnings.append("the solver did not converge: do not use this result")
        return SolveStatus.NOT_CONVERGED, tuple(warnings)
    return (SolveStatus.UNOBSERVABLE if unobservable else SolveStatus.OK), tuple(warnings)
