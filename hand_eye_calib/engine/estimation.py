"""From synchronised poses to a calibration: settle the scale, choose the motion pairs, solve,
assess, add the prior, judge.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.alignment.scale import Scale, ScaleInUse, child_scaled, settle_scale
from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.assessment.covariance import Assessment, assess, assess_adaptive, without_axes
from hand_eye_calib.assessment.floor import axes_lost_by_tilt, common_mode_floor
from hand_eye_calib.assessment.mount_change import PossibleShift, possible_shift
from hand_eye_calib.assessment.prior import Fused, fuse, widened
from hand_eye_calib.assessment.reference_selection import MIN_POSES, select_reference
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.gls import estimator as adaptive_estimator
from hand_eye_calib.gls.estimator import AdaptiveSolution
from hand_eye_calib.gls.increments import SYSTEMATIC, Streams, course_of
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration, DofVerdict, Residuals
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.solvers.solution import Solution

# Poses between the ends of motion pairs that show the motion well: over one interval noise would
# look like motion.
_SPAN = 10

# Largest share of the increments that may be jumps: with jumps at a tenth of the poses of both
# trajectories it is a fifth.
_MAX_JUMPS = 0.25

_PROVED = {True: "yes", False: "no", None: "not tried"}

# Tried in turn if the reference that auto chose leaves an axis unobservable.
_LONGER_REFERENCES = ("B5", "B20")


@dataclass(frozen=True, kw_only=True)
class _Evaluation:
    """Solution and assessment, of any method.

    Attributes
    ----------
    spans : MotionPairs and (K,) array
        Pairs that are long enough to show the motion, and their weights, for the floor.
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
    spans: tuple[MotionPairs, FloatArray]
    method_reason: str = ""
    reference_reason: str = ""
    proved_global: str = "not tried"
    warnings: tuple[str, ...] = ()
    other_answer: tuple[FloatArray, FloatArray] | None = None
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
            Axes that count as unobservable whatever the method says; so do those that a tilted
            axis of rotation would move too far.
        """
        evaluation, scale, offset = self.evaluation, self.scale, self.time_offset
        T_method = evaluation.solution.T_parent_child
        sigmas = np.array([dof.sigma for dof in self.assessment.observability[:3]])
        hidden = {*unseen, *axes_lost_by_tilt(*evaluation.spans, T_method, sigmas)}
        fused = fuse(T_method, without_axes(self.assessment, T_method, hidden), self.config.prior())
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
        known = fused.assessment.known_translations()
        floor = common_mode_floor(*evaluation.spans, fused.T_parent_child, known)
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
        other_answer=evaluation.other_answer,
        model=evaluation.model,
    )


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
    given, which only the paper's methods have: then DNLO. The other answer is that of the other
    method, whose distance the verdict judges.

    The adaptive estimator is solved once; DNLO's reference is chosen from the noise that it found.
    """
    with_dnlo = replace(config, method="dnlo")
    if config.reference != "auto":
        dnlo = _solve_pairs(pose_pairs, with_dnlo)
        return replace(
            dnlo, method_reason=f"auto: dnlo, because the user set reference {config.reference}"
        )
    solution = _adaptive_solution(pose_pairs, config, is_clock_free)
    by_model = _evaluated(pose_pairs, solution)
    if len(pose_pairs) < MIN_POSES:
        reason = f"auto: adaptive; fewer than {MIN_POSES} poses are too few to compare with dnlo"
        return replace(by_model, method_reason=reason)
    if not solution.converged or solution.is_drowned:
        why = "single poses are noisier than the motion between them"
        why = why if solution.is_drowned else "the adaptive estimator did not converge"
        dnlo = _solve_pairs(pose_pairs, with_dnlo, solution)
        reason = f"auto: dnlo on reference {dnlo.reference}, because {why}"
        return replace(dnlo, method_reason=reason, other_answer=_beside(by_model), model=solution)
    # DNLO does not know of systematic errors: it is compared on poses without them.
    if solution.systematic != "none":
        pose_pairs = _without_bias(_corrected(pose_pairs, solution), solution)
    dnlo = _solve_pairs(pose_pairs, with_dnlo, solution)
    reason = f"auto: adaptive, compared with dnlo on reference {dnlo.reference}"
    return replace(by_model, method_reason=reason, other_answer=_beside(dnlo))


