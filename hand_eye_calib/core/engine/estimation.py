"""From synchronised poses to a calibration: settle the scale, choose the motion pairs, solve,
assess, add the prior, judge; and compare with other answers to the same question.

Those are from other references and from parts of the recording: their scatter about a result is
compared with what their covariances allow. Other references show what the noise model misses, such
as errors with longer correlation times than it assumes. Both halves of the recording show what
changes during it. Neither shows an error that is constant.
"""

import contextlib
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hand_eye_calib.core.alignment.similarity import SimilarityFit, settle_scale
from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.assessment import covariance
from hand_eye_calib.core.assessment.moved import possible_shift
from hand_eye_calib.core.assessment.prior import fuse, widened
from hand_eye_calib.core.assessment.rocking import rocking_axis
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.config import METHODS, CalibratorConfig, require_backend
from hand_eye_calib.core.base.errors import HandEyeCalibError, NotEnoughDataError
from hand_eye_calib.core.base.registry import OUT_OF_REACH
from hand_eye_calib.core.base.stats import MEDIAN_NORMAL, median
from hand_eye_calib.core.base.text import parse_targets
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.noise import estimator as adaptive_estimator
from hand_eye_calib.core.noise.estimator import AdaptiveSolution
from hand_eye_calib.core.noise.increments import SYSTEMATIC
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs, motion_pairs
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict, SolveStatus
from hand_eye_calib.core.results.records import (
    AXES,
    AxisScatter,
    CrossCheck,
    Residuals,
)
from hand_eye_calib.core.solvers.all_pairs import Solution
from hand_eye_calib.core.solvers.registry import Method

