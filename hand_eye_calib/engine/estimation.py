"""From synchronised poses to a calibration: settle the scale, choose the motion pairs, solve,
assess, add the prior, judge.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.alignment.scale import Scale, ScaleInUse, child_scaled, settle_scale
from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.assessment.covariance import Assessment, assess, assess_adaptive, without_axes
from hand_eye_calib.assessment.floor import common_mode_floor, floor_of_pairs
from hand_eye_calib.assessment.mount_change import PossibleShift, possible_shift
from hand_eye_calib.assessment.prior import Fused, fuse, widened
from hand_eye_calib.assessment.reference_selection import MIN_POSES, select_reference
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.gls import estimator as adaptive_estimator
from hand_eye_calib.gls.estimator import AdaptiveSolution
from hand_eye_calib.gls.increments import SYSTEMATIC
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration, Residuals
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.solvers.solution import Solution

# Largest share of the increments that may be jumps: with jumps at a tenth of the poses of both
# trajectories it is a fifth.
_MAX_JUMPS = 0.25

_PROVED = {True: "yes", False: "no", None: "not tried"}


@dataclass(frozen=True, kw_only=True)
class _Evaluation:
    """Solution and assessment, of any method.

    Attributes
    ----------
    shift : PossibleShift or None
        Of the mount within the recording.
    is_beside : bool
        It is only to be compared with a result, and has no floor.
    model : AdaptiveSolution or None
        The adaptive estimator's solution, if there is one: with method adaptive this one.
    """

    solution: Solution | AdaptiveSolution
    assessment: Assessment
    method: str
    reference: str
    pairs: MotionPairs
    weights: FloatArray
    method_reason: str = ""
    reference_reason: str = ""
    proved_global: str = "not tried"
    warnings: tuple[str, ...] = ()
    shift: PossibleShift | None = None
    is_beside: bool = False
    model: AdaptiveSolution | None = None

    @property
    def adaptive(self) -> AdaptiveSolution | None:
        """The solution, if it is the adaptive estimator's."""
        return self.model if self.method == "adaptive" else None


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Poses that were solved, before priors are added and unknown directions are set."""

    evaluation: _Evaluation
    assessment: Assessment
    stamps_ns: IntArray
    config: CalibratorConfig
    scale: ScaleInUse
    time_offset: TimeOffset | None

    def calibration(self, unseen: Collection[str] = ()) -> Calibration:
        """The result without frame names.

        Parameters
        ----------
        unseen : collection of str
            Axes that count as unobservable whatever the method says.
        """
        evaluation, scale, offset = self.evaluation, self.scale, self.time_offset
        T_method = evaluation.solution.T_parent_child
        fused = fuse(T_method, without_axes(self.assessment, T_method, unseen), self.config.prior())
        result = _calibration(evaluation, fused, self.stamps_ns, self.config)
        offset_s = offset.seconds if offset else fixed_time_offset(self.config)
        offset_sigma_s = offset.sigma_s if offset else 0.0
        scale_sigma = scale.estimate.sigma if scale.estimate else 0.0
        if found := evaluation.adaptive:
            offset_s += found.time_offset_s
            offset_sigma_s = found.time_offset_sigma_s or offset_sigma_s
            scale_sigma = scale.value * found.scale_sigma or scale_sigma
        return replace(
            result,
            time_offset_s=offset_s,
            time_offset_sigma_s=offset_sigma_s,
            clock_rate=offset.rate if offset else None,
            scale=scale.value * found.scale if found else scale.value,
            scale_sigma=scale_sigma,
            warnings=scale.warnings + result.warnings,
        )


def estimate_extrinsic(
    pose_pairs: PosePairs, config: CalibratorConfig, time_offset: TimeOffset | None = None
) -> Calibration:
    """Solve and assess synchronised poses: the calibration of :func:`solve_poses`."""
    return solve_poses(pose_pairs, config, time_offset).calibration()


def solve_poses(
    pose_pairs: PosePairs, config: CalibratorConfig, time_offset: TimeOffset | None = None
) -> Solved:
    """Solve and assess synchronised poses.

    Parameters
    ----------
    pose_pairs : PosePairs
        On one clock.
    config : CalibratorConfig
        With a time offset in seconds, which the poses already have.
    time_offset : TimeOffset, optional
        The offset that the poses already have, if it was estimated.

    Raises
    ------
    ConfigError
        If the method does not have the backend.
    NotEnoughDataError
        If there are too few poses for the reference or for the scale.
    """
    scale = settle_scale(pose_pairs, config.scale)
    METHODS[config.method].require_backend(config.backend)
    scaled = child_scaled(pose_pairs, scale.value)
    is_clock_free = time_offset is not None
    if config.method == "auto":
        evaluation = _solve_auto(scaled, config, is_clock_free)
    elif config.method == "adaptive":
        evaluation = _evaluated(scaled, _adaptive_solution(scaled, config, is_clock_free))
    else:
        evaluation = _solve_pairs(scaled, config)
    T_method, found = evaluation.solution.T_parent_child, evaluation.adaptive
    # A model with a time offset knows how uncertain that is.
    spread = _spread_by_alignment(
        scale.estimate, None if found and found.time_offset_s else time_offset
    )
    if evaluation.shift is not None:
        spread += evaluation.shift.spread
    return Solved(
        evaluation=evaluation,
        assessment=widened(evaluation.assessment, T_method[:3, :3], spread),
        stamps_ns=pose_pairs.stamps_ns,
        config=config,
        scale=scale,
        time_offset=time_offset,
    )


def estimate_beside(pose_pairs: PosePairs, config: CalibratorConfig) -> Calibration:
    """Solve with a method of the paper on one reference, to be compared with a result: without a
    floor, a proof that the minimum is global, or a prior. Parameters as of
    :func:`estimate_extrinsic`, with a scale that is given.
    """
    scaled = child_scaled(pose_pairs, settle_scale(pose_pairs, config.scale).value)
    evaluation = _solve_reference(scaled, _method(config), config.reference, is_beside=True)
    fused = fuse(evaluation.solution.T_parent_child, evaluation.assessment, {})
    return _calibration(evaluation, fused, pose_pairs.stamps_ns, config)


def _calibration(
    evaluation: _Evaluation, fused: Fused, stamps_ns: IntArray, config: CalibratorConfig
) -> Calibration:
    """The result, without frame names, time offset and scale."""
    solution = evaluation.solution
    residuals = _residuals(evaluation, stamps_ns, fused.T_parent_child)
    floor = None
    if not evaluation.is_beside:
        floor = config.odometry_share * _floor(evaluation)
    return Calibration(
        T_parent_child=fused.T_parent_child,
        covariance=fused.assessment.cov_parent_child_in_child,
        status=fused.status(solution.converged),
        observability=fused.assessment.observability,
        T_method=solution.T_parent_child,
        floor=floor,
        objective=solution.objective,
        proved_global=evaluation.proved_global,
        method=evaluation.method,
        method_reason=evaluation.method_reason,
        reference=evaluation.reference,
        reference_reason=evaluation.reference_reason,
        noise=evaluation.adaptive.describe(stamps_ns) if evaluation.adaptive else None,
        backend=config.backend,
        n_poses=len(stamps_ns),
        n_pairs=len(residuals),
        n_inliers=int(residuals.is_inlier.sum()),
        contradictions=fused.contradictions,
        **config.target_fields(),
        stamp_ns=int(stamps_ns[-1]),
        warnings=(
            *fused.warnings,
            *evaluation.warnings,
            *(evaluation.shift.warnings if evaluation.shift else ()),
        ),
        motion_residuals=residuals,
        model=evaluation.model,
    )


def _floor(evaluation: _Evaluation) -> FloatArray:
    """Common-mode floor (6, 6) of errors of two odometries."""
    if (found := evaluation.adaptive) is None:
        T_method = evaluation.solution.T_parent_child
        return floor_of_pairs(evaluation.pairs, evaluation.weights, T_method)
    lasting = [slow.sigma for slow in found.noise.slow if slow.part == "translation"]
    return common_mode_floor(found.by_scale, found.scale_variance, math.hypot(*lasting))


def _residuals(
    evaluation: _Evaluation, stamps_ns: IntArray, T_parent_child: FloatArray
) -> Residuals:
    pairs = evaluation.pairs
    translation, rotation = pairs.residuals(T_parent_child)
    return Residuals(
        translation=translation,
        rotation=rotation,
        weights=evaluation.weights,
        start_ns=stamps_ns[pairs.i],
        end_ns=stamps_ns[pairs.j],
    )


def fixed_time_offset(config: CalibratorConfig) -> float:
    """The time offset of options that have it in seconds.

    Raises
    ------
    ConfigError
        If it is still to be estimated.
    """
    if isinstance(config.time_offset, str):
        raise ConfigError(f"time_offset {config.time_offset!r} must be estimated before solving")
    return config.time_offset


def _solve_auto(
    pose_pairs: PosePairs, config: CalibratorConfig, is_clock_free: bool
) -> _Evaluation:
    """The adaptive estimator, unless its noise model cannot work on these poses or a reference is
    given, which only the paper's methods have: then DNLO.
    """
    with_dnlo = replace(config, method="dnlo")
    if config.reference != "auto":
        dnlo = _solve_pairs(pose_pairs, with_dnlo)
        return replace(
            dnlo, method_reason=f"auto: dnlo, because the user set reference {config.reference}"
        )
    solution = _adaptive_solution(pose_pairs, config, is_clock_free)
    works = solution.converged and not solution.is_drowned
    if works or len(pose_pairs) < MIN_POSES:
        by_model = _evaluated(pose_pairs, solution)
        return replace(by_model, method_reason="auto: adaptive, because its noise model works here")
    why = "single poses are noisier than the motion between them"
    why = why if solution.is_drowned else "the adaptive estimator did not converge"
    dnlo = _solve_pairs(pose_pairs, with_dnlo, solution)
    reason = f"auto: dnlo on reference {dnlo.reference}, because {why}"
    return replace(dnlo, method_reason=reason, model=solution)


def _solve_pairs(
    pose_pairs: PosePairs, config: CalibratorConfig, solution: AdaptiveSolution | None = None
) -> _Evaluation:
    """A method of the paper on the motion pairs of one reference; ``solution`` is the adaptive
    estimator's, if it is known.
    """
    method = _method(config)
    if config.reference != "auto":
        return _solve_reference(pose_pairs, method, config.reference)
    fast = replace(method, backend="fast")
    choice = select_reference(pose_pairs, fast, solution=solution)
    found, model = _solve_reference(pose_pairs, method, choice.reference), choice.model
    shift = None
    if model.converged and not model.unseen.size:
        shift = possible_shift(model.part_products, model.misfit)
    return replace(found, reference_reason=choice.reason(), shift=shift)


def _method(config: CalibratorConfig) -> Method:
    return Method(config.method, config.threshold, config.min_inlier_fraction, config.backend)


def _solve_reference(
    pose_pairs: PosePairs,
    method: Method,
    reference: str,
    is_beside: bool = False,
) -> _Evaluation:
    """A method's answer for one reference, assessed; beside another result, without a proof and a
    floor.
    """
    pairs = motion_pairs(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, reference)
    solution = method.solve(pairs)
    if not is_beside:
        solution = method.prove(pairs, solution)
    assessment = assess(
        pairs, solution, lambda left_out: method.solve_without(pairs, solution, left_out)
    )
    return _Evaluation(
        solution=solution,
        assessment=assessment,
        method=method.name,
        reference=reference,
        pairs=pairs,
        weights=solution.weights,
        is_beside=is_beside,
        proved_global=_PROVED[solution.is_proved_global],
    )


def _adaptive_solution(
    pose_pairs: PosePairs, config: CalibratorConfig, is_clock_free: bool
) -> AdaptiveSolution:
    """The adaptive estimator's answer, without a scale or a time offset that the user set."""
    options = {"scale": "scale", "time": "time_offset"}
    known = {name for name, option in options.items() if config.is_known(option)}
    if is_clock_free:
        known.discard("time")  # the user asked for an estimate, of which this is the last step
    return adaptive_estimator.solve(
        pose_pairs.stamps_ns,
        pose_pairs.Ts_pw_p,
        pose_pairs.Ts_cw_c,
        [name for name in SYSTEMATIC if known.isdisjoint(name.split("+"))],
        is_clock_free=is_clock_free,
    )


