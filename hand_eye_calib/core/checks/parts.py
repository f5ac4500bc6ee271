"""Checks whether one extrinsic fits all parts of a recording.

If a stream restarts with other axes, or if the streams are exchanged, each part of the recording is
sound. A robust solve follows the larger part, and rejects the other part as outliers.
"""

from dataclasses import replace

import numpy as np

from hand_eye_calib.core.alignment.similarity import (
    SimilarityFit,
    fit_similarity,
)
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.blocks import Blocks
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import median, quantile
from hand_eye_calib.core.base.text import angle
from hand_eye_calib.core.checks.agreement import MAX_SHORT_MOTIONS, SHORT_S
from hand_eye_calib.core.checks.findings import Finding, finding
from hand_eye_calib.core.checks.stream_pair import MAX_ROTATION_RAD, MIN_PAIRS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    pairs_over,
)
from hand_eye_calib.core.solvers.all_pairs import align_rotation_vectors

# A recording is split in two parts after each of these shares of its poses.
_SPLITS = (0.5, 0.25, 0.75)
# A part is sound if its own extrinsic rotation leaves at most this share of its rotations
# unexplained.
_SOUND_PART = 0.25
# Two parts differ if the extrinsic rotation of one part leaves more than this share of the other
# part's rotations unexplained.
_OTHER_PART = 0.5

# Number of blocks of time. An exchange of the streams is tested at the start of each block but the
# first.
_EXCHANGE_BLOCKS = 16
# Number of blocks, at the start and at the end of a recording, whose own extrinsics are tried.
_END_BLOCKS = 4
# Largest number of motions from which such an extrinsic is estimated.
_MAX_MOTIONS_OF_END = 300
# Motions shorter than this share of the median displacement are skipped: at rest, every extrinsic
# fits.
_MOVING_SHARE = 0.3
# A part has another extrinsic if the extrinsic of the rest leaves more than this share of the
# displacements of the part unexplained ...
_OTHER_SHARE = 0.25
# ... and if this share exceeds the unexplained share of the rest by at least this factor.
_OTHER_FACTOR = 3.0
# An extrinsic explains a part if it leaves at most this share of its displacements unexplained.
_EXPLAINED_SHARE = _OTHER_SHARE / _OTHER_FACTOR

# Quantile of the residuals that is compared. It must lie in the smaller part.
_EXCHANGE_QUANTILE = 0.85
# The streams were exchanged if this quantile becomes less than this share of its former value when
# the exchange is undone.
_EXCHANGE_GAIN = 0.4


def check_turned_parts(pose_pairs: PosePairs) -> list[Finding]:
    """Return the finding that two parts have different extrinsic rotations, or none.

    A restart of a stream with other axes, and an exchange of the streams, leave two sound parts.
    The noise model follows one part and rejects the other part as outliers.
    """
    motions = pairs_over(pose_pairs, SHORT_S, MAX_SHORT_MOTIONS)
    angles = se3.rotation_angle(se3.rotation_of(motions.Ts_parenti_parentj))
    motions = motions[angles < MAX_ROTATION_RAD]
    if exchanged := _check_exchanged(motions, pose_pairs.stamps_ns):
        return [exchanged]
    for share in _SPLITS:
        split = int(share * len(pose_pairs))
        parts = (motions[motions.j < split], motions[motions.i >= split])
        if min(map(len, parts)) < MIN_PAIRS:
            continue
        second = _rotation_of_part(parts[1])
        if _unexplained(parts[0], second) <= _OTHER_PART:
            # One extrinsic explains both parts, as in most recordings.
            continue
        first = _rotation_of_part(parts[0])
        # Shares that the rotation of the same part, or of the other part, leaves unexplained.
        by_own = max(
            _unexplained(parts[0], first), _unexplained(parts[1], second)
        )
        by_other = min(
            _unexplained(parts[0], second), _unexplained(parts[1], first)
        )
        if by_own >= _SOUND_PART or by_other <= max(_OTHER_PART, 3.0 * by_own):
            continue
        at_s = _seconds_at(pose_pairs.stamps_ns, split)
        if _unexplained(parts[1], se3.inverse(first)) < _SOUND_PART:
            return [finding("exchanged", at_s=at_s)]
        return [_parts_turned(first, second, at_s)]
    return []


