"""Detection of streams with motions instead of poses, or with positions in other axes.

These checks run if no usual mistake explains the streams.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.alignment.similarity import fit_similarity
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import robust_regression
from hand_eye_calib.core.checks.findings import Finding, finding
from hand_eye_calib.core.checks.hypotheses import HOLDS
from hand_eye_calib.core.checks.stream_pair import LAGS_S, MAX_PAIRS, StreamPair
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs

# Largest rotation (rad) between two poses. A stream of poses that rotates less hardly moves.
_MOST_TURN_RAD = 1.0

# Smallest rotation (rad) between the axes of positions and orientations. Smaller ones are left to
# :func:`agreement.check_coordinates`.
_LEAST_TURN_RAD = 0.05

# Smallest and largest distance (m) of ground and aircraft from the centre of the earth.
_EARTH_M = (6.3e6, 6.45e6)

# Rounds of robust weights in the fit of turned positions.
_ROUNDS = 5
# Smallest scale (m) of the residuals in this fit.
_LEAST_RESIDUAL_M = 1e-3


def misreadings(streams: StreamPair, aligned: StreamPair) -> list[Finding]:
    """Return the finding about a misread stream, or none if no misreading explains both streams.

    Parameters
    ----------
    streams : StreamPair
        Streams that no usual mistake explains, with the known clock offset.
    aligned : StreamPair
        The same streams at the offset with the best correlation of their angular rates.
    """
    for stream, given in _both_ways(streams):
        if _are_motions(given.child, given):
            return [finding("motions", stream)]
    return _turned_positions(_both_ways(aligned))


def earth_centred(aligned: StreamPair) -> list[Finding]:
    """Return the finding about positions from the centre of the earth in other axes, or none.

    This check runs first: such a long lever arm explains nearly any motion of inverse poses.
    """
    ways = _both_ways(aligned)
    return _turned_positions([way for way in ways if _is_earth_centred(way[1].child)])


def _both_ways(streams: StreamPair) -> list[tuple[str, StreamPair]]:
    """Return the streams as they are and exchanged, each with the name of the second stream."""
    swapped = replace(streams, parent=streams.child, child=streams.parent)
    return [("child", streams), ("parent", swapped)]


def _turned_positions(ways: Sequence[tuple[str, StreamPair]]) -> list[Finding]:
    """Return the finding about positions in other axes than the orientations, or none.

    Motion in a plane may be explained by either stream; the better explanation counts.
    """
    turns = [(stream, streams, _turn_of_positions(streams)) for stream, streams in ways]
    explained = [
        (turn.unexplained, stream, streams, turn.rotation)
        for stream, streams, turn in turns
        if turn
    ]
    if not explained:
        return []
    _, stream, streams, rotation = min(explained, key=lambda way: way[0])
    angle_rad = float(se3.rotation_angle(rotation))
    if angle_rad < _LEAST_TURN_RAD:
        return []
    values = {"turned_deg": float(np.degrees(angle_rad))}
    if _is_earth_centred(streams.child):
        return [finding("earth_centred", stream, None, None, **values)]
    exchanged = np.round(rotation)
    if np.abs(rotation - exchanged).max() < _LEAST_TURN_RAD:
        return [finding("axes", stream, detail=" ".join(map(_axis_in_words, exchanged)))]
    return [finding("positions_turned", stream, None, None, **values)]


def _axis_in_words(row: FloatArray) -> str:
    """Return the axis of the file, such as -x, that a row of a rotation by right angles takes."""
    column = int(np.argmax(np.abs(row)))
    sign = "-" if row[column] < 0 else ""
    return f"{sign}{'xyz'[column]}"


def _are_motions(child: Trajectory, streams: StreamPair) -> bool:
    """Return whether the child's poses are motions from pose to pose, or their inverses."""
    if len(child) < 2 or se3.rotation_angle(se3.rotation_of(child.poses)).max() > _MOST_TURN_RAD:
        return False
    ways = (child.poses[1:], se3.inverse(child.poses[1:]))
    chains = (replace(child, poses=se3.chained(steps)) for steps in ways)
    return any(_unexplained(replace(streams, child=chain)) < HOLDS for chain in chains)


def _unexplained(streams: StreamPair) -> float:
    """Return the smallest unexplained share of the motion over all lags."""
    shares = [1.0]
    for lag_s in LAGS_S:
        with suppress(NotEnoughDataError):
            shares.append(fit_similarity(streams.pairs(lag_s, MAX_PAIRS)).unexplained)
    return min(shares)


class _Turn(NamedTuple):
    """A rotation (3, 3) of positions, and the share of the motion that stays unexplained."""

    rotation: FloatArray
    unexplained: float


def _turn_of_positions(streams: StreamPair) -> _Turn | None:
    """Return the rotation from the axes of the child's positions to those of its orientations.

    None if no rotation explains the streams.
    """
    child = streams.child
    for lag_s in LAGS_S:
        try:
            rotation = _fitted_turn(streams, lag_s)
        except (NotEnoughDataError, np.linalg.LinAlgError):
            continue
        positions = se3.translation_of(child.poses) @ rotation.T
        poses = se3.from_rotation_translation(se3.rotation_of(child.poses), positions)
        unexplained = _unexplained(replace(streams, child=replace(child, poses=poses)))
        if unexplained < HOLDS:
            return _Turn(rotation, unexplained)
    return None


def _is_earth_centred(stream: Trajectory) -> bool:
    """Return whether all positions are as far from the origin as places on the earth."""
    distances = np.linalg.norm(se3.translation_of(stream.poses), axis=1)
    least, most = _EARTH_M
    return bool(((distances > least) & (distances < most)).all())


def _fitted_turn(streams: StreamPair, lag_s: float) -> FloatArray:
    """Return the rotation W (3, 3) from the axes of the child's positions to its orientations.

    Robust least squares of ``R_X R_ci' W d = (R_A - I) t_X + t_A`` for displacements d over a lag.
    """
    pairs = streams.pairs(lag_s, MAX_PAIRS)
    poses: PosePairs = streams.synchronised
    R_X = _rotation_between(
        se3.rotation_log(se3.rotation_of(pairs.Ts_parenti_parentj)),
        se3.rotation_log(se3.rotation_of(pairs.Ts_childi_childj)),
    )
    displacements = poses.Ts_cw_c[pairs.j, :3, 3] - poses.Ts_cw_c[pairs.i, :3, 3]
    to_parent = R_X @ np.swapaxes(poses.Ts_cw_c[pairs.i, :3, :3], 1, 2)
    # Columns of W row by row: (K, 3, 3, 3) to (K, 3, 9).
    of_turn = np.einsum("kab,kc->kabc", to_parent, displacements).reshape(len(pairs), 3, 9)
    of_lever = -(se3.rotation_of(pairs.Ts_parenti_parentj) - np.eye(3))
    rows = np.concatenate([of_turn, of_lever], axis=2)
    target = se3.translation_of(pairs.Ts_parenti_parentj)
    unknowns, _ = robust_regression("huber", rows, target, _ROUNDS, lambda _: _LEAST_RESIDUAL_M)
    return se3.nearest_rotation(unknowns[:9].reshape(3, 3))


def _rotation_between(parent: FloatArray, child: FloatArray) -> FloatArray:
    """Return the rotation R_X with ``parent = R_X child`` for rotation vectors (K, 3)."""
    return se3.nearest_rotation(parent.T @ child)
