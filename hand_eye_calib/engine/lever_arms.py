"""From a stream of positions beside one of poses to a calibration: the lever arm, and the time
offset. The rotation is out of reach; by convention the sensor that measures positions has the axes
of the other one.
"""

from dataclasses import replace

import numpy as np

from hand_eye_calib.alignment.scale import horizontal_factors
from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.assessment.covariance import Assessment, assess_lever_arm
from hand_eye_calib.assessment.floor import FLOOR_ROTATION, FLOOR_SCALE
from hand_eye_calib.assessment.prior import fuse
from hand_eye_calib.checks.check import in_other_units, unit_of
from hand_eye_calib.checks.findings import Finding, finding
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import positions as lever_arm
from hand_eye_calib.gls.solution import LeverArmSolution
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration, DofVerdict, Residuals, SolveStatus

# Two streams of which more than this share of the path stays unexplained are not of one body. Of
# one body it is 0.05 at most, of two 0.5 and more.
_UNRELATED, _EXPLAINED = 0.3, 0.05

# Factors of x and y differ from 1 by more than this if latitude and longitude are wrong, and leave
# at most this share of what was unexplained.
_FACTOR_OFF, _MENDED = 0.03, 0.3


def estimate_lever_arm(pose_pairs: PosePairs, config: CalibratorConfig) -> Calibration:
    """Solve and assess synchronised poses and positions.

    Parameters
    ----------
    pose_pairs : PosePairs
        On one clock. Of the sensor that measures positions, orientations are not looked at.
    config : CalibratorConfig
        With a time offset in seconds, which the poses already have.

    Returns
    -------
    Calibration
        Without frame names. Its rotation is the identity, and unknown.
    """
    is_child = config.child_measures == "positions"
    poses, measured = pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c
    if not is_child:
        poses, measured = measured, poses
    given = 1.0 if isinstance(config.scale, str) else config.scale
    if is_child:
        measured = _scaled(measured, given)
    else:
        poses = _scaled(poses, given)
    positions = measured[:, :3, 3]
    with_scale = config.scale in ("auto", "estimate")
    solution = _solved(pose_pairs.stamps_ns, poses, positions, with_scale)
    sign = 1.0 if is_child else -1.0
    T = se3.from_rotation_translation(np.eye(3), sign * solution.lever_arm)
    fused = fuse(T, assess_lever_arm(poses, solution), config.prior())
    result = _calibration(solution, fused.assessment, pose_pairs, config)
    status = SolveStatus.CONTRADICTED if fused.contradictions else result.status
    scale = solution.scale if is_child else 1.0 / solution.scale
    axes = fused.assessment.observability[:3]
    is_known = any(dof.verdict is not DofVerdict.UNOBSERVABLE for dof in axes)
    findings = _findings(solution, is_known, pose_pairs.stamps_ns, poses, positions, is_child)
    # What does not explain the positions has no time offset either.
    offset_s = 0.0 if findings else sign * solution.time_offset_s
    return replace(
        result,
        T_parent_child=fused.T_parent_child,
        T_method=T,
        status=status,
        contradictions=fused.contradictions,
        time_offset_s=float(config.time_offset) + offset_s,
        scale=given * scale,
        scale_sigma=solution.scale_sigma * scale**2,
        motion_residuals=_residuals(solution, poses, positions, pose_pairs),
        findings=tuple(findings),
    )


def _solved(
    stamps_ns: IntArray, poses: FloatArray, positions: FloatArray, with_scale: bool
) -> LeverArmSolution:
    try:
        return lever_arm.solve(stamps_ns, poses, positions, with_scale)
    except np.linalg.LinAlgError:
        raise InputError(
            "no lever arm explains the positions: they may jump, or be of another body; look at "
            "both paths"
        ) from None


def _scaled(Ts: FloatArray, scale: float) -> FloatArray:
    scaled = Ts.copy()
    scaled[:, :3, 3] *= scale
    return scaled


def _calibration(
    solution: LeverArmSolution,
    assessment: Assessment,
    pose_pairs: PosePairs,
    config: CalibratorConfig,
) -> Calibration:
    """What does not depend on which of the sensors has positions."""
    is_known = all(
        dof.verdict is not DofVerdict.UNOBSERVABLE for dof in assessment.observability[:3]
    )
    status = SolveStatus.OK if is_known else SolveStatus.UNOBSERVABLE
    return Calibration(
        T_parent_child=np.eye(4),
        covariance=assessment.cov_parent_child_in_child,
        status=status if solution.converged else SolveStatus.NOT_CONVERGED,
        observability=assessment.observability,
        measured="positions",
        floor=_floor(solution),
        objective=solution.objective,
        method="adaptive",
        reference="increments",
        backend="fast",
        n_poses=len(pose_pairs),
        n_pairs=len(pose_pairs) - 1,
        n_inliers=len(pose_pairs) - 1 - int((solution.jumps | solution.spikes[1:]).sum()),
        time_offset_sigma_s=solution.time_offset_sigma_s,
        noise=solution.describe(pose_pairs.stamps_ns),
        **config.target_fields(),
        stamp_ns=int(pose_pairs.stamps_ns[-1]),
    )