def _rotation_of_part(motions: MotionPairs) -> FloatArray:
    """Return an extrinsic (4, 4) with the rotation of a part, and translation zero."""
    rotation = align_rotation_vectors(motions)
    return se3.from_rotation_translation(rotation, np.zeros(3))


def check_other_extrinsic(
    pose_pairs: PosePairs, X: FloatArray
) -> list[Finding]:
    """Return the finding that a part of a recording has another extrinsic, or none.

    On flat ground, one extrinsic rotation may explain both parts: before and after an exchange of
    the streams, or a restart with another heading. Only the displacements then differ.

    Parameters
    ----------
    pose_pairs : PosePairs
        Poses on one clock, in one unit of length.
    X : (4, 4) array
        Extrinsic of the whole recording.
    """
    motions = pairs_over(pose_pairs, SHORT_S, MAX_SHORT_MOTIONS)
    lengths_m = np.linalg.norm(
        se3.translation_of(motions.Ts_parenti_parentj), axis=1
    )
    motions = motions[lengths_m > _MOVING_SHARE * median(lengths_m)]
    if len(motions) < MIN_PAIRS:
        return []
    shares = _unexplained_path(motions, X)
    block_of = motions.i * _EXCHANGE_BLOCKS // len(pose_pairs)
    # If X explains all blocks, there is no part with another extrinsic.
    is_one_part = max(_usual_shares(shares, block_of)) < _EXPLAINED_SHARE
    if is_one_part or (shares < _OTHER_SHARE).all():
        return []
    ends = (block_of < _END_BLOCKS, block_of >= _EXCHANGE_BLOCKS - _END_BLOCKS)
    fits = [_own_fit(motions[is_end]) for is_end in ends]
    for candidate in (X, *(fit.T_parent_child for fit in fits if fit)):
        cut, is_other = _other_part(
            _unexplained_path(motions, candidate), block_of
        )
        own = _own_fit(motions[is_other]) if is_other.any() else None
        if own is None:
            continue
        row = cut * len(pose_pairs) // _EXCHANGE_BLOCKS
        at_s = _seconds_at(pose_pairs.stamps_ns, row)
        exchanged = _exchanged(motions[is_other])
        if median(_unexplained_path(exchanged, candidate)) < _EXPLAINED_SHARE:
            return [finding("exchanged", at_s=at_s)]
        return [_parts_turned(candidate, own.T_parent_child, at_s)]
    return []


def _seconds_at(stamps_ns: IntArray, row: int) -> float:
    """Return the time (s) from the first pose to the pose of a row."""
    return float(stamps_ns[row] - stamps_ns[0]) * 1e-9


def _parts_turned(
    first: FloatArray, second: FloatArray, at_s: float
) -> Finding:
    """Return the finding that two extrinsics (4, 4) of parts have different rotations."""
    between = se3.rotation_of(first).T @ se3.rotation_of(second)
    turned_rad = float(se3.rotation_angle(between))
    return finding(
        "parts_turned", size=angle(turned_rad), at_s=at_s, turned_rad=turned_rad
    )


def _exchanged(motions: MotionPairs) -> MotionPairs:
    """Return motion pairs with parent and child exchanged."""
    return replace(
        motions,
        Ts_parenti_parentj=motions.Ts_childi_childj,
        Ts_childi_childj=motions.Ts_parenti_parentj,
    )


def _unexplained_path(motions: MotionPairs, X: FloatArray) -> FloatArray:
    """Return the share (K,) of each displacement that an extrinsic X (4, 4) leaves unexplained."""
    residuals_m = motions.translation_residuals(X)
    lengths_m = np.linalg.norm(
        se3.translation_of(motions.Ts_parenti_parentj), axis=1
    )
    return np.asarray(
        np.linalg.norm(residuals_m, axis=1) / np.maximum(lengths_m, 1e-12)
    )


