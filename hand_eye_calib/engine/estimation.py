"""From synchronised poses to a calibration: settle the scale, choose the motion pairs, solve,
assess, add the prior, judge.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hand_eye_calib.adaptive import estimator as adaptive_estimator
from hand_eye_calib.adaptive.estimator import AdaptiveSolution
from hand_eye_calib.adaptive.increments import Streams, course_of
from hand_eye_calib.adaptive.part_delays import PartDelay, spread_by_delays
from hand_eye_calib.adaptive.world_drift import WorldDrift
from hand_eye_calib.alignment.scale import Scale, child_scaled, estimate_scale
from hand_eye_calib.alignment.similarity import MAX_UNEXPLAINED_TRANSLATION
from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.assessment.covariance import Assessment, assess, assess_adaptive
from hand_eye_calib.assessment.floor import common_mode_floor
from hand_eye_calib.assessment.model_fit import MAX_JUMPS, why_not
from hand_eye_calib.assessment.mount_change import PossibleShift, possible_shift
from hand_eye_calib.assessment.prior import Fused, fuse, widened
from hand_eye_calib.assessment.reference_selection import MIN_POSES, select_reference
from hand_eye_calib.calibration import Calibration, DofVerdict, Residuals, SolveStatus
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError, NotEnoughDataError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.solvers.solution import Solution

# Poses between the ends of motion pairs that show the motion well: over one interval noise would
# look like motion.
_SPAN = 10

# Standard deviations below which a delay is none.
_NO_DELAY = 3.0

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
    noise: dict[str, Any] | None = None
    scale_correction: float = 1.0
    scale_sigma: float = 0.0
    time_correction_s: float = 0.0
    time_sigma_s: float = 0.0
    warnings: tuple[str, ...] = ()
    other_answer: tuple[FloatArray, FloatArray] | None = None
    delays: tuple[PartDelay, ...] = ()
    clock: PartDelay | None = None
    drift: WorldDrift | None = None
    shift: PossibleShift | None = None
    is_beside: bool = False

    def spread(self, clock_offset_s: float) -> FloatArray:
        """Covariance (6, 6) of xi by what is not in the model.

        Parameters
        ----------
        clock_offset_s : float
            As estimated before; zero if it was given.
        """
        spread = spread_by_delays(self.delays, clock_offset_s, self.clock)
        if self.drift is not None and self.drift.is_significant:
            spread = spread + np.outer(self.drift.shift, self.drift.shift)
        return spread if self.shift is None else spread + self.shift.spread

    @property
    def is_steady(self) -> bool:
        """Whether a noise model shows neither a delay of positions nor a world that moves."""
        if not self.delays or self.drift is None:
            return False
        return not self.drift.is_significant and max(d.sigmas for d in self.delays) < _NO_DELAY


@dataclass(frozen=True)
class _ScaleInUse:
    """Factor of the child's lengths, and the estimate it comes from if it was estimated."""

    value: float = 1.0
    estimate: Scale | None = None
    warnings: tuple[str, ...] = ()


