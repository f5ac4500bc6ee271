"""From synchronised poses to a calibration: choose the motion pairs, solve, assess, judge."""

from dataclasses import dataclass

from hand_eye_calib.assessment.covariance import Assessment, assess
from hand_eye_calib.assessment.reference_selection import select_reference
from hand_eye_calib.calibration import Calibration, DofVerdict, SolveStatus
from hand_eye_calib.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.solvers.solution import Solution


@dataclass(frozen=True)
class _Evaluation:
    reference: str
    pairs: MotionPairs
    solution: Solution
    assessment: Assessment


def estimate_extrinsic(pose_pairs, config):
    """Solve and assess synchronised poses (a :class:`PosePairs`) under a configuration; returns a Calibration without frames."""
    scale = 1.0 if config.scale == "none" else config.scale
    Ts_cw_c = pose_pairs.Ts_cw_c.copy()
    Ts_cw_c[:, :3, 3] *= scale
    method = Method(config.method, config.threshold, config.min_inlier_fraction, config.backend)

    def evaluate(reference):
        pairs = motion_pairs(pose_pairs.Ts_pw_p, Ts_cw_c, reference)
        solution = method.solve(pairs)
        assessment = assess(pairs, solution, lambda left_out: method.solve_without(pairs, solution, left_out))
        return _Evaluation(reference, pairs, solution, assessment)

    evaluation = select_reference(evaluate, len(pose_pairs)) if config.reference == "auto" else evaluate(config.reference)
    solution, assessment = evaluation.solution, evaluation.assessment
    status, warnings = _judge(solution, assessment)
    return Calibration(
        T_parent_child=solution.T_parent_child,
        covariance=assessment.cov_parent_child_in_child,
        status=status,
        observability=assessment.observability,
        objective=solution.objective,
        method=config.method,
        reference=evaluation.reference,
        backend=config.backend,
        n_poses=len(pose_pairs),
        n_pairs=len(evaluation.pairs),
        n_inliers=int((solution.weights > 0.5).sum()),
        time_offset_s=config.time_offset,
        scale=scale,
        stamp_ns=int(pose_pairs.stamps_ns[-1]),
        warnings=warnings,
    )


def _judge(solution, assessment):
    warnings = []
    unobservable = [dof.name for dof in assessment.observability if dof.verdict is DofVerdict.UNOBSERVABLE]
    if unobservable:
        warnings.append(
            f"the motion does not reveal {', '.join(unobservable)} of the child sensor in the parent sensor's frame: do not use "
            "these values; drive curves over slopes, or measure them by hand"
        )
    if not solution.converged:
        warnings.append("the solver did not converge: do not use this result")
        return SolveStatus.NOT_CONVERGED, tuple(warnings)
    return (SolveStatus.UNOBSERVABLE if unobservable else SolveStatus.OK), tuple(warnings)
