"""Detect streams that contain motions instead of poses, or positions in other axes.

Except :func:`check_earth_centred`, these checks run if no usual mistake explains the streams.
Functions here examine the child; for the parent, the streams are exchanged.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.alignment.similarity import fit_similarity
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import robust_regression
from hand_eye_calib.core.checks.findings import Finding, finding
from hand_eye_calib.core.checks.hypothesis import HOLDS
from hand_eye_calib.core.checks.stream_pair import LAGS_S, MAX_PAIRS, StreamPair
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import are_earth_centred

# A stream may contain motions from pose to pose if all its orientations are below this angle (rad).
_MAX_MOTION_RAD = 1.0

# Smallest reported rotation (rad) between the axes of positions and orientations. Smaller rotations
# are for :func:`agreement.check_agreement`.
_MIN_TURN_RAD = 0.05

# Number of reweighted rounds in the fit of rotated positions.
_ROUNDS = 5
# Residual (m) of this fit at which Huber weights begin to fall.
_RESIDUAL_UNIT_M = 1e-3


class _TurnedPositions(NamedTuple):
    """Positions of a stream in other axes than its orientations.

    Attributes
    ----------
    stream : str
        "parent" or "child".
    rotation : (3, 3) array
        Rotation from the axes of the positions to those of the orientations.
    unexplained : float
        Share of the motion that the rotated positions leave unexplained.
    are_earth_centred : bool
        Whether the distances from the origin are about the radius of the earth.
    """

    stream: str
    rotation: FloatArray
    unexplained: float
    are_earth_centred: bool


def check_misread(streams: StreamPair, aligned: StreamPair) -> list[Finding]:
    """Return the finding about a misread stream, or none if no misreading explains the streams.

    Parameters
    ----------
    streams : StreamPair
        Streams that no usual mistake explains.
    aligned : StreamPair
        The same streams at the offset with the best correlation of their angular rates.
    """
    for name, pair in _by_examined_stream(streams).items():
        if _are_motions(pair):
            return [finding("motions", name)]
    return _check_turned(_by_examined_stream(aligned))


def check_earth_centred(aligned: StreamPair) -> list[Finding]:
    """Return the finding about earth-centred positions in other axes, or none.

    This check runs before usual mistakes are tried: the long distance from the origin would be a
    lever arm of inverse poses, and would explain nearly any motion.
    """
    pairs = _by_examined_stream(aligned)
    earth_centred = {}
    for name, pair in pairs.items():
        if are_earth_centred(se3.translation_of(pair.child.poses)):
            earth_centred[name] = pair
    return _check_turned(earth_centred)


def _by_examined_stream(streams: StreamPair) -> dict[str, StreamPair]:
    """Return two pairs by the name of the examined stream, which is the child of the pair."""
    exchanged = replace(streams, parent=streams.child, child=streams.parent)
    return {"child": streams, "parent": exchanged}


def _check_turned(pairs: Mapping[str, StreamPair]) -> list[Finding]:
    """Return the finding that positions are in other axes than the orientations, or none.

    ``pairs`` are pairs by the name of the examined stream. On a plane, both streams may explain the
    motion; the better explanation is used.
    """
    turned = [_find_turn(name, pair) for name, pair in pairs.items()]
    best = min(
        filter(None, turned), key=lambda turn: turn.unexplained, default=None
    )
    if best is None:
        return []
    angle_rad = float(se3.rotation_angle(best.rotation))
    if angle_rad < _MIN_TURN_RAD:
        return []
    turned_deg = float(np.degrees(angle_rad))
    if best.are_earth_centred:
        return [finding("earth_centred", best.stream, turned_deg=turned_deg)]
    # A rotation by right angles exchanges axes or reverses them.
    exchange = np.round(best.rotation)
    if np.abs(best.rotation - exchange).max() < _MIN_TURN_RAD:
        axes = " ".join(map(_axis_in_words, exchange))
        return [finding("axes", best.stream, detail=axes)]
    return [finding("positions_turned", best.stream, turned_deg=turned_deg)]


def _axis_in_words(row: FloatArray) -> str:
    """Return the axis, such as -x, that a row (3,) of a rotation by right angles selects."""
    column = int(np.argmax(np.abs(row)))
    sign = "-" if row[column] < 0 else ""
    return f"{sign}{'xyz'[column]}"


def _are_motions(streams: StreamPair) -> bool:
    """Return whether the child's poses are motions from pose to pose, or their inverses."""
    child = streams.child
    if len(child) < 2:
        return False
    if se3.rotation_angle(se3.rotation_of(child.poses)).max() > _MAX_MOTION_RAD:
        return False
    motions = child.poses[1:]
    for steps in (motions, se3.inverse(motions)):
        chained = replace(child, poses=se3.chained(steps))
        if _unexplained(replace(streams, child=chained)) < HOLDS:
            return True
    return False


