"""From synchronised poses to a calibration.

The steps are: determine the scale, choose the motion pairs, solve, assess, add the prior.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from hand_eye_calib.core.alignment.scale import settle_scale
from hand_eye_calib.core.alignment.similarity import SimilarityFit
from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.assessment import common_mode, covariance
from hand_eye_calib.core.assessment.moved import possible_shift
from hand_eye_calib.core.assessment.noise_words import noise_in_words
from hand_eye_calib.core.assessment.prior import fuse, widened
from hand_eye_calib.core.assessment.rocking import rocking_axis
from hand_eye_calib.core.assessment.second_opinion import (
    excess_covariance,
    second_opinions,
)
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.config import CalibratorConfig, require_backend
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.registry import OUT_OF_REACH
from hand_eye_calib.core.base.text import parse_targets
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.noise import estimator as adaptive_estimator
from hand_eye_calib.core.noise.estimator import (
    AdaptiveSolution,
    NoiseModelError,
)
from hand_eye_calib.core.noise.increments import SYSTEMATIC
from hand_eye_calib.core.noise.tuning import TUNING
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    motion_pairs,
)
from hand_eye_calib.core.results.calibration import (
    Calibration,
    DofVerdict,
    SolveStatus,
)
from hand_eye_calib.core.results.records import Residuals
from hand_eye_calib.core.solvers.all_pairs import Solution
from hand_eye_calib.core.solvers.registry import Method

# Share of jumps among the increments that causes a warning. If a tenth of the poses of each
# trajectory jumps, a fifth of the increments are jumps.
_MAX_JUMP_SHARE = 0.25


def _zero_covariance() -> FloatArray:
    """Return a covariance (6, 6) of zero."""
    return np.zeros((6, 6))


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Solution of synchronised poses and its assessment, before a prior is added.

    Attributes
    ----------
    solution : Solution or AdaptiveSolution
    assessment : Assessment
        Covariance and observability of the solution.
    method, reference : str
        Names of the method and of the reference that were used.
    measured : str
        Kind of data.
    pairs : MotionPairs
        Motion pairs whose residuals are in the result.
    weights : (K,) array
        Weights of the motion pairs.
    stamps_ns : (N,) int64 array
        Stamps of the poses.
    config : CalibratorConfig
    method_reason, reference_reason : str
        Reasons for which ``auto`` chose the method and the reference.
    proved_global : str
        Whether the minimum is proved to be global: "yes", "no" or "not tried".
    warnings : tuple of str
    spread : (6, 6) array
        Covariance by a possible shift of the mount during the recording; zero if there was none.
    scale : float
        Factor by which the child's lengths were multiplied.
    scale_fit : SimilarityFit or None
        Fit of the scale, if the scale was estimated.
    time_offset : TimeOffset or None
        Time offset, if it was estimated.
    floor : (6, 6) array
        Covariance of constant errors that both sensors have in common, which is the allowance.
    opinions : tuple of Assessment
        Second opinions: estimates by robust least squares, which test the solution.
    excess : (6, 6) array
        Covariance that the noise model lacks, estimated from ``opinions``.
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
    spread: FloatArray = field(default_factory=_zero_covariance)
    scale: float = 1.0
    scale_fit: SimilarityFit | None = None
    time_offset: TimeOffset | None = None
    floor: FloatArray = field(default_factory=_zero_covariance)
    opinions: tuple[covariance.Assessment, ...] = ()
    excess: FloatArray = field(default_factory=_zero_covariance)

    def calibration(self, unseen: Collection[str] = ()) -> Calibration:
        """Return the result without frame names. The axes in ``unseen`` become unobservable."""
        config = self.config
        solution = self.solution
        assessment = self.assessment
        if self.excess.any():
            assessment = widened(assessment, self.excess)
        if unseen:
            assessment = covariance.without_axes(assessment, unseen)
        fused = fuse(assessment, config.prior())
        warnings = self.warnings
        if self.scale_fit and config.scale == "auto":
            factor = f"{self.scale:.4f} +/- {self.scale_fit.scale_sigma:.4f}"
            warnings = (
                f"the child's lengths are multiplied by {factor}, as estimated from the motion",
                *warnings,
            )
        noise = None
        if isinstance(solution, AdaptiveSolution):
            noise = noise_in_words(
                solution,
                self.stamps_ns,
                self.time_offset.seconds if self.time_offset else None,
                self.scale if self.scale_fit else None,
            )
        residuals = Residuals(
            *self.pairs.residuals(fused.T_parent_child),
            self.weights,
            self.stamps_ns[self.pairs.i],
            self.stamps_ns[self.pairs.j],
        )
        return calibration_of(
            solution,
            fused,
            residuals,
            self.stamps_ns,
            config,
            warnings,
            measured=self.measured,
            T_method=solution.T_parent_child,
            covariance_allowance=fused.allowance(self.floor),
            proved_global=self.proved_global,
            method=self.method,
            method_reason=self.method_reason,
            reference=self.reference,
            reference_reason=self.reference_reason,
            noise=noise,
            backend=config.backend,
            **self._clock(),
            **self._scale(),
        )

    def _clock(self) -> dict[str, Any]:
        """Return the fields of the result about time offset and clock rate."""
        offset_s = float(self.config.time_offset)
        offset_sigma_s = 0.0
        clock_rate = None
        if self.time_offset:
            offset_s = self.time_offset.seconds
            offset_sigma_s = self.time_offset.sigma_s
            clock_rate = self.time_offset.rate
        if isinstance(self.solution, AdaptiveSolution):
            offset_s += self.solution.time_offset_s
            offset_sigma_s = self.solution.time_offset_sigma_s or offset_sigma_s
        return {
            "time_offset_s": offset_s,
            "time_offset_sigma_s": offset_sigma_s,
            "clock_rate": clock_rate,
        }

    def _scale(self) -> dict[str, float]:
        """Return the fields of the result about the scale of the child."""
        scale = self.scale
        scale_sigma = self.scale_fit.scale_sigma if self.scale_fit else 0.0
        if isinstance(self.solution, AdaptiveSolution):
            scale_sigma = scale * self.solution.scale_sigma or scale_sigma
            scale *= self.solution.scale
        return {"scale": scale, "scale_sigma": scale_sigma}


def _status_of(
    solution: Any, fused: covariance.Assessment, measured: str
) -> SolveStatus:
    """Return the status of a solution; axes out of reach of what was measured do not count."""
    unobservable = {
        dof.name
        for dof in fused.observability
        if dof.verdict is DofVerdict.UNOBSERVABLE
    }
    if not solution.converged:
        return SolveStatus.NOT_CONVERGED
    if fused.contradictions:
        return SolveStatus.CONTRADICTED
    if unobservable.difference(OUT_OF_REACH.get(measured, ())):
        return SolveStatus.UNOBSERVABLE
    return SolveStatus.OK


def calibration_of(
    solution: Any,
    fused: covariance.Assessment,
    residuals: Residuals,
    stamps_ns: IntArray,
    config: CalibratorConfig,
    warnings: tuple[str, ...] = (),
    **fields: Any,
) -> Calibration:
    """Return the result of a solution for any kind of data.

    Parameters
    ----------
    solution : object
        Object with the attributes ``converged`` and ``objective``.
    fused : Assessment
        Assessment of the solution, combined with the prior.
    residuals : Residuals
    stamps_ns : (N,) int64 array
        Stamps of the poses.
    config : CalibratorConfig
    warnings : tuple of str
        Warnings. If axes are mostly from the prior, a warning about these axes is put first.
    **fields
        Further fields of the Calibration. They replace the defaults.
    """
    dofs = fused.observability
    measured = fields.get("measured", "poses")
    by_prior = [dof.name for dof in dofs if dof.verdict is DofVerdict.PRIOR]
    if by_prior:
        names = ", ".join(by_prior)
        warning = f"{names} of the child sensor: mostly from the prior, not the motion"
        warnings = (warning, *warnings)
    kinds = {"parent": config.parent_kind, "child": config.child_kind}
    exact_streams = [
        stream for stream, kind in kinds.items() if kind == "exact"
    ]
    defaults = {
        "method": "adaptive",
        "backend": "fast",
        "stamp_ns": int(stamps_ns[-1]),
    }
    return Calibration(
        T_parent_child=fused.T_parent_child,
        covariance_measured=fused.cov_parent_child_in_child,
        observability_measured=dofs,
        status=_status_of(solution, fused, measured),
        objective=solution.objective,
        exact_streams=tuple(exact_streams),
        n_poses=len(stamps_ns),
        n_pairs=len(residuals),
        n_inliers=int(residuals.is_inlier.sum()),
        contradictions=fused.contradictions,
        target_translation=config.target_translation,
        target_rotation=config.target_rotation,
        target_axes=parse_targets("target.axes", config.target_axes),
        motion_residuals=residuals,
        warnings=warnings,
        **{**defaults, **fields},
    )


def solve_poses(
    pose_pairs: PosePairs,
    config: CalibratorConfig,
    time_offset: TimeOffset | None = None,
) -> Solved:
    """Solve and assess synchronised poses.

    Parameters
    ----------
    pose_pairs : PosePairs
    config : CalibratorConfig
        Options. Their time offset is a number (s) that was already applied to the poses.
    time_offset : TimeOffset, optional
        The same time offset with its uncertainty, if it was estimated.

    Returns
    -------
    Solved

    Raises
    ------
    ConfigError
        If the method does not have the backend.
    NotEnoughDataError
        If there are too few poses for the reference or for the scale.
    """
    scale, scale_fit = settle_scale(pose_pairs, config.scale)
    require_backend(config.method, config.backend)
    scaled = pose_pairs.child_scaled(scale)
    if config.method in ("auto", "adaptive"):
        solved = _solve_stream(
            scaled, config, is_clock_free=time_offset is not None
        )
    else:
        solved = _solve_pairs(scaled, config)
    spread = solved.spread + _spread_of_scale_and_offset(
        solved.solution, scale_fit, time_offset
    )
    assessment = solved.assessment
    if spread.any():
        assessment = widened(assessment, spread)
    axis = rocking_axis(pose_pairs)
    if axis is not None:
        assessment = covariance.without_direction(assessment, axis)
    return replace(
        solved,
        assessment=assessment,
        config=config,
        scale=scale,
        scale_fit=scale_fit,
        time_offset=time_offset,
        floor=floor_of(solved, pose_pairs, config),
        excess=excess_covariance(assessment, solved.opinions),
    )


def _spread_of_scale_and_offset(
    solution: object,
    scale_fit: SimilarityFit | None,
    time_offset: TimeOffset | None,
) -> FloatArray:
    """Return the covariance (6, 6) of the result by an estimated scale and time offset."""
    spread = _zero_covariance()
    if scale_fit:
        by_log_scale = scale_fit.sensitivity[:, 0]
        relative_sigma = scale_fit.scale_sigma / scale_fit.scale
        spread += np.outer(by_log_scale, by_log_scale) * relative_sigma**2
    # If the noise model estimates the time offset, its covariance already contains the uncertainty.
    has_offset = (
        isinstance(solution, AdaptiveSolution) and solution.time_offset_s
    )
    if time_offset and time_offset.fit and not has_offset:
        by_offset = time_offset.fit.sensitivity[:, 1]
        spread += np.outer(by_offset, by_offset) * time_offset.sigma_s**2
    return spread


def floor_of(
    solved: Solved, pose_pairs: PosePairs, config: CalibratorConfig
) -> FloatArray:
    """Return the covariance (6, 6) of constant errors of those sensors that are odometries."""
    # The functions in `common_mode` are for two odometries.
    share = [config.parent_kind, config.child_kind].count("odometry") / 2
    speed_m_s = common_mode.usual_speed(
        pose_pairs.stamps_ns, se3.translation_of(pose_pairs.Ts_pw_p)
    )
    if isinstance(solved.solution, AdaptiveSolution):
        return share * common_mode.common_mode_floor(speed_m_s)
    T = solved.solution.T_parent_child
    return share * common_mode.floor_of_pairs(
        solved.pairs, solved.weights, T, speed_m_s
    )


def _solve_stream(
    pose_pairs: PosePairs, config: CalibratorConfig, is_clock_free: bool
) -> Solved:
    """Solve with the adaptive estimator.

    Method ``auto`` uses DNLO instead in two cases: the noise model does not fit these poses, or the
    user set a reference, which the adaptive estimator does not use.
    """
    is_auto = config.method == "auto"
    with_dnlo = replace(config, method="dnlo")
    if is_auto and config.reference != "auto":
        reason = (
            f"auto: dnlo, because the user set reference {config.reference}"
        )
        return replace(
            _solve_pairs(pose_pairs, with_dnlo), method_reason=reason
        )
    # If the user set a scale or time offset to a number, the noise model does not estimate it. It
    # refines a time offset that is "estimate".
    is_fixed = {
        "scale": config.is_known("scale"),
        "time": config.is_known("time_offset") and not is_clock_free,
    }
    try:
        solution = adaptive_estimator.solve(
            pose_pairs.stamps_ns,
            pose_pairs.Ts_pw_p,
            pose_pairs.Ts_cw_c,
            [name for name in SYSTEMATIC if not is_fixed.get(name)],
            is_clock_free=is_clock_free,
        )
    except NoiseModelError:
        if not is_auto:
            raise
        reference = TUNING.start_reference
        dnlo = _solve_pairs(pose_pairs, replace(with_dnlo, reference=reference))
        reason = f"auto: dnlo on reference {reference}, because no noise model fits these poses"
        return _with_opinions(dnlo, pose_pairs, reason)
    if not is_auto:
        return _of_model(pose_pairs, config, solution, "")
    if solution.converged and not solution.is_noise_dominated:
        reason = "auto: adaptive, because its noise model works here"
        return _of_model(pose_pairs, config, solution, reason)
    problem = "the adaptive estimator did not converge"
    if solution.is_noise_dominated:
        problem = "single poses are noisier than the motion between them"
    try:
        dnlo = _solve_pairs(pose_pairs, with_dnlo, solution)
    except NotEnoughDataError:
        reason = f"auto: adaptive, although {problem}: there are too few poses for dnlo"
        return _of_model(pose_pairs, config, solution, reason)
    reason = f"auto: dnlo on reference {dnlo.reference}, because {problem}"
    return _with_opinions(dnlo, pose_pairs, reason)


def _with_opinions(dnlo: Solved, pose_pairs: PosePairs, reason: str) -> Solved:
    """Return a solution of DNLO, used instead of the noise model, with second opinions."""
    T_parent_child = dnlo.solution.T_parent_child
    opinions = second_opinions(
        pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, T_parent_child
    )
    return replace(dnlo, method_reason=reason, opinions=opinions)


def _of_model(
    pose_pairs: PosePairs,
    config: CalibratorConfig,
    solution: AdaptiveSolution,
    reason: str,
) -> Solved:
    """Assess a solution of the adaptive estimator.

    The motion pairs of the result contain the scale and time offset of the solution. ``reason`` is
    the reason for the method.
    """
    stamps_ns = pose_pairs.stamps_ns
    child = Trajectory(stamps_ns, pose_pairs.Ts_cw_c).scaled(solution.scale)
    Ts_cw_c = child.shifted(solution.time_offset_s).at(
        stamps_ns, extrapolate=True
    )
    spread, warnings = possible_shift(solution.part_products, solution.misfit)
    jumps = float(np.mean(solution.jumps))
    if jumps > _MAX_JUMP_SHARE:
        warning = (
            f"{jumps:.0%} of the increments are jumps: the errors do not fit the adaptive noise "
            "model; compare with method dnlo"
        )
        warnings = (warning, *warnings)
    return Solved(
        solution=solution,
        assessment=covariance.assess_adaptive(pose_pairs, solution),
        opinions=second_opinions(
            pose_pairs.Ts_pw_p, Ts_cw_c, solution.T_parent_child
        ),
        method="adaptive",
        reference="increments",
        pairs=motion_pairs(pose_pairs.Ts_pw_p, Ts_cw_c, "B1"),
        weights=(~solution.left_out).astype(float),
        stamps_ns=stamps_ns,
        config=config,
        method_reason=reason,
        warnings=warnings,
        spread=spread,
    )


def _motion_pairs(pose_pairs: PosePairs, reference: str) -> MotionPairs:
    """Return the motion pairs of a reference. Raise NotEnoughDataError if there are none."""
    pairs = motion_pairs(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, reference)
    if len(pairs) == 0:
        raise NotEnoughDataError(
            f"reference {reference} needs more than {reference[1:] or 1} common poses, found "
            f"{len(pose_pairs)}; record longer, or choose a reference over fewer poses"
        )
    return pairs


@dataclass(frozen=True)
class _Reference:
    """Name of a reference and, if it was chosen automatically, what its choice has shown.

    ``reason`` is the reason of the choice. ``spread`` and ``warnings`` are those of
    :func:`~hand_eye_calib.core.assessment.moved.possible_shift`.
    """

    name: str
    reason: str = ""
    spread: FloatArray = field(default_factory=_zero_covariance)
    warnings: tuple[str, ...] = ()


def _selected_reference(
    pose_pairs: PosePairs, method: Method, adaptive: AdaptiveSolution | None
) -> _Reference:
    """Return the best reference by the noise model; the arguments are those of _solve_pairs."""
    from hand_eye_calib.core.assessment.reference_selection import (
        select_reference,
    )

    choice = select_reference(
        pose_pairs, replace(method, backend="fast"), solution=adaptive
    )
    model = choice.model
    if not model.converged or model.unseen.size:
        return _Reference(choice.reference, choice.reason())
    spread, warnings = possible_shift(model.part_products, model.misfit)
    return _Reference(choice.reference, choice.reason(), spread, warnings)


def _solve_pairs(
    pose_pairs: PosePairs,
    config: CalibratorConfig,
    adaptive: AdaptiveSolution | None = None,
) -> Solved:
    """Solve and assess the motion pairs of one reference with a method of the paper.

    Parameters
    ----------
    pose_pairs : PosePairs
    config : CalibratorConfig
    adaptive : AdaptiveSolution, optional
        Solution of the adaptive estimator, from which the reference ``auto`` is chosen. By default,
        it is computed if needed.
    """
    method = Method(
        config.method,
        config.threshold,
        config.min_inlier_fraction,
        config.backend,
    )
    chosen = _Reference(config.reference)
    if config.reference == "auto" and method.solve_best_stride:
        best = method.solve_best_stride(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c)
        reason = f"{best.reference}: motions over this number of poses have the smallest covariance"
        chosen = _Reference(best.reference, reason)
        pairs = best.pairs
        solution: Solution = best.solution
    else:
        if config.reference == "auto":
            chosen = _selected_reference(pose_pairs, method, adaptive)
        pairs = _motion_pairs(pose_pairs, chosen.name)
        solution = method.solve(pairs)
    solve_without = partial(method.solve_without, pairs, solution)
    return Solved(
        solution=solution,
        assessment=covariance.assess(pairs, solution, solve_without),
        method=method.name,
        reference=chosen.name,
        pairs=pairs,
        weights=solution.weights,
        stamps_ns=pose_pairs.stamps_ns,
        config=config,
        reference_reason=chosen.reason,
        proved_global=method.proved_global(pairs, solution),
        spread=chosen.spread,
        warnings=chosen.warnings,
    )