def estimate_extrinsic(
    pose_pairs: PosePairs, config: CalibratorConfig, time_offset: TimeOffset | None = None
) -> Calibration:
    """Solve and assess synchronised poses.

    Parameters
    ----------
    pose_pairs : PosePairs
        On one clock.
    config : CalibratorConfig
        With a time offset in seconds, which the poses already have.
    time_offset : TimeOffset, optional
        The offset that the poses already have, if it was estimated.

    Returns
    -------
    Calibration
        Without frame names.

    Raises
    ------
    ConfigError
        If the method does not have the backend.
    NotEnoughDataError
        If there are too few poses for the reference or for the scale.
    """
    scale = _settle_scale(pose_pairs, config)
    METHODS[config.method].require_backend(config.backend)
    solve = _SOLVE.get(config.method, _solve_only_pairs)
    scaled = child_scaled(pose_pairs, scale.value)
    evaluation = solve(scaled, config, is_clock_free=time_offset is not None)
    T_method = evaluation.solution.T_parent_child
    # A model with a time offset knows how uncertain that is.
    spread = _spread_by_alignment(
        scale.estimate, None if evaluation.time_correction_s else time_offset
    )
    spread += evaluation.spread(time_offset.seconds if time_offset else 0.0)
    assessment = widened(evaluation.assessment, T_method[:3, :3], spread)
    fused = fuse(T_method, assessment, config.prior())
    result = _calibration(evaluation, fused, pose_pairs.stamps_ns, config)
    offset_s = time_offset.seconds if time_offset else fixed_time_offset(config)
    return replace(
        result,
        time_offset_s=offset_s + evaluation.time_correction_s,
        time_offset_sigma_s=evaluation.time_sigma_s
        or (time_offset.sigma_s if time_offset else 0.0),
        scale=scale.value * evaluation.scale_correction,
        scale_sigma=scale.value * evaluation.scale_sigma
        or (scale.estimate.sigma if scale.estimate else 0.0),
        warnings=scale.warnings + result.warnings,
    )


def estimate_beside(pose_pairs: PosePairs, config: CalibratorConfig) -> Calibration:
    """Solve with a method of the paper on one reference, to be compared with a result: without a
    floor, a proof that the minimum is global, or a prior. Parameters as of
    :func:`estimate_extrinsic`, with a scale that is given.
    """
    scaled = child_scaled(pose_pairs, _settle_scale(pose_pairs, config).value)
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
        known = _known_by_motion(fused)
        floor = common_mode_floor(*evaluation.spans, fused.T_parent_child, known)
    return Calibration(
        T_parent_child=fused.T_parent_child,
        covariance=fused.assessment.cov_parent_child_in_child,
        status=_status(solution.converged, fused),
        observability=fused.assessment.observability,
        T_method=solution.T_parent_child,
        floor=floor,
        objective=solution.objective,
        proved_global=evaluation.proved_global,
        method=evaluation.method,
        method_reason=evaluation.method_reason,
        reference=evaluation.reference,
        reference_reason=evaluation.reference_reason,
        noise=evaluation.noise,
        backend=config.backend,
        n_poses=len(stamps_ns),
        n_pairs=len(residuals),
        n_inliers=int(residuals.is_inlier.sum()),
        contradictions=fused.contradictions,
        **config.target_fields(),
        stamp_ns=int(stamps_ns[-1]),
        warnings=(
            *_warnings_of(fused),
            *evaluation.warnings,
            *(evaluation.shift.warnings if evaluation.shift else ()),
        ),
        motion_residuals=residuals,
        other_answer=evaluation.other_answer,
        is_steady=evaluation.is_steady and not config.prior(),
    )


def _known_by_motion(fused: Fused) -> BoolArray:
    """Whether the motion, not a prior alone, reveals x, y and z of the parent, (3,)."""
    unknown = (DofVerdict.UNOBSERVABLE, DofVerdict.PRIOR)
    return np.array([dof.verdict not in unknown for dof in fused.assessment.observability[:3]])


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
    """The adaptive estimator if its noise model fits, as judged with DNLO's answer, otherwise DNLO;
    and DNLO if a reference is given, which only the paper's methods have.

    The adaptive estimator is solved once; DNLO's reference is chosen from the noise that it found.
    """
    with_dnlo = replace(config, method="dnlo")
    if config.reference != "auto":
        dnlo = _solve_pairs(pose_pairs, with_dnlo)
        return replace(dnlo, method_reason=f"auto: dnlo, for reference {config.reference} is given")
    if len(pose_pairs) < MIN_POSES:
        evaluation = _solve_adaptive(pose_pairs, config, is_clock_free)
        reason = f"auto: fewer than {MIN_POSES} poses, too few to compare with dnlo"
        return replace(evaluation, method_reason=reason)
    solution = _adaptive_solution(pose_pairs, is_clock_free)
    dnlo = _solve_pairs(pose_pairs, with_dnlo, solution)
    by_model = _evaluated(pose_pairs, solution)
    floor = common_mode_floor(*by_model.spans, solution.T_parent_child)
    witness = dnlo
    misfit = why_not(solution, by_model.assessment, _answer(witness), floor)
    if misfit and solution.systematic != "none":
        # DNLO does not know of systematic errors. Without them it may agree.
        corrected = _without_biases(_corrected(pose_pairs, solution), solution)
        witness = _solve_pairs(corrected, replace(with_dnlo, reference=dnlo.reference))
        misfit = why_not(solution, by_model.assessment, _answer(witness), floor)
    compared = f"dnlo on reference {dnlo.reference}"
    if misfit:
        reason = f"auto: {compared} stands, because the noise model does not fit: {misfit}"
        return replace(dnlo, method_reason=reason, other_answer=_beside(by_model))
    reason = f"auto: the noise model fits, and its answer agrees with that of {compared}"
    return replace(by_model, method_reason=reason, other_answer=_beside(witness))


