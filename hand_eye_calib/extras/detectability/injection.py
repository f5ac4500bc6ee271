"""Injection of errors into a recording, judged by the part of the recording that was not used.

Motions of about a second have residuals ``e = -J x + noise``. The unknowns x are the error xi of
X in ``X exp(xi)``, an error of the time offset, and a relative error of the scale. The evidence
``[H S]`` of each second adds (:mod:`hand_eye_calib.core.base.blocks`).

*Errors of the result.* The blocks are split at random into two halves. One half estimates x; the
other half is the judge, with its own estimate. Their difference is d. An error of size a in an
unknown changes the difference to ``d + a`` or ``d - a``. The judge contradicts the error if

    |d +- a| > 3 sqrt((2 s)^2 + allowance^2).

s is the standard deviation of the whole recording, so the difference of two halves has 2 s. It is
the block jackknife (H. Kuensch, *The jackknife and the bootstrap for general stationary
observations*, 1989): the scatter that the blocks really have, not the sigma of the result. The
noise model of the result is not used. So the smallest error that is found in nine of ten trials
also tests this sigma. A constant error of an odometry is the same in both halves; the allowance
stands for it.

*Shifts of the mount.* The child's poses after a time in the middle are moved by ``exp(a u)``: a
shift of size a along the unit vector u. The judge is the likelihood ratio of the stream checks
(:mod:`hand_eye_calib.core.assessment.moved`). Both injections are linear in the evidence, so
nothing is solved again.
"""

import numpy as np

from hand_eye_calib.core.assessment import moved
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks, information, score
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import AXES, DofVerdict
from hand_eye_calib.extras.detectability.record import FOUND_SHARE, SIGMAS, Detectability

# Number of random splits, and of times of a shift.
_N_TRIALS = 10
# Numbers of blocks of the jackknife; the largest standard deviation counts, because errors may
# last longer than a block.
_JACKKNIFE_BLOCKS = (8, 16, 32)
# Number of blocks that are split into halves.
_SPLIT_BLOCKS = 32
# Fewest seconds of a recording: two in each of the fewest blocks of the jackknife.
_LEAST_SECONDS = 2 * _JACKKNIFE_BLOCKS[0]

# Times of a shift of the mount, as shares of the recording.
_MIDDLE = (0.35, 0.65)

# The smallest shifts are multiplied by this factor, because a shift has less weight in the stream
# check than in the linear evidence: the check estimates its noise anew, with the shift. Share of
# shifts of the stated size that the check found in fresh draws of 30 simulated drives: 68 % with a
# factor of 1.5, 91 % with 2, 93 % with 2.5.
_WEIGHT_FACTOR = 2.0

# Size (m or rad) that stands for an unlimited one, because quantiles need finite numbers.
_UNLIMITED = 1e12

# Time (s) between a pose and those that its velocity is the difference of.
_VELOCITY_STEP_S = 0.1

# Larger errors (m, rad) are not stated, because the residuals are not linear in them.
_LARGEST = np.repeat([10.0, 0.5], 3)

# Columns of the unknowns.
_OF_X = [0, 1, 2, 3, 4, 5]
_TIME_OFFSET = 6
_SCALE = 7


def examine(result: Calibration, snapshot: Snapshot) -> Calibration:
    """Return a result with its :class:`Detectability`; without it if the recording is short.

    Parameters
    ----------
    result : Calibration
    snapshot : Snapshot
        The poses and options of the result.
    """
    if result.measured != "poses" or result.status.failure:
        return result
    pose_pairs = _on_clock_of(result, snapshot)
    duration_s = (pose_pairs.stamps_ns[-1] - pose_pairs.stamps_ns[0]) * 1e-9
    if duration_s < _LEAST_SECONDS:
        return result
    return result.with_part("detectability", detectability(result, pose_pairs))