def _unexplained(streams: StreamPair) -> float:
    """Return the smallest unexplained share of the motion over all lags (0 to 1)."""
    shares = [1.0]
    for lag_s in LAGS_S:
        with suppress(NotEnoughDataError):
            shares.append(
                fit_similarity(streams.pairs(lag_s, MAX_PAIRS)).unexplained
            )
    return min(shares)


def _find_turn(name: str, streams: StreamPair) -> _TurnedPositions | None:
    """Fit a rotation of the child's positions; return None if none explains the streams.

    ``name`` is the name of the examined stream, the child of the pair.
    """
    child = streams.child
    for lag_s in LAGS_S:
        try:
            rotation = _fit_turn(streams, lag_s)
        except (NotEnoughDataError, np.linalg.LinAlgError):
            continue
        positions = se3.translation_of(child.poses)
        turned = positions @ rotation.T
        poses = se3.from_rotation_translation(
            se3.rotation_of(child.poses), turned
        )
        unexplained = _unexplained(
            replace(streams, child=replace(child, poses=poses))
        )
        if unexplained < HOLDS:
            return _TurnedPositions(
                name, rotation, unexplained, are_earth_centred(positions)
            )
    return None


def _fit_turn(streams: StreamPair, lag_s: float) -> FloatArray:
    """Return the rotation W (3, 3) from the axes of the child's positions to its orientations.

    Robust least squares of ``R_X R_ci' W d = (R_A - I) t_X + t_A`` over one lag. d is the
    displacement of the child and R_ci its first orientation. (R_A, t_A) is the motion of the
    parent, and t_X is the lever arm.
    """
    pairs = streams.pairs(lag_s, MAX_PAIRS)
    poses = streams.synchronised
    parent_vectors = se3.rotation_log(se3.rotation_of(pairs.Ts_parenti_parentj))
    child_vectors = se3.rotation_log(se3.rotation_of(pairs.Ts_childi_childj))
    R_X = se3.nearest_rotation(parent_vectors.T @ child_vectors)
    displacements = (
        poses.Ts_cw_c[pairs.j, :3, 3] - poses.Ts_cw_c[pairs.i, :3, 3]
    )
    to_parent = R_X @ np.swapaxes(poses.Ts_cw_c[pairs.i, :3, :3], 1, 2)
    # Derivatives with respect to the elements of W, row by row: (K, 3, 3, 3) to (K, 3, 9).
    of_W = np.einsum("kab,kc->kabc", to_parent, displacements).reshape(
        len(pairs), 3, 9
    )
    of_lever_arm = -(se3.rotation_of(pairs.Ts_parenti_parentj) - np.eye(3))
    rows = np.concatenate([of_W, of_lever_arm], axis=2)
    target = se3.translation_of(pairs.Ts_parenti_parentj)
    unknowns, _ = robust_regression(
        "huber", rows, target, _ROUNDS, lambda _: _RESIDUAL_UNIT_M
    )
    return se3.nearest_rotation(unknowns[:9].reshape(3, 3))
