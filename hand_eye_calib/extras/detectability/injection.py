"""Injection of errors into a recording. The part of the recording that was not used judges them.

Motions of about a second have residuals ``e = -J x + noise``. The unknowns x are the error xi of X
in ``X exp(xi)``, an error of the time offset, and a relative error of the scale. The evidence ``[H
S]`` of all seconds is added (:mod:`hand_eye_calib.core.base.blocks`).

*Errors of the result.* The blocks are split at random into two halves. One half estimates x. The
other half judges, with an estimate of its own. Their difference is d. An error of size a in an
unknown changes the difference to ``d + a`` or ``d - a``. The error is contradicted if

    |d +- a| > 3 sqrt((2 s)^2 + allowance^2).

s is the standard deviation for the whole recording, so the difference of two halves has 2 s. It is
the larger of two values. The first is from the block jackknife (H. Kuensch, *The jackknife and the
bootstrap for general stationary observations*, 1989): the actual scatter of the blocks. The second
is the measured part of the sigma of the result, because a method of the paper may use the motion
less well than the blocks. If the jackknife is much larger, the sigma is too small: the smallest
error that is found in nine of ten trials also tests this sigma. A constant error of an odometry is
equal in both halves; the allowance represents it.

*Shifts of the mount.* The child's poses after a time in the middle are moved by ``exp(a u)``: a
shift of size a along the unit vector u. The likelihood ratio of the stream checks
(:mod:`hand_eye_calib.core.assessment.moved`) leads to a first size. Shifts of this size are then
injected, and the stream check is run. The size is increased until the check reports the shift. X is
not estimated again. The injections take longer than all other steps, so they are made only when a
caller reads the sizes of the shifts.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from hand_eye_calib.core.assessment import moved
from hand_eye_calib.core.assessment.common_mode import usual_speed
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks, information, solve
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.agreement import slow_suspects
from hand_eye_calib.core.checks.check import MAX_MOTIONS
from hand_eye_calib.core.checks.findings import LIMITS
from hand_eye_calib.core.checks.stream_pair import LAGS_S, MIN_PAIRS
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    pairs_over,
)
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import AXES, DofVerdict
from hand_eye_calib.extras.detectability.record import (
    FOUND_SHARE,
    SIGMAS,
    Detectability,
    SizesAtFirstUse,
)

# Number of random splits into halves.
_N_TRIALS = 10
# Numbers of blocks for the jackknife. The largest of the three standard deviations is used, because
# errors may last longer than a block.
_JACKKNIFE_BLOCKS = (8, 16, 32)
# The stated sizes use this multiple of the standard deviation: on another recording of the same
# drive, the jackknife has another value. Measured with fresh draws of 56 simulated drives: a
# multiple of 1 finds 88 % of the errors (clocks 84 %, lengths 80 %), and 1.25 finds 93 % (92 %, 91
# %).
_SIGMA_MARGIN = 1.2
# Number of blocks for the random splits.
_SPLIT_BLOCKS = 32
# Fewest seconds of a recording: two in each block of the coarsest jackknife.
_LEAST_SECONDS = 2 * _JACKKNIFE_BLOCKS[0]

# A shift needs this multiple of the size that the linear evidence predicts, because the stream
# check estimates its noise together with the shift. Measured with fresh draws of 30 simulated
# drives: 1.3 (median) and 1.6 (90 % of the shifts).
_WEIGHT_FACTOR = 1.6
# Smallest stated shift (m or rad). The stream check does not report a shift below its own limit,
# and its estimate of the shift also has an error.
_LEAST_SHIFT = _SIGMA_MARGIN * LIMITS["mount_moved"].note
# Shifts that the stream check must report: time of the shift as a share of the recording, and sign.
_INJECTED = ((0.42, 1.0), (0.58, -1.0))
# If the stream check does not report a shift, its size is multiplied by this factor.
_GROWTH = 1.4
# Largest number of sizes that are tried.
_N_SIZES = 4

# The velocity at a pose is computed from the poses this time (s) before and after.
_VELOCITY_STEP_S = 0.1

# Larger errors (m, rad) are not stated: the residuals are not linear in them.
_LARGEST = np.repeat([10.0, 0.5], 3)

# Columns of the unknowns.
_OF_X = [0, 1, 2, 3, 4, 5]
_TIME_OFFSET = 6
_SCALE = 7


def examine(result: Calibration, snapshot: Snapshot) -> Calibration:
    """Return a result with its :class:`Detectability`, or without it for a short recording.

    Parameters
    ----------
    result : Calibration
    snapshot : Snapshot
        The poses and options of the result.
    """
    if result.measured != "poses" or result.status.failure:
        return result
    pose_pairs = on_clock_of(result, snapshot)
    duration_s = (pose_pairs.stamps_ns[-1] - pose_pairs.stamps_ns[0]) * 1e-9
    if duration_s < _LEAST_SECONDS:
        return result
    return result.with_part("detectability", detectability(result, pose_pairs))


def on_clock_of(result: Calibration, snapshot: Snapshot) -> PosePairs:
    """Return the poses of a result with its time offset and its scale."""
    pose_pairs = snapshot.pose_pairs.child_scaled(result.scale)
    further_s = result.time_offset_s - float(
        snapshot.resolved.config.time_offset
    )
    if not further_s:
        return pose_pairs
    return pose_pairs.child_shifted(further_s)


def detectability(result: Calibration, pose_pairs: PosePairs) -> Detectability:
    """Return the smallest errors that a recording reveals.

    Parameters
    ----------
    result : Calibration
    pose_pairs : PosePairs
        Poses of the recording on one clock, in one unit of length.
    """
    X = result.T_parent_child
    blocks = evidence_of(pose_pairs, X)
    # Besides X, the solve estimates these unknowns.
    estimated = []
    if result.time_offset_sigma_s:
        estimated.append(_TIME_OFFSET)
    if result.scale_sigma:
        estimated.append(_SCALE)
    sigmas, allowance = sigmas_of(result)
    R = se3.rotation_of(X)
    errors = _smallest_errors(
        blocks, [*_OF_X, *estimated], R, sigmas, allowance
    )
    # Time offset and scale also get a size if the solve did not estimate them.
    of_streams = [*_OF_X, _TIME_OFFSET, _SCALE]
    errors_of_streams = _smallest_errors(
        blocks, of_streams, R, sigmas, allowance
    )
    is_known = [
        dof.verdict in _BY_MOTION for dof in result.observability_measured
    ]
    # First sizes of the shifts. They are increased until the stream check reports the shift.
    first_shifts = _first_shifts(blocks, R)
    return Detectability(
        errors=_by_axis(errors[:6], is_known),
        shifts=SizesAtFirstUse(
            partial(_reported_shifts, pose_pairs, X, first_shifts, is_known)
        ),
        time_offset_s=float(errors_of_streams[_TIME_OFFSET]),
        scale=float(errors_of_streams[_SCALE]),
    )


def evidence_of(pose_pairs: PosePairs, X: FloatArray) -> Blocks:
    """Return the evidence by second of a recording on all unknowns, linearised at X (4, 4)."""
    twists = _twists_of_child(pose_pairs)

    def columns_of_streams(pairs: MotionPairs) -> FloatArray:
        return _columns_of_streams(pairs, twists)

    return moved.evidence_by_second(pose_pairs, X, columns_of_streams)[1]


def sigmas_of(result: Calibration) -> tuple[FloatArray, FloatArray]:
    """Return the measured standard deviations (8,) of all unknowns, and the allowance (8,)."""
    # Unknown axes have no finite standard deviation, and get no size.
    measured = np.nan_to_num(result.sigmas_measured, posinf=0.0)
    of_streams = np.zeros(2)
    return np.append(measured, of_streams), np.append(
        result.allowance, of_streams
    )


# Verdicts on axes that the motion determines.
_BY_MOTION = (DofVerdict.OBSERVED, DofVerdict.WEAK)


def _by_axis(sizes: FloatArray, is_known: list[bool]) -> dict[str, float]:
    """Return sizes (6,) by axis; infinite if they are too large or the axis is unknown."""
    is_stated = np.array(is_known) & (sizes < _LARGEST)
    stated = np.where(is_stated, sizes, np.inf)
    return dict(zip(AXES, stated.tolist(), strict=True))


def _twists_of_child(pose_pairs: PosePairs) -> FloatArray:
    """Return velocities (N, 6), m/s and rad/s, of the child sensor in its own frame."""
    stamps_ns = pose_pairs.stamps_ns
    poses = pose_pairs.Ts_cw_c
    step = max(round(_VELOCITY_STEP_S * 1e9 / median(np.diff(stamps_ns))), 1)
    rows = np.arange(len(poses))
    before = np.maximum(rows - step, 0)
    after = np.minimum(rows + step, len(poses) - 1)
    seconds = (stamps_ns[after] - stamps_ns[before]) * 1e-9
    steps = se3.log(se3.inverse(poses[before]) @ poses[after])
    return np.asarray(steps / seconds[:, None])


def _columns_of_streams(pairs: MotionPairs, twists: FloatArray) -> FloatArray:
    """Return the columns (K, 6, 2) of J for errors of the time offset (s) and of the scale.

    ``twists`` (N, 6) are the velocities of the child at all poses.
    """
    Bs_inverse = se3.inverse(pairs.Ts_childi_childj)
    of_time_offset = (
        se3.times(se3.adjoint(Bs_inverse), twists[pairs.i]) - twists[pairs.j]
    )
    of_scale = np.zeros_like(of_time_offset)
    of_scale[:, :3] = se3.translation_of(Bs_inverse)
    return np.stack([of_time_offset, of_scale], axis=2)


def _smallest_errors(
    blocks: Blocks,
    columns: list[int],
    R: FloatArray,
    sigmas: FloatArray,
    allowance: FloatArray,
) -> FloatArray:
    """Return the smallest errors (k,) of k unknowns that nine of ten trials find.

    ``allowance`` (8,) has standard deviations of constant errors. For the other parameters see
    :func:`trials`.
    """
    sigmas, differences = trials(blocks, columns, R, sigmas)
    thresholds = thresholds_of(_SIGMA_MARGIN * sigmas, allowance[columns])
    # A trial finds an error of either sign.
    found_from = np.quantile(
        thresholds + np.abs(differences), FOUND_SHARE, axis=0
    )
    return np.asarray(found_from)


def thresholds_of(sigmas: FloatArray, allowance: FloatArray) -> FloatArray:
    """Return the differences (k,) between halves that contradict errors of k unknowns."""
    return np.asarray(SIGMAS * np.hypot(2.0 * sigmas, allowance))


def trials(
    blocks: Blocks, columns: list[int], R: FloatArray, sigmas: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return standard deviations (k,) of k unknowns, and differences (10, k) of random halves.

    Parameters
    ----------
    blocks : Blocks
        Evidence by second.
    columns : list of int
        Columns of the unknowns; the first six are those of X.
    R : (3, 3) array
        Rotation from the child's axes to the parent's.
    sigmas : (8,) array
        Standard deviations of the unknowns in the result; zero for unknowns that it lacks.
    """
    turn = np.eye(len(columns))
    turn[:3, :3] = R
    turn[3:6, 3:6] = R
    sigmas = sigmas[columns]
    for n_blocks in _JACKKNIFE_BLOCKS:
        if len(blocks.sums) >= 2 * n_blocks:
            covariance = blocks.merged(n_blocks).jackknife(columns)
            sigmas = np.maximum(
                sigmas, np.sqrt(np.diag(turn @ covariance @ turn.T))
            )
    differences = _differences_of_halves(blocks, columns) @ turn.T
    return sigmas, differences