def _beside(evaluation: _Evaluation) -> tuple[FloatArray, FloatArray] | None:
    """An answer that was not chosen, and its covariance, if it knows all axes."""
    if not evaluation.solution.converged or evaluation.assessment.named(DofVerdict.UNOBSERVABLE):
        return None
    return (
        evaluation.solution.T_parent_child,
        evaluation.assessment.cov_parent_child_in_child,
    )


def _solve_pairs(
    pose_pairs: PosePairs, config: CalibratorConfig, noise_model: AdaptiveSolution | None = None
) -> _Evaluation:
    """A method of the paper on the motion pairs of one reference."""
    method = _method(config)
    if config.reference != "auto":
        return _solve_reference(pose_pairs, method, config.reference)
    choice = select_reference(pose_pairs, method, solution=noise_model)
    chosen = _solve_reference(
        pose_pairs, method, choice.reference, choice.reason(), choice.solution
    )
    for reference in _LONGER_REFERENCES:
        # The prediction assumes noise without spikes and favours short baselines if there are any.
        # Longer ones may still lift the motion out of the noise.
        n_unobservable = len(chosen.assessment.named(DofVerdict.UNOBSERVABLE))
        if n_unobservable == 0:
            break
        if len(pose_pairs) < 2 * int(reference[1:]):
            continue
        reason = (
            f"{reference}: {chosen.reference}, which has the smaller predicted error, "
            "leaves more axes unobservable"
        )
        longer = _solve_reference(pose_pairs, method, reference, reason)
        if len(longer.assessment.named(DofVerdict.UNOBSERVABLE)) < n_unobservable:
            chosen = longer
    return replace(chosen, other_answer=choice.answer, shift=choice.shift)


def _method(config: CalibratorConfig) -> Method:
    return Method(config.method, config.threshold, config.min_inlier_fraction, config.backend)


def _solve_reference(
    pose_pairs: PosePairs,
    method: Method,
    reference: str,
    reason: str = "",
    found: Solution | None = None,
    is_beside: bool = False,
) -> _Evaluation:
    """A method's answer for one reference, which may be known already, assessed; beside another
    result, without a proof and a floor.
    """
    pairs = motion_pairs(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, reference)
    solution = found or method.solve(pairs)
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
        spans=(pairs, solution.weights),
        is_beside=is_beside,
        reference_reason=reason,
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


def _without_bias(pose_pairs: PosePairs, solution: AdaptiveSolution) -> PosePairs:
    """The poses without the bias per metre of path that the solution found."""
    stamps_ns = pose_pairs.stamps_ns
    Ts_pw_p, Ts_cw_c = pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c.copy()
    streams = Streams((stamps_ns - stamps_ns[0]) * 1e-9, Ts_pw_p, Ts_cw_c)
    course = course_of(streams, solution.T_parent_child)
    Ts_cw_c[:, :3, 3] -= course.along @ solution.bias
    return PosePairs(stamps_ns, Ts_pw_p, Ts_cw_c)


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
        spans=_spans(pose_pairs.Ts_pw_p, Ts_cw_c, solution.left_out),
        warnings=(warning,) if jumps > _MAX_JUMPS else (),
        model=solution,
        shift=possible_shift(solution.part_products, solution.misfit),
    )


def _spans(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, left_out: BoolArray
) -> tuple[MotionPairs, FloatArray]:
    """Motion pairs over a tenth of a short recording, or ten poses, without those across an
    increment that is left out.
    """
    baseline = min(_SPAN, max(len(left_out) // 10, 1))
    pairs = motion_pairs(Ts_pw_p, Ts_cw_c, f"B{baseline}")
    before = np.concatenate([[0], np.cumsum(left_out)])
    return pairs, (before[pairs.i] == before[pairs.j]).astype(float)


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