def _beside(evaluation: _Evaluation) -> tuple[FloatArray, FloatArray] | None:
    """An answer that was not chosen, and its covariance, if it knows all axes."""
    if not evaluation.solution.converged or _n_unobservable(evaluation.assessment):
        return None
    return (
        evaluation.solution.T_parent_child,
        evaluation.assessment.cov_parent_child_in_child,
    )


def _answer(evaluation: _Evaluation) -> tuple[FloatArray, Assessment]:
    return evaluation.solution.T_parent_child, evaluation.assessment


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
        n_unobservable = _n_unobservable(chosen.assessment)
        if n_unobservable == 0:
            break
        if len(pose_pairs) < 2 * int(reference[1:]):
            continue
        reason = (
            f"{reference}: {chosen.reference}, which has the smaller predicted error, "
            "leaves more axes unobservable"
        )
        longer = _solve_reference(pose_pairs, method, reference, reason)
        if _n_unobservable(longer.assessment) < n_unobservable:
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


def _n_unobservable(assessment: Assessment) -> int:
    return len(_named(assessment, DofVerdict.UNOBSERVABLE))


def _named(assessment: Assessment, verdict: DofVerdict) -> list[str]:
    return [dof.name for dof in assessment.observability if dof.verdict is verdict]


def _solve_only_pairs(
    pose_pairs: PosePairs, config: CalibratorConfig, is_clock_free: bool
) -> _Evaluation:
    """A method of the paper, which takes the clock as it is."""
    return _solve_pairs(pose_pairs, config)


def _solve_adaptive(
    pose_pairs: PosePairs, config: CalibratorConfig, is_clock_free: bool
) -> _Evaluation:
    """The adaptive estimator, which uses no reference."""
    evaluation = _evaluated(pose_pairs, _adaptive_solution(pose_pairs, is_clock_free))
    jumps = 1.0 - float(np.mean(evaluation.weights))
    warning = (
        f"{jumps:.0%} of the increments are jumps: the errors do not fit the adaptive noise "
        "model; compare with method dnlo"
    )
    return replace(evaluation, warnings=(warning,) if jumps > MAX_JUMPS else ())


def _adaptive_solution(pose_pairs: PosePairs, is_clock_free: bool) -> AdaptiveSolution:
    return adaptive_estimator.solve(
        pose_pairs.stamps_ns,
        pose_pairs.Ts_pw_p,
        pose_pairs.Ts_cw_c,
        is_clock_free=is_clock_free,
        with_delays=True,
    )


def _corrected(pose_pairs: PosePairs, solution: AdaptiveSolution) -> PosePairs:
    """The poses with the scale and the time offset that the solution found."""
    stamps_ns = pose_pairs.stamps_ns
    child = Trajectory(stamps_ns, pose_pairs.Ts_cw_c).scaled(solution.scale)
    Ts_cw_c = child.shifted(solution.time_offset_s).at(stamps_ns, extrapolate=True)
    return PosePairs(stamps_ns, pose_pairs.Ts_pw_p, Ts_cw_c)