def _corrected(pose_pairs: PosePairs, solution: AdaptiveSolution) -> PosePairs:
    """The poses with the scale and the time offset that the solution found."""
    stamps_ns = pose_pairs.stamps_ns
    child = Trajectory(stamps_ns, pose_pairs.Ts_cw_c).scaled(solution.scale)
    Ts_cw_c = child.shifted(solution.time_offset_s).at(stamps_ns, extrapolate=True)
    return PosePairs(stamps_ns, pose_pairs.Ts_pw_p, Ts_cw_c)


def _evaluated(pose_pairs: PosePairs, solution: AdaptiveSolution) -> _Evaluation:
    """An answer of the adaptive estimator, assessed."""
    Ts_cw_c = _corrected(pose_pairs, solution).Ts_cw_c
    jumps = float(np.mean(solution.jumps))
    warning = (
        f"{jumps:.0%} of the increments are jumps: the errors do not fit the adaptive noise "
        "model; compare with method dnlo"
    )
    return _Evaluation(
        solution=solution,
        assessment=assess_adaptive(pose_pairs, solution),
        method="adaptive",
        reference="increments",
        pairs=motion_pairs(pose_pairs.Ts_pw_p, Ts_cw_c, "B1"),
        weights=(~solution.jumps).astype(float),
        warnings=(warning,) if jumps > _MAX_JUMPS else (),
        model=solution,
        shift=possible_shift(solution.part_products, solution.misfit),
    )


def _spread_by_alignment(scale: Scale | None, time_offset: TimeOffset | None) -> FloatArray:
    """Covariance (6, 6) that an estimated scale and time offset add to the extrinsic's."""
    spread = np.zeros((6, 6))
    if scale:
        by_log_scale = scale.fit.sensitivity[:, 0]
        spread += np.outer(by_log_scale, by_log_scale) * (scale.sigma / scale.value) ** 2
    if time_offset and time_offset.fit:
        by_offset = time_offset.fit.sensitivity[:, 1]
        spread += np.outer(by_offset, by_offset) * time_offset.sigma_s**2
    return spread