# Largest share of the increments that may be jumps: with jumps at a tenth of the poses of both
# trajectories it is a fifth.
_MAX_JUMPS = 0.25


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Poses that were solved and assessed with any method, before priors are added and unknown
    directions are set.

    Attributes
    ----------
    spread : (6, 6) array
        Of a shift of the mount that the recording may have; zeros without one.
    stamps_ns, config, scale, time_offset
        What was solved; the time offset if it was estimated.
    floor : (6, 6) array
        Common-mode uncertainty; zeros if it is only to be compared with a result.
    """

    solution: Solution | AdaptiveSolution
    assessment: covariance.Assessment
    method: str
    reference: str
    measured: str = "poses"
    pairs: MotionPairs
    weights: FloatArray
    stamps_ns: IntArray
    config: CalibratorConfig
    method_reason: str = ""
    reference_reason: str = ""
    proved_global: str = "not tried"
    warnings: tuple[str, ...] = ()
    spread: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    scale: float = 1.0
    scale_fit: SimilarityFit | None = None
    time_offset: TimeOffset | None = None
    floor: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    def calibration(self, unseen: Collection[str] = ()) -> Calibration:
        """The result without frame names; ``unseen`` axes count as unobservable whatever the method
        says.
        """
        assessment = self.assessment
        config = self.config
        if unseen:
            assessment = covariance.without_axes(assessment, unseen)
        fused = fuse(assessment, config.prior())
        offset_s = float(config.time_offset)
        offset_sigma_s = 0.0
        if offset := self.time_offset:
            offset_s = offset.seconds
            offset_sigma_s = offset.sigma_s
        scale = self.scale
        scale_sigma = 0.0
        warnings = self.warnings
        if self.scale_fit:
            scale_sigma = self.scale_fit.scale_sigma
            times = f"{scale:.4f} +/- {scale_sigma:.4f}, as estimated from the motion"
            if config.scale == "auto":
                warnings = (f"the child's lengths are multiplied by {times}", *warnings)
        found = self.solution
        noise = None
        if isinstance(found, AdaptiveSolution):
            noise = found.describe(self.stamps_ns)
            offset_s += found.time_offset_s
            offset_sigma_s = found.time_offset_sigma_s or offset_sigma_s
            scale_sigma = scale * found.scale_sigma or scale_sigma
            scale *= found.scale
        left = self.pairs.residuals(fused.T_parent_child)
        start_ns = self.stamps_ns[self.pairs.i]
        end_ns = self.stamps_ns[self.pairs.j]
        return calibration_of(
            found,
            fused,
            Residuals(*left, self.weights, start_ns, end_ns),
            self.stamps_ns,
            config,
            warnings,
            measured=self.measured,
            T_method=found.T_parent_child,
            covariance_allowance=fused.allowance(self.floor),
            proved_global=self.proved_global,
            method=self.method,
            method_reason=self.method_reason,
            reference=self.reference,
            reference_reason=self.reference_reason,
            noise=noise,
            backend=config.backend,
            time_offset_s=offset_s,
            time_offset_sigma_s=offset_sigma_s,
            clock_rate=offset.rate if offset else None,
            scale=scale,
            scale_sigma=scale_sigma,
        )


def calibration_of(
    solution: Any,
    fused: covariance.Assessment,
    residuals: Residuals,
    stamps_ns: IntArray,
    config: CalibratorConfig,
    warnings: tuple[str, ...] = (),
    **fields: Any,
) -> Calibration:
    """A result from a solution with ``converged`` and ``objective``, what was fused with the prior,
    the residuals, the stamps of the poses, and further fields. Axes that are mostly from the prior
    are named before the other warnings.
    """
    dofs = fused.observability
    silent = OUT_OF_REACH.get(fields.get("measured", "poses"), ())
    open_axes = {dof.name for dof in dofs if dof.verdict is DofVerdict.UNOBSERVABLE}
    status = SolveStatus.UNOBSERVABLE if open_axes.difference(silent) else SolveStatus.OK
    if not solution.converged:
        status = SolveStatus.NOT_CONVERGED
    elif fused.contradictions:
        status = SolveStatus.CONTRADICTED
    if names := ", ".join(dof.name for dof in dofs if dof.verdict is DofVerdict.PRIOR):
        told = f"{names} of the child sensor: mostly from the prior, not the motion"
        warnings = (told, *warnings)
    fields.setdefault("method", "adaptive")
    fields.setdefault("backend", "fast")
    fields.setdefault("stamp_ns", int(stamps_ns[-1]))
    return Calibration(
        T_parent_child=fused.T_parent_child,
        covariance_measured=fused.cov_parent_child_in_child,
        observability_measured=dofs,
        status=status,
        objective=solution.objective,
        n_poses=len(stamps_ns),
        n_pairs=len(residuals),
        n_inliers=int(residuals.is_inlier.sum()),
        contradictions=fused.contradictions,
        target_translation=config.target_translation,
        target_rotation=config.target_rotation,
        target_axes=parse_targets("target.axes", config.target_axes),
        motion_residuals=residuals,
        warnings=warnings,
        **fields,
    )


def solve_poses(
    pose_pairs: PosePairs,
    config: CalibratorConfig,
    time_offset: TimeOffset | None = None,
    is_beside: bool = False,
) -> Solved:
    """Solve and assess synchronised poses.

    Parameters
    ----------
    pose_pairs : PosePairs
    config : CalibratorConfig
        With a time offset in seconds, which the poses already have.
    time_offset : TimeOffset, optional
        That offset, if it was estimated.
    is_beside : bool
        The answer is only to be compared with a result: without a floor or a proof.

    Raises
    ------
    ConfigError, NotEnoughDataError
        Without the backend, or with too few poses for the reference or for the scale.
    """
    scale, scale_fit = settle_scale(pose_pairs, config.scale)
    require_backend(config.method, config.backend)
    scaled = pose_pairs.child_scaled(scale)
    if config.method in ("auto", "adaptive"):
        solved = _solve_stream(scaled, config, is_clock_free=time_offset is not None)
    else:
        solved = _solve_pairs(scaled, config, is_beside=is_beside)
    found = solved.solution
    assessment = solved.assessment
    spread = np.zeros((6, 6))
    if scale_fit:
        by_log_scale = scale_fit.sensitivity[:, 0]
        share = scale_fit.scale_sigma / scale_fit.scale
        spread += np.outer(by_log_scale, by_log_scale) * share**2
    is_model = isinstance(found, AdaptiveSolution) and found.time_offset_s  # it knows its own
    if time_offset and time_offset.fit and not is_model:
        by_offset = time_offset.fit.sensitivity[:, 1]
        spread += np.outer(by_offset, by_offset) * time_offset.sigma_s**2
    spread += solved.spread
    if spread.any():
        assessment = widened(assessment, spread)
    axis = None if is_beside else rocking_axis(pose_pairs)
    if axis is not None:
        assessment = covariance.without_direction(assessment, axis)
    return replace(
        solved,
        assessment=assessment,
        config=config,
        scale=scale,
        scale_fit=scale_fit,
        time_offset=time_offset,
        floor=np.zeros((6, 6)) if is_beside else floor_of(solved, pose_pairs, config),
    )


def floor_of(solved: Solved, pose_pairs: PosePairs, config: CalibratorConfig) -> FloatArray:
    """Common-mode floor (6, 6) of the errors of the sensors that are odometries."""
    # The floor is that of two odometries.
    share = [config.parent_kind, config.child_kind].count("odometry") / 2
    speed_m_s = covariance.usual_speed(pose_pairs.stamps_ns, pose_pairs.Ts_pw_p[:, :3, 3])
    if isinstance(solved.solution, AdaptiveSolution):
        return share * covariance.common_mode_floor(speed_m_s)
    T = solved.solution.T_parent_child
    return share * covariance.floor_of_pairs(solved.pairs, solved.weights, T, speed_m_s)


def _solve_stream(pose_pairs: PosePairs, config: CalibratorConfig, is_clock_free: bool) -> Solved:
    """The adaptive estimator; with method auto DNLO if its noise model cannot work on these poses,
    or if a reference is given, which only the paper's methods have.
    """
    is_auto = config.method == "auto"
    with_dnlo = replace(config, method="dnlo")
    if is_auto and config.reference != "auto":
        dnlo = _solve_pairs(pose_pairs, with_dnlo)
        reason = f"auto: dnlo, because the user set reference {config.reference}"
        return replace(dnlo, method_reason=reason)
    # What the user set is not estimated; of a clock whose offset is to be, this is the last step.
    is_time_known = config.is_known("time_offset") and not is_clock_free
    known = {"scale": config.is_known("scale"), "time": is_time_known}
    solution = adaptive_estimator.solve(
        pose_pairs.stamps_ns,
        pose_pairs.Ts_pw_p,
        pose_pairs.Ts_cw_c,
        [name for name in SYSTEMATIC if not known.get(name)],
        is_clock_free=is_clock_free,
    )
    works = solution.converged and not solution.is_noise_dominated
    reason = "auto: adaptive, because its noise model works here" if is_auto else ""
    if is_auto and not works:
        why = "single poses are noisier than the motion between them"
        why = why if solution.is_noise_dominated else "the adaptive estimator did not converge"
        with contextlib.suppress(NotEnoughDataError):
            dnlo = _solve_pairs(pose_pairs, with_dnlo, solution)
            reason = f"auto: dnlo on reference {dnlo.reference}, because {why}"
            return replace(dnlo, method_reason=reason)
        reason = f"auto: adaptive, although {why}: there are too few poses for dnlo"
    return _of_model(pose_pairs, config, solution, reason)


def _of_model(
    pose_pairs: PosePairs, config: CalibratorConfig, solution: AdaptiveSolution, reason: str
) -> Solved:
    """An answer of the adaptive estimator, assessed; its motion pairs have the scale and the time
    offset that it found.
    """
    stamps_ns = pose_pairs.stamps_ns
    child = Trajectory(stamps_ns, pose_pairs.Ts_cw_c).scaled(solution.scale)
    Ts_cw_c = child.shifted(solution.time_offset_s).at(stamps_ns, extrapolate=True)
    spread, warnings = possible_shift(solution.part_products, solution.misfit)
    jumps = float(np.mean(solution.jumps))
    warning = (
        f"{jumps:.0%} of the increments are jumps: the errors do not fit the adaptive noise "
        "model; compare with method dnlo"
    )
    return Solved(
        solution=solution,
        assessment=covariance.assess_adaptive(pose_pairs, solution),
        method="adaptive",
        reference="increments",
        pairs=motion_pairs(pose_pairs.Ts_pw_p, Ts_cw_c, "B1"),
        weights=(~solution.jumps).astype(float),
        stamps_ns=stamps_ns,
        config=config,
        method_reason=reason,
        warnings=(warning, *warnings) if jumps > _MAX_JUMPS else warnings,
        spread=spread,
    )


def _solve_pairs(
    pose_pairs: PosePairs,
    config: CalibratorConfig,
    solution: AdaptiveSolution | None = None,
    is_beside: bool = False,
) -> Solved:
    """A method of the paper on the motion pairs of one reference, assessed; ``solution`` is the
    adaptive estimator's, if it is known. Beside another result there is no proof.
    """
    method = Method(config.method, config.threshold, config.min_inlier_fraction, config.backend)
    reference = config.reference
    reason = ""
    spread = np.zeros((6, 6))
    warnings: tuple[str, ...] = ()
    if reference == "auto":
        from hand_eye_calib.core.assessment.reference_selection import select_reference

        choice = select_reference(pose_pairs, replace(method, backend="fast"), solution=solution)
        reference = choice.reference
        reason = choice.reason()
        model = choice.model
        if model.converged and not model.unseen.size:
            spread, warnings = possible_shift(model.part_products, model.misfit)
    pairs = motion_pairs(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, reference)
    found = method.solve(pairs)
    return Solved(
        solution=found,
        assessment=covariance.assess(
            pairs, found, lambda without: method.solve_without(pairs, found, without)
        ),
        method=method.name,
        reference=reference,
        pairs=pairs,
        weights=found.weights,
        stamps_ns=pose_pairs.stamps_ns,
        config=config,
        reference_reason=reason,
        proved_global="not tried" if is_beside else method.proved_global(pairs, found),
        spread=spread,
        warnings=warnings,
    )


# ------------------------------------------------------------------------ other answers

# A result is compared with the method that takes least time, at these baselines, from at most and
# at least so many poses; the halves of a result without a baseline are solved at the last but one.
_METHOD = "dnlo"
_BASELINES = (1, 3, 8, 20)
_MOST_POSES = 3_000
_MIN_POSES = 20

# Fewest other answers that have a scatter.
_MIN_OTHERS = 3

# Answers whose standard deviation is below so many of the result's are about as certain. Fewest of
# them that say something.
_AS_CERTAIN = 3.0
_MIN_AS_CERTAIN = 2

# An answer from a smaller share of the motion pairs says nothing about others: DNLO keeps half of
# them at least, however noisy they are.
_FEWEST_INLIERS = 0.55

# A half does not see an axis that it knows this many times worse than the other half: its claim
# comes from noise. Simulated straight starts of 40 s: 12 to 47; curves in both halves: 1.1 to 4.0.
_UNEQUAL_HALVES = 5.0

# Smallest joint standard deviation (m, rad) to divide by: noise-free data has none.
_ROUNDING = 1e-9


def cross_checked(solved: Solved, config: CalibratorConfig, pose_pairs: PosePairs) -> Calibration:
    """Compare the result of a solve with DNLO at a few references and from each half.

    Part of every solve. Options and poses are those that gave the result: on one clock, each stream
    in its own unit of length. An axis that no reference determines is weak; a prior on such an axis
    is taken instead of the motion.
    """
    result = solved.calibration()
    others, halves = other_answers(result, config, pose_pairs)
    unconfirmed = np.array(AXES)[_unconfirmed(result, _sound(others))].tolist()
    replaced = [axis for axis in unconfirmed if axis in config.prior()]
    if replaced:
        result = solved.calibration(replaced)
    observability = tuple(
        replace(dof, verdict=DofVerdict.WEAK)
        if dof.name in unconfirmed and dof.verdict is DofVerdict.OBSERVED
        else dof
        for dof in result.observability_measured
    )
    result = replace(result, observability_measured=observability)
    return replace(result, cross_check=compare_answers(result, others, halves))


def _unconfirmed(result: Calibration, sound: Sequence[Calibration]) -> BoolArray:
    """Whether (6,) an axis of the result is determined by none of the other answers."""
    # An answer of a reference was solved where the motion shows most, which others need not see.
    if len(sound) < _MIN_OTHERS or METHODS[result.method].uses_reference:
        return np.zeros(len(AXES), dtype=bool)
    of_others = np.array([other.sigmas_measured for other in sound])
    return np.isfinite(result.sigmas_measured) & np.isinf(of_others).all(axis=0)


def other_answers(
    calibration: Calibration, config: CalibratorConfig, pose_pairs: PosePairs
) -> tuple[list[Calibration], list[Calibration]]:
    """Answers to the same question at other references, and from each half of the recording, with
    the time offset and the scale of the result, without priors; those with too few data are left
    out. Parameters as of :func:`cross_checked`.
    """
    free = replace(config, prior_x="", prior_y="", prior_z="")
    free = replace(free, prior_roll="", prior_pitch="", prior_yaw="")
    offset_s = calibration.time_offset_s
    scale = calibration.scale
    settled = replace(free, method=_METHOD, backend="fast", time_offset=offset_s, scale=scale)

    n_poses = len(pose_pairs)
    own = calibration.reference
    stride = max(-(-n_poses // _MOST_POSES), 1)
    others = [
        (f"B{n}", slice(None, None, stride))
        for n in _BASELINES
        if n * stride * 4 < n_poses and (calibration.method, own) != (_METHOD, f"B{n * stride}")
    ]
    if not METHODS[calibration.method].uses_reference or own[0] not in "BC":
        own = f"B{_BASELINES[-2]}"
    half = n_poses // 2
    stride = max(-(-(n_poses - half) // _MOST_POSES), 1)
    # About the same pairs of every stride-th pose.
    own = f"{own[0]}{max(round(int(own[1:]) / stride), 1 if own[0] == 'B' else 2)}"
    halves = [(own, slice(*edges, stride)) for edges in ((0, half), (half, n_poses))]
    found: tuple[list[Calibration], list[Calibration]] = [], []
    for answers, parts in zip(found, (others, halves), strict=True):
        for reference, part in parts:
            poses = pose_pairs[part]
            if len(poses) >= _MIN_POSES:
                with contextlib.suppress(HandEyeCalibError):
                    alike = replace(settled, reference=reference)
                    answers.append(solve_poses(poses, alike, is_beside=True).calibration())
    return found


def compare_answers(
    calibration: Calibration, others: Sequence[Calibration] = (), halves: Sequence[Calibration] = ()
) -> CrossCheck:
    """Compare a result with other answers to the same question: at other references, of which only
    those count that do not reject half of the motion pairs, and from the first and the second half
    of the recording, or fewer.
    """
    sigmas = calibration.sigmas_measured
    allowance = calibration.allowance
    sound = _sound(others)
    pairs = [_apart(calibration, other) for other in sound]
    apart, joint = np.reshape(pairs, (-1, 2, 6)).swapaxes(0, 1)
    own = np.maximum(sigmas, _ROUNDING)
    as_certain = np.reshape([other.sigmas_measured for other in sound], (-1, 6)) < _AS_CERTAIN * own
    of_as_certain = _robust_sigma(np.where(as_certain, apart, np.nan), _MIN_AS_CERTAIN)
    of_halves = excess_of_halves = np.full(6, np.nan)
    if len(halves) == 2:
        between, allowed = _apart(*halves)
        of_each = np.maximum([half.sigmas_measured for half in halves], _ROUNDING)
        is_seen = of_each.max(axis=0) < _UNEQUAL_HALVES * of_each.min(axis=0)
        between = np.where(is_seen, between, np.nan)
        # The whole is the mean of both halves: its standard deviation is half of that of their
        # difference. They do not state the allowance and, of another method, slow errors.
        of_halves = between / 2
        is_same = halves[0].method == calibration.method
        beside = allowance if is_same else calibration.sigmas
        excess_of_halves = of_halves / np.hypot(allowed / 2, beside)
    columns = {
        "sigma": calibration.sigmas,
        "of_methods": _robust_sigma(apart, _MIN_OTHERS),
        "of_halves": of_halves,
        "excess_of_methods": _robust_sigma(apart / np.hypot(joint, allowance), _MIN_OTHERS),
        "excess_of_halves": excess_of_halves,
        "excess_over_own": of_as_certain / np.hypot(own, allowance),
    }
    table = np.where(np.isfinite(sigmas), [*columns.values()], np.nan).T.tolist()
    rows = [[each if math.isfinite(each) else None for each in row] for row in table]
    confirmed = (~_unconfirmed(calibration, sound)).tolist()
    return {
        axis: AxisScatter(**dict(zip(columns, row, strict=True)), is_confirmed=is_confirmed)
        for axis, row, is_confirmed in zip(AXES, rows, confirmed, strict=True)
    }


def _sound(others: Sequence[Calibration]) -> list[Calibration]:
    return [one for one in others if one.n_inliers > _FEWEST_INLIERS * max(one.n_pairs, 1)]


def _apart(first: Calibration, second: Calibration) -> tuple[FloatArray, FloatArray]:
    """Distance (6,) of two answers and their joint standard deviation; NaN if either does not know
    the axis.
    """
    distance = np.abs(deviation(first.T_parent_child, second.T_parent_child))
    joint = np.hypot(first.sigmas_measured, second.sigmas_measured)
    known = np.isfinite(joint)
    return np.where(known, distance, np.nan), np.where(known, np.maximum(joint, _ROUNDING), np.nan)


def _robust_sigma(distances: FloatArray, fewest: int) -> FloatArray:
    """Standard deviation (6,) by the median of distances (N, 6) from zero; NaN for axes on which
    fewer are finite.
    """
    columns = [column[np.isfinite(column)] for column in distances.T]
    medians = [median(column) if len(column) >= fewest else np.nan for column in columns]
    return np.array(medians) / MEDIAN_NORMAL