def _without_biases(pose_pairs: PosePairs, solution: AdaptiveSolution) -> PosePairs:
    """The poses without the biases per metre of path that the solution found."""
    stamps_ns = pose_pairs.stamps_ns
    Ts_pw_p, Ts_cw_c = pose_pairs.Ts_pw_p.copy(), pose_pairs.Ts_cw_c.copy()
    streams = Streams((stamps_ns - stamps_ns[0]) * 1e-9, Ts_pw_p, Ts_cw_c)
    course = course_of(streams, solution.T_parent_child)
    of_child, of_parent = solution.biases
    Ts_cw_c[:, :3, 3] -= course.along_c @ of_child
    Ts_pw_p[:, :3, 3] -= course.along_p @ of_parent
    return PosePairs(stamps_ns, Ts_pw_p, Ts_cw_c)


def _evaluated(pose_pairs: PosePairs, solution: AdaptiveSolution) -> _Evaluation:
    """An answer of the adaptive estimator, assessed."""
    stamps_ns, Ts_cw_c = pose_pairs.stamps_ns, _corrected(pose_pairs, solution).Ts_cw_c
    return _Evaluation(
        solution=solution,
        assessment=assess_adaptive(pose_pairs, solution),
        method="adaptive",
        reference="increments",
        pairs=motion_pairs(pose_pairs.Ts_pw_p, Ts_cw_c, "B1"),
        weights=(~solution.jumps).astype(float),
        spans=_spans(pose_pairs.Ts_pw_p, Ts_cw_c, solution.left_out),
        noise=solution.describe(stamps_ns),
        scale_correction=solution.scale,
        scale_sigma=solution.scale_sigma,
        time_correction_s=solution.time_offset_s,
        time_sigma_s=solution.time_offset_sigma_s,
        delays=solution.delays or (),
        clock=solution.clock,
        drift=solution.world_drift,
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


# Methods that do not only solve the motion pairs of a reference.
_SOLVE = {"auto": _solve_auto, "adaptive": _solve_adaptive}


def _settle_scale(pose_pairs: PosePairs, config: CalibratorConfig) -> _ScaleInUse:
    """The scale to use: given, or estimated if the option asks for it."""
    if config.scale == "none":
        return _ScaleInUse()
    if not isinstance(config.scale, str):
        return _ScaleInUse(config.scale)
    if config.scale == "estimate":
        scale = estimate_scale(pose_pairs)
        if not scale.fit.explains_translation:
            raise NotEnoughDataError(
                "the scale cannot be estimated: even with a scale, "
                f"{scale.fit.unexplained_translation:.0%} of the motion stays unexplained "
                f"(at most {MAX_UNEXPLAINED_TRANSLATION:.0%} is allowed); "
                "check the streams, or give scale"
            )
        return _ScaleInUse(scale.value, scale)
    try:
        scale = estimate_scale(pose_pairs)
    except NotEnoughDataError:
        return _ScaleInUse()
    if not scale.differs:
        return _ScaleInUse()
    warning = (
        f"the child's lengths are multiplied by {scale.value:.4f} +/- {scale.sigma:.4f}, "
        "as estimated from the motion"
    )
    return _ScaleInUse(scale.value, scale, (warning,))


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


def _status(converged: bool, fused: Fused) -> SolveStatus:
    if not converged:
        return SolveStatus.NOT_CONVERGED
    if fused.contradictions:
        return SolveStatus.CONTRADICTED
    unobservable = _named(fused.assessment, DofVerdict.UNOBSERVABLE)
    return SolveStatus.UNOBSERVABLE if unobservable else SolveStatus.OK


def _warnings_of(fused: Fused) -> list[str]:
    """What the reasons of the verdict do not say."""
    mostly_prior = _named(fused.assessment, DofVerdict.PRIOR)
    if not mostly_prior:
        return []
    return [f"{', '.join(mostly_prior)} of the child sensor: mostly from the prior, not the motion"]