def _floor(solution: LeverArmSolution) -> FloatArray:
    """Covariance (6, 6) of errors of the odometry that are the same all the time."""
    floor = np.zeros((6, 6))
    by_scale, by_direction = solution.by_scale, solution.by_direction
    floor[:3, :3] = FLOOR_SCALE**2 * np.outer(by_scale, by_scale)
    floor[:3, :3] += FLOOR_ROTATION**2 * by_direction @ by_direction.T
    return floor


def _residuals(
    solution: LeverArmSolution,
    poses: FloatArray,
    positions: FloatArray,
    pose_pairs: PosePairs,
) -> Residuals:
    """Of the steps from each position to the next, along the axes of the sensor with poses."""
    steps = np.diff(poses[:, :3, :3] @ solution.lever_arm + poses[:, :3, 3], axis=0)
    axes = np.swapaxes(poses[:-1, :3, :3], 1, 2)
    excess = np.linalg.norm(steps, axis=1) - np.linalg.norm(np.diff(positions, axis=0), axis=1)
    along = steps / np.maximum(np.linalg.norm(steps, axis=1), 1e-12)[:, None]
    return Residuals(
        translation=(axes @ (excess[:, None] * along)[:, :, None])[:, :, 0],
        rotation=np.zeros((len(steps), 3)),
        weights=(~(solution.jumps | solution.spikes[1:])).astype(float),
        start_ns=pose_pairs.stamps_ns[:-1],
        end_ns=pose_pairs.stamps_ns[1:],
    )


def _findings(
    solution: LeverArmSolution,
    is_known: bool,
    stamps_ns: IntArray,
    poses: FloatArray,
    positions: FloatArray,
    is_child: bool,
) -> list[Finding]:
    """A finding if the path of the positions is not that of the odometry, or in other units."""
    share = lever_arm.unexplained_share(poses, positions, solution)
    if share < _EXPLAINED:
        return []
    if found := _coordinates(share, stamps_ns, poses, positions, "child" if is_child else "parent"):
        return [found]
    if is_known and share < _UNRELATED:
        return []
    found = finding(
        "unrelated_parts",
        share=min(share, 1.0),
        other="odometry",
        part="motion of the positions",
        units="the units, the scale",
    )
    try:
        scaled = _solved(stamps_ns, poses, positions, with_scale=True)
    except InputError:
        return [found]
    scale = scaled.scale if is_child else 1.0 / scaled.scale
    explains = lever_arm.unexplained_share(poses, positions, scaled) < _UNRELATED
    if explains and (in_unit := unit_of(scale)):
        factor, unit = in_unit
        found = in_other_units(scale, scaled.scale_sigma * (scale / scaled.scale), unit, factor)
    return [found]


def _coordinates(
    share: float, stamps_ns: IntArray, poses: FloatArray, positions: FloatArray, stream: str
) -> Finding | None:
    """What is wrong with east and north, if that explains the path."""
    lever_arm_m, found = np.zeros(3), None
    for _ in range(2):  # the second time with the lever arm
        factors = horizontal_factors(poses[:, :3, :3] @ lever_arm_m + poses[:, :3, 3], positions)
        key = None if factors is None else _wrong_coordinates(factors)
        if factors is None or key is None:
            break
        mended = positions * [*factors, 1.0]
        if key == "swapped_coordinates":
            mended = mended[:, [1, 0, 2]]
        left, lever_arm_m = _left(stamps_ns, poses, mended)
        is_mended = left < _MENDED * share
        found = _of_coordinates(key, stream, factors, (share, left)) if is_mended else None
    if found:
        return found
    left, _ = _left(stamps_ns, poses, positions[:, [1, 0, 2]])
    if left >= _MENDED * share:
        return None
    return _of_coordinates("mirrored_positions", stream, np.ones(2), (share, left))


def _of_coordinates(
    key: str, stream: str, factors: FloatArray, shares: tuple[float, float]
) -> Finding:
    """A finding about east and north: factors of x and y (2,), unexplained shares of the path as it
    is and without the mistake.
    """
    cosines = min(1.0 / factors[0], 1.0), min(factors[1], 1.0)
    longitude, latitude = np.degrees(np.arccos(cosines))
    return finding(
        key,
        stream,
        factor_x=float(factors[0]),
        factor_y=float(factors[1]),
        latitude=latitude,
        longitude=longitude,
        unexplained_share=shares[0],
        unexplained_share_mended=shares[1],
    )


def _left(
    stamps_ns: IntArray, poses: FloatArray, positions: FloatArray
) -> tuple[float, FloatArray]:
    """Unexplained share of the path of positions, and the lever arm; 1 if they have none."""
    try:
        solution = _solved(stamps_ns, poses, positions, with_scale=False)
    except InputError:
        return 1.0, np.zeros(3)
    return lever_arm.unexplained_share(poses, positions, solution), solution.lever_arm


def _wrong_coordinates(factors: FloatArray) -> str | None:
    """The finding that factors of x and y speak for; None if they speak for none."""
    east, north = factors
    off = np.abs(factors - 1.0) > _FACTOR_OFF
    if east > 1.0 - _FACTOR_OFF and north < 1.0 + _FACTOR_OFF and off.any():
        return "swapped_coordinates"
    return "longitude_scale" if east < 1.0 and off.tolist() == [True, False] else None