def _on_clock_of(result: Calibration, snapshot: Snapshot) -> PosePairs:
    """Return the poses of a result with its time offset and its scale."""
    pose_pairs = snapshot.pose_pairs.child_scaled(result.scale)
    further_s = result.time_offset_s - float(snapshot.resolved.config.time_offset)
    if not further_s:
        return pose_pairs
    return pose_pairs.child_shifted(further_s)


def detectability(result: Calibration, pose_pairs: PosePairs) -> Detectability:
    """Return the smallest errors that a recording contradicts.

    Parameters
    ----------
    result : Calibration
    pose_pairs : PosePairs
        Its poses on one clock, in one unit of length.
    """
    X = result.T_parent_child

    def columns_of_streams(pairs: MotionPairs) -> FloatArray:
        return _columns_of_streams(pairs, pose_pairs)

    _, blocks = moved.evidence_by_second(pose_pairs, X, columns_of_streams)
    # The solve estimates X together with these unknowns.
    estimated = []
    if result.time_offset_sigma_s:
        estimated.append(_TIME_OFFSET)
    if result.scale_sigma:
        estimated.append(_SCALE)
    allowance = np.concatenate([result.allowance, np.zeros(2)])
    R = se3.rotation_of(X)
    errors = _smallest_errors(blocks, [*_OF_X, *estimated], R, allowance)
    errors_of_streams = _smallest_errors(blocks, [*_OF_X, _TIME_OFFSET, _SCALE], R, allowance)
    is_known = [dof.verdict in _BY_MOTION for dof in result.observability_measured]
    return Detectability(
        errors=_by_axis(errors[:6], is_known),
        shifts=_by_axis(_smallest_shifts(blocks, R), is_known),
        time_offset_s=float(errors_of_streams[_TIME_OFFSET]),
        scale=float(errors_of_streams[_SCALE]),
    )


# Verdicts on axes that the motion determines.
_BY_MOTION = (DofVerdict.OBSERVED, DofVerdict.WEAK)


def _by_axis(sizes: FloatArray, is_known: list[bool]) -> dict[str, float]:
    """Return sizes (6,) by axis; infinite if they are too large or the axis is unknown."""
    is_stated = np.array(is_known) & (sizes < _LARGEST)
    return dict(zip(AXES, np.where(is_stated, sizes, np.inf).tolist(), strict=True))


def _columns_of_streams(pairs: MotionPairs, pose_pairs: PosePairs) -> FloatArray:
    """Return the columns (K, 6, 2) of J for errors of the time offset (s) and of the scale."""
    stamps_ns = pose_pairs.stamps_ns
    poses = pose_pairs.Ts_cw_c
    step = max(round(_VELOCITY_STEP_S * 1e9 / median(np.diff(stamps_ns))), 1)
    rows = np.arange(len(poses))
    before = np.maximum(rows - step, 0)
    after = np.minimum(rows + step, len(poses) - 1)
    seconds = (stamps_ns[after] - stamps_ns[before]) * 1e-9
    twists = se3.log(se3.inverse(poses[before]) @ poses[after]) / seconds[:, None]
    Bs_inverse = se3.inverse(pairs.Ts_childi_childj)
    of_time_offset = se3.times(se3.adjoint(Bs_inverse), twists[pairs.i]) - twists[pairs.j]
    of_scale = np.zeros_like(of_time_offset)
    of_scale[:, :3] = se3.translation_of(Bs_inverse)
    return np.stack([of_time_offset, of_scale], axis=2)