def _differences_of_halves(blocks: Blocks, columns: list[int]) -> FloatArray:
    """Return the differences (10, k) of estimates from random halves of a recording."""
    n_blocks = min(_SPLIT_BLOCKS, len(blocks.sums) // 2)
    sums = blocks.merged(n_blocks).sums
    # Equal recordings always get equal splits.
    rng = np.random.default_rng(0)
    orders = np.array([rng.permutation(n_blocks) for _ in range(_N_TRIALS)])
    used = sums[orders[:, : n_blocks // 2]].sum(axis=1)
    judging = sums[orders[:, n_blocks // 2 :]].sum(axis=1)
    return solve(judging, columns) - solve(used, columns)


def _first_shifts(blocks: Blocks, R: FloatArray) -> FloatArray:
    """Return shifts (6,) in the middle of the recording that the stream check should report.

    Evidence ``[H S]`` without a shift has the score ``S + a H u`` after a shift of size a along the
    unit vector u. The log likelihood ratio is a quadratic function of a. Without noise, S is zero.

    Parameters
    ----------
    blocks : Blocks
        Evidence by second.
    R : (3, 3) array
        Rotation from the child's axes to the parent's.
    """
    of_mount = Blocks(blocks.sums[:, :6, [*_OF_X, -1]])
    half_way = np.array([len(of_mount.sums) // 2])
    evidence = moved.shifts_at(of_mount, half_way)
    if evidence is None:
        return np.full(6, np.inf)
    H = information(evidence)[0]
    evidence[..., -1] = 0.0
    threshold = 2.0 * (moved.SIGNIFICANT - moved.log_ratio(evidence))
    # Columns are the scores of unit shifts along the parent's axes.
    scores = H @ np.kron(np.eye(2), R.T)
    sizes_by_score = np.linalg.solve(H + moved.SHIFT_INFORMATION, scores)
    squares = (scores * sizes_by_score).sum(axis=0)
    # Without motion, a shift along an axis does not change the score, so its size is unlimited.
    sizes = np.full(6, np.inf)
    np.divide(threshold, squares, out=sizes, where=squares > 0.0)
    return np.maximum(_WEIGHT_FACTOR * np.sqrt(sizes), _LEAST_SHIFT)


def _reported_shifts(
    pose_pairs: PosePairs,
    X: FloatArray,
    first: FloatArray,
    is_known: list[bool],
) -> dict[str, float]:
    """Return the smallest shifts that the stream check reports, by axis.

    ``first`` (6,) are the first sizes, and ``is_known`` marks the axes that the motion determines.
    For the other parameters see :func:`_smallest_reported`.
    """
    shifts = first.copy()
    for axis in range(6):
        if is_known[axis]:
            shifts[axis] = _smallest_reported(pose_pairs, X, axis, first[axis])
    return _by_axis(shifts, is_known)


def _smallest_reported(
    pose_pairs: PosePairs, X: FloatArray, axis: int, first: float
) -> float:
    """Return the smallest shift that the stream check reports; infinite if there is none.

    Parameters
    ----------
    pose_pairs : PosePairs
        Poses without a shift.
    X : (4, 4) array
        Extrinsic.
    axis : int
        Axis of the parent, along or about which the child is moved.
    first : float
        First size (m or rad) that is tried.
    """
    size = first
    for _ in range(_N_SIZES):
        if not size < _LARGEST[axis]:
            break
        if all(
            _is_reported(pose_pairs, X, axis, share, sign * size)
            for share, sign in _INJECTED
        ):
            return size
        size *= _GROWTH
    return np.inf


def _is_reported(
    pose_pairs: PosePairs, X: FloatArray, axis: int, share: float, size: float
) -> bool:
    """Return whether the stream check reports a shift after a share of the recording."""
    in_parent = np.zeros(6)
    in_parent[axis] = size
    xi = np.kron(np.eye(2), X[:3, :3].T) @ in_parent
    Ts_cw_c = pose_pairs.Ts_cw_c.copy()
    since = round(share * len(pose_pairs))
    Ts_cw_c[since:] = Ts_cw_c[since:] @ se3.exp(xi)
    moved_pairs = replace(pose_pairs, Ts_cw_c=Ts_cw_c)
    motions = pairs_over(moved_pairs, LAGS_S[0], MAX_MOTIONS)
    if len(motions) < MIN_PAIRS:
        return False
    speed_m_s = usual_speed(
        pose_pairs.stamps_ns, se3.translation_of(pose_pairs.Ts_pw_p)
    )
    # A fit to all motions is between both mounts.
    between = X @ se3.exp(xi / 2.0)
    for suspect in slow_suspects(moved_pairs, motions, between, speed_m_s):
        if suspect.finding and suspect.finding.key == "mount_moved":
            return True
    return False
