"""From synchronised poses to a calibration: settle the scale, choose the motion pairs, solve,
assess, add the prior, judge.
"""

import contextlib
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hand_eye_calib.alignment.similarity import SimilarityFit, settle_scale
from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.assessment.covariance import Assessment, assess, assess_adaptive, without_axes
from hand_eye_calib.assessment.floor import common_mode_floor, floor_of_pairs, usual_speed
from hand_eye_calib.assessment.moved import PossibleShift, possible_shift
from hand_eye_calib.assessment.prior import Fused, fuse, widened
from hand_eye_calib.config import CalibratorConfig, require_backend
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.gls import estimator as adaptive_estimator
from hand_eye_calib.gls.estimator import AdaptiveSolution
from hand_eye_calib.gls.increments import SYSTEMATIC
from hand_eye_calib.pairing.motion_pairs import MotionPairs, PosePairs, motion_pairs
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import Residuals
from hand_eye_calib.solvers.all_pairs import Solution
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.text import parse_targets

# Largest share of the increments that may be jumps: with jumps at a tenth of the poses of both
# trajectories it is a fifth.
_MAX_JUMPS = 0.25


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Poses that were solved and assessed with any method, before priors are added and unknown
    directions are set.

    Attributes
    ----------
    shift : PossibleShift or None
        Of the mount within the recording.
    stamps_ns, config, scale, time_offset
        What was solved; the time offset if it was estimated.
    floor : (6, 6) array
        Common-mode uncertainty; zeros if it is only to be compared with a result.
    """

    solution: Solution | AdaptiveSolution
    assessment: Assessment
    method: str
    reference: str
    pairs: MotionPairs
    weights: FloatArray
    stamps_ns: IntArray
    config: CalibratorConfig
    method_reason: str = ""
    reference_reason: str = ""
    proved_global: str = "not tried"
    warnings: tuple[str, ...] = ()
    shift: PossibleShift | None = None
    scale: float = 1.0
    scale_fit: SimilarityFit | None = None
    time_offset: TimeOffset | None = None
    floor: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    def calibration(self, unseen: Collection[str] = ()) -> Calibration:
        """The result without frame names; ``unseen`` axes count as unobservable whatever the method
        says.
        """
        T_method, config = self.solution.T_parent_child, self.config
        fused = fuse(T_method, without_axes(self.assessment, T_method, unseen), config.prior())
        offset_s, offset_sigma_s = float(config.time_offset), 0.0
        if offset := self.time_offset:
            offset_s, offset_sigma_s = offset.seconds, offset.sigma_s
        scale, scale_sigma, warnings = self.scale, 0.0, [*fused.warnings]
        if self.scale_fit:
            scale_sigma = self.scale_fit.scale_sigma
            times = f"{scale:.4f} +/- {scale_sigma:.4f}, as estimated from the motion"
            warnings += [f"the child's lengths are multiplied by {times}"] * (
                config.scale == "auto"
            )
        found, noise = self.solution, None
        if isinstance(found, AdaptiveSolution):
            noise = found.describe(self.stamps_ns)
            offset_s += found.time_offset_s
            offset_sigma_s = found.time_offset_sigma_s or offset_sigma_s
            scale_sigma = scale * found.scale_sigma or scale_sigma
            scale *= found.scale
        return calibration_of(
            found,
            fused,
            residuals_of(self.pairs, fused.T_parent_child, self.weights, self.stamps_ns),
            self.stamps_ns,
            config,
            T_method=T_method,
            floor=self.floor,
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
            warnings=(*warnings, *self.warnings, *(self.shift.warnings if self.shift else ())),
        )


def calibration_of(
    solution: Any,
    fused: Fused,
    residuals: Residuals,
    stamps_ns: IntArray,
    config: CalibratorConfig,
    **fields: Any,
) -> Calibration:
    """A result from a solution with ``converged`` and ``objective``, what was fused with the prior,
    the residuals, the stamps of the poses, and further fields.
    """
    values: dict[str, Any] = {
        "status": fused.status(solution.converged),
        "method": "adaptive",
        "backend": "fast",
        "stamp_ns": int(stamps_ns[-1]),
    }
    return Calibration(
        T_parent_child=fused.T_parent_child,
        covariance=fused.assessment.cov_parent_child_in_child,
        observability=fused.assessment.observability,
        objective=solution.objective,
        n_poses=len(stamps_ns),
        n_pairs=len(residuals),
        n_inliers=int(residuals.is_inlier.sum()),
        contradictions=fused.contradictions,
        target_translation=config.target_translation,
        target_rotation=config.target_rotation,
        target_axes=parse_targets("target.axes", config.target_axes),
        motion_residuals=residuals,
        **values | fields,
    )


def residuals_of(
    pairs: MotionPairs, T_parent_child: FloatArray, weights: FloatArray, stamps_ns: IntArray
) -> Residuals:
    """Residuals of motion pairs between poses of these stamps (N,), with their weights (K,)."""
    translation, rotation = pairs.residuals(T_parent_child)
    return Residuals(
        translation=translation,
        rotation=rotation,
        weights=weights,
        start_ns=stamps_ns[pairs.i],
        end_ns=stamps_ns[pairs.j],
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
    found, spread = solved.solution, np.zeros((6, 6))
    if scale_fit:
        by_log_scale = scale_fit.sensitivity[:, 0]
        share = scale_fit.scale_sigma / scale_fit.scale
        spread += np.outer(by_log_scale, by_log_scale) * share**2
    is_model = isinstance(found, AdaptiveSolution) and found.time_offset_s  # it knows its own
    if time_offset and time_offset.fit and not is_model:
        by_offset = time_offset.fit.sensitivity[:, 1]
        spread += np.outer(by_offset, by_offset) * time_offset.sigma_s**2
    if solved.shift is not None:
        spread += solved.shift.spread
    return replace(
        solved,
        assessment=widened(solved.assessment, found.T_parent_child[:3, :3], spread),
        config=config,
        scale=scale,
        scale_fit=scale_fit,
        time_offset=time_offset,
        floor=np.zeros((6, 6)) if is_beside else _floor(solved, pose_pairs, config),
    )


def _floor(solved: Solved, pose_pairs: PosePairs, config: CalibratorConfig) -> FloatArray:
    """Common-mode floor (6, 6) of the errors of the sensors that are odometries."""
    found, odometries = solved.solution, [config.parent_kind, config.child_kind].count("odometry")
    speed_m_s = usual_speed(pose_pairs.stamps_ns, pose_pairs.Ts_pw_p[:, :3, 3])
    if isinstance(found, AdaptiveSolution):
        return odometries / 2 * common_mode_floor(speed_m_s)
    T = found.T_parent_child
    return odometries / 2 * floor_of_pairs(solved.pairs, solved.weights, T, speed_m_s)


def _solve_stream(pose_pairs: PosePairs, config: CalibratorConfig, is_clock_free: bool) -> Solved:
    """The adaptive estimator; with method auto DNLO if its noise model cannot work on these poses,
    or if a reference is given, which only the paper's methods have.
    """
    is_auto, with_dnlo = config.method == "auto", replace(config, method="dnlo")
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
    works = solution.converged and not solution.is_drowned
    reason = "auto: adaptive, because its noise model works here" if is_auto else ""
    if is_auto and not works:
        why = "single poses are noisier than the motion between them"
        why = why if solution.is_drowned else "the adaptive estimator did not converge"
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
    jumps = float(np.mean(solution.jumps))
    warning = (
        f"{jumps:.0%} of the increments are jumps: the errors do not fit the adaptive noise "
        "model; compare with method dnlo"
    )
    return Solved(
        solution=solution,
        assessment=assess_adaptive(pose_pairs, solution),
        method="adaptive",
        reference="increments",
        pairs=motion_pairs(pose_pairs.Ts_pw_p, Ts_cw_c, "B1"),
        weights=(~solution.jumps).astype(float),
        stamps_ns=stamps_ns,
        config=config,
        method_reason=reason,
        warnings=(warning,) if jumps > _MAX_JUMPS else (),
        shift=possible_shift(solution.part_products, solution.misfit),
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
    reference, reason, shift = config.reference, "", None
    if reference == "auto":
        from hand_eye_calib.assessment.reference_selection import select_reference

        choice = select_reference(pose_pairs, replace(method, backend="fast"), solution=solution)
        reference, reason, model = choice.reference, choice.reason(), choice.model
        if model.converged and not model.unseen.size:
            shift = possible_shift(model.part_products, model.misfit)
    pairs = motion_pairs(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, reference)
    found = method.solve(pairs)
    return Solved(
        solution=found,
        assessment=assess(
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
        shift=shift,
    )