def _own_fit(motions: MotionPairs) -> SimilarityFit | None:
    """Return the fit to the motions of a part, or None if no extrinsic fits."""
    # Division rounded up.
    stride = -(-len(motions) // _MAX_MOTIONS_OF_END) or 1
    try:
        fit = fit_similarity(motions[::stride], same_unit=True)
    except NotEnoughDataError:
        return None
    is_sound = (
        median(_unexplained_path(motions, fit.T_parent_child))
        < _EXPLAINED_SHARE
    )
    return fit if is_sound else None


def _usual_shares(shares: FloatArray, block_of: IntArray) -> FloatArray:
    """Return the median share of the motions of each block that has motions."""
    blocks = np.unique(block_of)
    return np.array([median(shares[block_of == block]) for block in blocks])


def _other_part(
    shares: FloatArray, block_of: IntArray
) -> tuple[int, BoolArray]:
    """Return the block at which another part begins or ends, and a mask (K,) of the other part.

    ``shares`` (K,) are the unexplained shares of the motions, and ``block_of`` (K,) the blocks of
    the motions. The mask is empty if no part differs clearly.
    """
    blocks = np.unique(block_of)
    usual = _usual_shares(shares, block_of)
    best = _OTHER_FACTOR
    cut = 0
    is_other = np.zeros(len(shares), dtype=bool)
    # The block at the cut is skipped, because it contains motions of both parts.
    for k in range(1, len(blocks) - 1):
        before = usual[:k]
        after = usual[k + 1 :]
        for other, own, is_side in (
            (before, after, block_of < blocks[k]),
            (after, before, block_of > blocks[k]),
        ):
            factor = other.min() / max(own.max(), 1e-12)
            if other.min() > _OTHER_SHARE and factor > best:
                best = factor
                cut = int(blocks[k])
                is_other = is_side
    return cut, is_other


def _check_exchanged(
    motions: MotionPairs, stamps_ns: IntArray
) -> Finding | None:
    """Return the finding that parent and child are exchanged from a certain time on, or None.

    One rotation R maps rotation vectors of the child to rotation vectors of the parent. After an
    exchange, R maps the parent's to the child's. R is estimated for each possible time.
    """
    if len(motions) < MIN_PAIRS:
        return None
    of_parent = se3.rotation_log(se3.rotation_of(motions.Ts_parenti_parentj))
    of_child = se3.rotation_log(se3.rotation_of(motions.Ts_childi_childj))
    block_of = motions.i * _EXCHANGE_BLOCKS // len(stamps_ns)
    products = of_parent[:, :, None] * of_child[:, None, :]
    blocks = Blocks.gathered(products, block_of, _EXCHANGE_BLOCKS)
    cuts = np.arange(1, _EXCHANGE_BLOCKS)
    # An exchange after a cut transposes the products of the later blocks.
    exchanged = blocks.before(cuts) + np.swapaxes(blocks.since(cuts), 1, 2)
    rotations = se3.nearest_rotation(exchanged)
    # The cut whose rotation aligns the vectors best.
    best = int(np.argmax((rotations * exchanged).sum(axis=(1, 2))))
    is_after = (block_of >= cuts[best])[:, None]
    # Vectors of both sensors, with the exchange undone.
    first = np.where(is_after, of_child, of_parent)
    second = np.where(is_after, of_parent, of_child)
    R = se3.nearest_rotation(blocks.total)
    as_given = np.linalg.norm(of_parent - of_child @ R.T, axis=1)
    as_exchanged = np.linalg.norm(first - second @ rotations[best].T, axis=1)
    usual_rad = quantile(as_exchanged, _EXCHANGE_QUANTILE)
    angles = np.linalg.norm(of_parent, axis=1)
    is_sound = usual_rad < _SOUND_PART * quantile(angles, _EXCHANGE_QUANTILE)
    if not is_sound or usual_rad > _EXCHANGE_GAIN * quantile(
        as_given, _EXCHANGE_QUANTILE
    ):
        return None
    row = cuts[best] * len(stamps_ns) // _EXCHANGE_BLOCKS
    return finding("exchanged", at_s=_seconds_at(stamps_ns, row))


def _unexplained(motions: MotionPairs, X: FloatArray) -> float:
    """Return the share of the rotations that an extrinsic X (4, 4) leaves unexplained.

    The share is the median residual divided by the median angle. Only the quarter of the motions
    with the largest angles is used.
    """
    angles = se3.rotation_angle(se3.rotation_of(motions.Ts_parenti_parentj))
    are_large = angles >= quantile(angles, 0.75)
    residuals = motions.rotation_residuals(X)
    residual_lengths = np.linalg.norm(residuals[are_large], axis=1)
    return median(residual_lengths) / max(median(angles[are_large]), 1e-12)