def _smallest_errors(
    blocks: Blocks, columns: list[int], R: FloatArray, allowance: FloatArray
) -> FloatArray:
    """Return the smallest errors (k,) of k unknowns that nine of ten trials find.

    Parameters
    ----------
    blocks : Blocks
        Evidence by second.
    columns : list of int
        Columns of the unknowns; the first six are those of X.
    R : (3, 3) array
        Rotation from the child's axes to the parent's.
    allowance : (8,) array
        Standard deviations of constant errors.
    """
    turn = np.eye(len(columns))
    turn[:3, :3] = R
    turn[3:6, 3:6] = R
    sigmas = np.zeros(len(columns))
    for n_blocks in _JACKKNIFE_BLOCKS:
        if len(blocks.sums) >= 2 * n_blocks:
            covariance = blocks.merged(n_blocks).jackknife(columns)
            sigmas = np.maximum(sigmas, np.sqrt(np.diag(turn @ covariance @ turn.T)))
    differences = _differences_of_halves(blocks, columns) @ turn.T
    thresholds = SIGMAS * np.hypot(2.0 * sigmas, allowance[columns])
    # A trial finds an error of either sign.
    found_from = np.quantile(thresholds + np.abs(differences), FOUND_SHARE, axis=0)
    return np.asarray(found_from)


def _differences_of_halves(blocks: Blocks, columns: list[int]) -> FloatArray:
    """Return the differences (10, k) of estimates from random halves of a recording."""
    n_blocks = min(_SPLIT_BLOCKS, len(blocks.sums) // 2)
    sums = blocks.merged(n_blocks).sums
    # The same recording always has the same splits.
    rng = np.random.default_rng(0)
    differences = []
    for _ in range(_N_TRIALS):
        order = rng.permutation(n_blocks)
        used = Blocks(sums[order[: n_blocks // 2]])
        judging = Blocks(sums[order[n_blocks // 2 :]])
        differences.append(judging.solve(columns) - used.solve(columns))
    return np.array(differences)


def _smallest_shifts(blocks: Blocks, R: FloatArray) -> FloatArray:
    """Return the smallest shifts (6,) of the mount that nine of ten trials find.

    A trial is a shift at one of ten times in the middle of the recording, of either sign. Evidence
    ``[H S]`` without a shift has the score ``S + a H u`` after a shift of size a along the unit
    vector u. The log likelihood ratio is a quadratic function of a. The smallest size is the root a
    at which the ratio reaches ``moved.SIGNIFICANT``.

    Parameters
    ----------
    blocks : Blocks
        Evidence by second.
    R : (3, 3) array
        Rotation from the child's axes to the parent's.
    """
    of_mount = Blocks(blocks.sums[:, :6, [*_OF_X, -1]])
    n_seconds = len(of_mount.sums)
    cuts = np.linspace(*_MIDDLE, _N_TRIALS) * n_seconds
    evidence = moved.shifts_at(of_mount, cuts.astype(int))
    if evidence is None:
        return np.full(6, np.inf)
    H = information(evidence)
    S = score(evidence)
    threshold = 2.0 * (moved.SIGNIFICANT - moved.log_ratio(evidence))
    covariances = np.linalg.inv(H + moved.SHIFT_INFORMATION)
    to_child = np.kron(np.eye(2), R.T)
    # (10, 6, 6): columns are the scores of unit shifts along the parent's axes.
    scores = H @ to_child
    weighted = covariances @ scores
    squares = (scores * weighted).sum(axis=1)
    mixed = (S[:, :, None] * weighted).sum(axis=1)
    # squares a^2 +- 2 mixed a = threshold
    roots = np.sqrt(np.maximum(mixed**2 + squares * threshold[:, None], 0.0))
    numerators = np.concatenate([roots - mixed, roots + mixed])
    denominators = np.concatenate([squares, squares])
    # Without motion, no shift along an axis changes the score: its size is unlimited.
    sizes = np.full_like(numerators, _UNLIMITED)
    np.divide(numerators, denominators, out=sizes, where=denominators > 0.0)
    sizes = np.clip(sizes, 0.0, _UNLIMITED)
    found = np.quantile(sizes, FOUND_SHARE, axis=0)
    # The quantile is interpolated between two sizes. Above this limit, one of them is unlimited.
    is_limited = found < _UNLIMITED / len(sizes)
    return np.where(is_limited, _WEIGHT_FACTOR * found, np.inf)
