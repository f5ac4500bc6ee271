"""Checks of stops that use rotations only: frozen poses, wrong rows, wrong kinds of angles.

Between two stops, both sensors rotate by the same angle, for any extrinsic. So the matrices (N, N)
of the angles between all stops are equal for parent and child. They differ if the rows do not
belong together, or if Euler angles were read as rotation vectors.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median, medians
from hand_eye_calib.core.checks.agreement import SAME_RAD
from hand_eye_calib.core.checks.findings import Finding, finding
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.rough_fit import (
    MAX_COMPARED,
    MIN_TURN_RAD,
    Mistakes,
    StopPoses,
    above_diagonal,
    angles_between,
    median_difference,
    rough_fit,
)

# Fewest stops that are checked. Four stops have twelve coordinates, to which seven lengths
# (translations of X and Z, scale) are fitted. With fewer than six stops, hardly any hypothesis is
# contradicted.
MIN_STOPS_TO_CHECK = 6

# Another order of rows, or another kind of angles, must reduce the median difference of the angles
# between stops by this factor.
MIN_IMPROVEMENT = 3.0

# Limits of the unexplained share (median residual divided by spread). Measured: 0.015 to 0.07 for
# three real arms (MoveIt, ETHZ, CamOdoCal), 0.01 for simulated arms, 0.5 for sides that do not
# belong together. Below this limit the stops are explained.
SMALL_UNEXPLAINED = 0.04
# Above this limit a hypothesis is wrong.
MAX_UNEXPLAINED = 0.3
# Above this limit both sides do not belong together.
UNRELATED_UNEXPLAINED = 0.5

# A pose is a repetition of the previous pose if they differ by at most this (m, rad), which is
# rounding.
_ROUNDING = 1e-6

# Largest number of rows by which one side is shifted in a test.
_MAX_SHIFT = 3

# The rows from some row on are shifted if this increases the log likelihood per pair of stops by
# more than this limit. Measured on 7 to 30 stops of KinHEC and of simulated arms: at most 0.21
# without a fault, and at least 0.4 in 99 % of the sets with a missing row.
_MIN_BLOCK_GAIN = 0.3

# Several kinds of angles agree equally well if their differences are within this factor of the
# smallest difference.
_MAX_EQUAL_RATIO = 1.5

# For a tool that points down, each stop has a short and a long rotation vector. This is the number
# of stops at which both vectors are tried as a start.
_N_STARTING_STOPS = 3
# Largest number of rounds in which each stop chooses one of its vectors.
_MAX_CHOICE_ROUNDS = 5

# Number of random orders of the rows with which the given order is compared.
_N_RANDOM_ORDERS = 8

_BOTH_WAYS = (("parent", "child"), ("child", "parent"))


def check_frozen(poses: StopPoses) -> Iterator[Finding]:
    """Yield a finding for each side that repeats a pose while the other side rotates."""
    for stream, other in _BOTH_WAYS:
        own = getattr(poses, stream)
        others = se3.rotation_of(getattr(poses, other))
        steps = se3.log(se3.inverse(own[:-1]) @ own[1:])
        is_repeated = np.abs(steps).max(axis=1) < _ROUNDING
        turns_rad = se3.rotation_angle(
            se3.relative_rotations(others[:-1], others[1:])
        )
        share = float(np.mean(is_repeated & (turns_rad > MIN_TURN_RAD)))
        if share == 0.0:
            continue
        is_frozen_throughout = (
            is_repeated.all() and median(turns_rad) > MIN_TURN_RAD
        )
        share = 1.0 if is_frozen_throughout else min(share, 0.99)
        yield finding("frozen_stops", stream, share=share)


def check_turning(poses: StopPoses) -> Iterator[Finding]:
    """Yield a finding for a side with one orientation at all stops, if the other side turns."""
    for stream, other in _BOTH_WAYS:
        own_rad = angles_between(getattr(poses, stream)[:MAX_COMPARED])
        others_rad = angles_between(getattr(poses, other)[:MAX_COMPARED])
        turn_rad = median(above_diagonal(others_rad))
        if own_rad.max() < SAME_RAD and turn_rad > MIN_TURN_RAD:
            degrees = float(np.degrees(turn_rad))
            yield finding("only_one_turns_at_stops", stream, degrees=degrees)


def check_rows(poses: StopPoses) -> Iterator[Finding]:
    """Yield a finding if the rotations agree only after rows are shifted or reordered."""
    of_parent = angles_between(poses.parent[:MAX_COMPARED])
    of_child = angles_between(poses.child[:MAX_COMPARED])
    difference_rad = median_difference(of_parent, of_child)
    best = ""
    smallest_rad = difference_rad / MIN_IMPROVEMENT
    for order in _usual_orders(len(of_parent)):
        in_parent = np.ix_(order.parent_rows, order.parent_rows)
        in_child = np.ix_(order.child_rows, order.child_rows)
        reordered_parent = of_parent[in_parent]
        reordered_child = of_child[in_child]
        reordered_rad = median_difference(reordered_parent, reordered_child)
        if reordered_rad < smallest_rad:
            best = order.text
            smallest_rad = reordered_rad
    # Orientations that hardly differ agree in any order.
    if best and difference_rad > MIN_TURN_RAD / 2:
        yield finding("rows", text=best)
    else:
        yield from _check_shifted_block(of_parent, of_child)


class _Order(NamedTuple):
    """An order of the rows of parent and child, and its description in words."""

    text: str
    parent_rows: IntArray
    child_rows: IntArray


def _usual_orders(n: int) -> Iterator[_Order]:
    """Yield orders of n rows that undo usual mistakes: shifts, reversal, sorting files by name."""
    rows = np.arange(n)
    for shift in range(1, _MAX_SHIFT + 1):
        if n - shift < MIN_STOPS_TO_CHECK:
            continue
        by_rows = "by 1 row" if shift == 1 else f"by {shift} rows"
        later = rows[shift:]
        earlier = rows[:-shift]
        yield _Order(f"if the child's are moved down {by_rows}", later, earlier)
        yield _Order(
            f"if the parent's are moved down {by_rows}", earlier, later
        )
    yield _Order(
        "if those of one side are read from the last to the first",
        rows,
        rows[::-1],
    )
    for first in (0, 1):
        by_name = np.argsort([str(row + first) for row in rows], kind="stable")
        if np.array_equal(by_name, rows):
            continue
        names = "0, 1, 10, 11, ..., 2" if first == 0 else "1, 10, 11, ..., 2"
        text = (
            f"are sorted by name ({names}), those of the other side by number"
        )
        yield _Order(f"if the child's {text}", by_name, rows)
        yield _Order(f"if the parent's {text}", rows, by_name)


def _check_shifted_block(
    of_parent: FloatArray, of_child: FloatArray
) -> Iterator[Finding]:
    """Yield a finding if one side misses a row, so that its further rows are shifted by one.

    Parameters
    ----------
    of_parent, of_child : (N, N) arrays
        Angles between all stops of each side, rad.
    """
    blocks = [
        _likeliest_block(of_parent, of_child),
        _likeliest_block(of_child, of_parent),
    ]
    gain, first_row = max(blocks)
    if gain > _MIN_BLOCK_GAIN:
        text = f"from row {first_row + 1} on if one side is moved by one row"
        yield finding("rows", text=text)


def _likeliest_block(
    angles: FloatArray, angles_of_other: FloatArray
) -> tuple[float, int]:
    """Return the gain of the likeliest block that is shifted by one row, and its first row.

    The block extends to the last row. In the block, row i of ``angles`` (N, N) belongs to row i + 1
    of ``angles_of_other``. The gain is the increase of the log likelihood per pair of stops.
    Differences of angles have a Cauchy distribution, whose scale is their 20 % quantile: without or
    with the shift, whichever is smaller.
    """
    own = angles[:-1, :-1]
    in_place_rad = np.abs(angles - angles_of_other)[:-1, :-1]
    shifted_rad = np.abs(own - angles_of_other[1:, 1:])
    # Differences of angles between rows before the block and rows in the block.
    across_rad = np.abs(own - angles_of_other[:-1, 1:])
    quantiles_rad = [
        np.quantile(above_diagonal(differences_rad), 0.2)
        for differences_rad in (in_place_rad, shifted_rad)
    ]
    scale_rad = min(quantiles_rad) + _ROUNDING
    # Negative log likelihoods of the Cauchy distribution.
    in_place = np.log1p((in_place_rad / scale_rad) ** 2)
    shifted = np.log1p((shifted_rad / scale_rad) ** 2)
    across = np.log1p((across_rad / scale_rad) ** 2)
    n = len(in_place)
    costs = []
    for first in range(n):
        before_block = in_place[:first, :first].sum()
        in_block = shifted[first:, first:].sum()
        between = 2.0 * across[:first, first:].sum()
        costs.append(before_block + in_block + between)
    gain = (in_place.sum() - min(costs)) / (n * (n - 1))
    return float(gain), int(np.argmin(costs))


# ------------------------------------------------------------------ kinds of angles

_Conversion: TypeAlias = Callable[[FloatArray], FloatArray]


def _rotations_about_moving_axes(angles: FloatArray) -> FloatArray:
    """Return the rotations of angles (N, 3) about the moving axes x, y, z in this order."""
    return np.swapaxes(se3.rotation_from_rpy(-angles), 1, 2)


def _angles_about_moving_axes(rotations: FloatArray) -> FloatArray:
    return -se3.rotation_to_rpy(np.swapaxes(rotations, 1, 2))


def _rotations_of_reversed_angles(angles: FloatArray) -> FloatArray:
    return se3.rotation_from_rpy(angles[:, ::-1])


def _reversed_angles(rotations: FloatArray) -> FloatArray:
    return se3.rotation_to_rpy(rotations)[:, ::-1]


def _long_vectors(rotations: FloatArray) -> FloatArray:
    """Return the rotation vectors (N, 3) longer than half a turn, of the same rotations."""
    vectors = se3.rotation_log(rotations)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-12
    return np.asarray(vectors * (1.0 - 2.0 * np.pi / lengths))


def _vectors_of_one_sign(rotations: FloatArray) -> FloatArray:
    """Return rotation vectors (N, 3) with the same sign along their main axis.

    The rotations of a tool that points down are near half a turn, where the sign of the rotation
    vector is arbitrary. Robots print all of them with one sign.
    """
    vectors = se3.rotation_log(rotations)
    main_axis = int(np.argmax(medians(np.abs(vectors.T))))
    is_negative = vectors[:, main_axis] < 0.0
    return np.where(is_negative[:, None], _long_vectors(rotations), vectors)


_VECTORS = "rotation vectors"
_FIXED = "angles about the fixed axes x, y, z (roll, pitch, yaw)"
_MOVING = "angles about the moving axes x, y, z"
_REVERSED = (
    "angles about the fixed axes x, y, z, listed as yaw, pitch, roll (A, B, C)"
)

# For each kind of angles, the function from three numbers (N, 3) to rotations (N, 3, 3).
_ROTATIONS_OF: dict[str, _Conversion] = {
    _VECTORS: se3.rotation_exp,
    _FIXED: se3.rotation_from_rpy,
    _MOVING: _rotations_about_moving_axes,
    _REVERSED: _rotations_of_reversed_angles,
}

# For each kind of angles, the function from rotations to three numbers. Rotation vectors have three
# functions, because they are ambiguous by a full turn.
_NUMBERS_OF: tuple[tuple[str, _Conversion], ...] = (
    (_VECTORS, se3.rotation_log),
    (_VECTORS, _long_vectors),
    (_VECTORS, _vectors_of_one_sign),
    (_FIXED, se3.rotation_to_rpy),
    (_MOVING, _angles_about_moving_axes),
    (_REVERSED, _reversed_angles),
)


class _AngleKind(NamedTuple):
    """Rotations of one side, if its three numbers are read as another kind of angles.

    ``difference_rad`` is the median difference between the angles between stops of both sides.
    """

    difference_rad: float
    stream: str
    text: str
    poses: StopPoses

    @property
    def unexplained_share(self) -> float:
        """Unexplained share with these rotations, for the better setup."""
        fits = [
            rough_fit(self.poses, Mistakes(is_inverse=is_inverse))
            for is_inverse in (False, True)
        ]
        return min(fit.unexplained_share for fit in fits)


def check_angles(poses: StopPoses) -> Iterator[Finding]:
    """Yield a finding if rotations agree only as another kind of angles, or not at all."""
    sample = poses.sample()
    of_parent = angles_between(sample.parent)
    of_child = angles_between(sample.child)
    difference_rad = median_difference(of_parent, of_child)
    turn_rad = max(
        median(above_diagonal(of_parent)), median(above_diagonal(of_child))
    )
    are_equal = difference_rad < MAX_UNEXPLAINED * MIN_TURN_RAD
    if are_equal or difference_rad < SMALL_UNEXPLAINED * turn_rad:
        return
    # Another kind must reduce the difference clearly, and leave little of the rotation unexplained.
    limit_rad = min(
        difference_rad / MIN_IMPROVEMENT, MAX_UNEXPLAINED * turn_rad
    )
    kinds = [
        *_other_kinds(sample, "parent", of_child),
        *_other_kinds(sample, "child", of_parent),
    ]
    agreeing = [kind for kind in kinds if kind.difference_rad < limit_rad]
    if agreeing:
        best = _best_kind(agreeing)
        yield finding("angles", best.stream, detail=best.text)
    elif difference_rad > MIN_TURN_RAD and _are_unrelated(of_parent, of_child):
        yield finding(
            "unrelated_stops", off_deg=float(np.degrees(difference_rad))
        )


def _best_kind(kinds: Sequence[_AngleKind]) -> _AngleKind:
    """Return the kind of angles with the best fit, among kinds that agree about equally well."""
    smallest_rad = min(kind.difference_rad for kind in kinds)
    limit_rad = _MAX_EQUAL_RATIO * smallest_rad
    equal = [kind for kind in kinds if kind.difference_rad <= limit_rad]
    return min(equal, key=lambda kind: kind.unexplained_share)


def _other_kinds(
    sample: StopPoses, stream: str, angles_of_other: FloatArray
) -> Iterator[_AngleKind]:
    """Yield the rotations of a stream for each other kind of angles.

    ``angles_of_other`` (N, N) are the angles between the stops of the other stream, rad.
    """
    Ts = getattr(sample, stream)
    R = se3.rotation_of(Ts)
    for meant, rotations_of in _ROTATIONS_OF.items():
        for read_as, numbers_of in _NUMBERS_OF:
            if meant != read_as:
                text = f"{meant}, not {read_as}"
                rotations = rotations_of(numbers_of(R))
                yield _angle_kind(
                    sample, stream, rotations, text, angles_of_other
                )
        if meant != _VECTORS:
            text = f"{meant}, not {_VECTORS}"
            both = (
                rotations_of(se3.rotation_log(R)),
                rotations_of(_long_vectors(R)),
            )
            rotations = _agreeing_rotations(both, angles_of_other)
            yield _angle_kind(sample, stream, rotations, text, angles_of_other)


def _angle_kind(
    sample: StopPoses,
    stream: str,
    rotations: FloatArray,
    text: str,
    angles_of_other: FloatArray,
) -> _AngleKind:
    """Return a kind of angles, compared with the angles (N,) of the other stream.

    ``rotations`` (N, 3, 3) are the rotations of ``stream``, read as this kind.
    """
    positions = se3.translation_of(getattr(sample, stream))
    reread = se3.from_rotation_translation(rotations, positions)
    difference_rad = median_difference(angles_between(reread), angles_of_other)
    return _AngleKind(
        difference_rad, stream, text, sample.with_side(stream, reread)
    )


def _agreeing_rotations(
    both: tuple[FloatArray, FloatArray], angles_of_other: FloatArray
) -> FloatArray:
    """Return, for each of N stops, the rotation of two that agrees with the other side.

    A start takes one rotation of one stop. The other stops get the rotation that agrees with it.
    Then each stop gets the rotation that agrees best with all other stops, until nothing changes.

    Parameters
    ----------
    both : two (N, 3, 3) arrays
        Rotations by the short and by the long rotation vector of each stop.
    angles_of_other : (N, N) array
        Angles between the stops of the other side, rad.
    """
    n = len(angles_of_other)
    R = np.concatenate(both)
    angles = angles_between(
        se3.from_rotation_translation(R, np.zeros((2 * n, 3)))
    )
    differences = np.abs(angles - np.tile(angles_of_other, (2, 2)))
    best = np.arange(n)
    smallest_rad = np.inf
    stops = np.unique(np.linspace(0, n - 1, _N_STARTING_STOPS).astype(np.int64))
    for start in (*stops, *(stops + n)):
        rows = np.arange(n) + n * differences[start].reshape(2, n).argmin(
            axis=0
        )
        for _ in range(_MAX_CHOICE_ROUNDS):
            costs = np.median(differences[:, rows], axis=1)
            updated = np.arange(n) + n * costs.reshape(2, n).argmin(axis=0)
            if np.array_equal(updated, rows):
                break
            rows = updated
        difference_rad = median(above_diagonal(differences[np.ix_(rows, rows)]))
        if difference_rad < smallest_rad:
            best = rows
            smallest_rad = difference_rad
    return R[best]


def _are_unrelated(of_parent: FloatArray, of_child: FloatArray) -> bool:
    """Return whether both sides agree hardly better than with rows in random order."""
    random = np.random.default_rng(0)
    in_random_order_rad = []
    for _ in range(_N_RANDOM_ORDERS):
        rows = random.permutation(len(of_child))
        in_random_order_rad.append(
            median_difference(of_parent, of_child[np.ix_(rows, rows)])
        )
    difference_rad = median_difference(of_parent, of_child)
    return difference_rad > UNRELATED_UNEXPLAINED * median(in_random_order_rad)
