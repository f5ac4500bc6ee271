"""Checks of stops that need their rotations alone: frozen poses, wrong rows, angles read otherwise.

Between any two stops both sensors rotate through the same angle, whatever the extrinsic is. So the
matrices (N, N) of the angles between all stops are equal on both sides. Rows that do not belong
together break this, and so do Euler angles that were read as rotation vectors.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median, medians
from hand_eye_calib.core.checks.findings import Finding, finding
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.rough_fit import (
    LEAST_TURN_RAD,
    MOST_COMPARED,
    Mistakes,
    StopPoses,
    above_diagonal,
    angles_between,
    median_difference,
    rough_fit,
)

# Fewest stops that can contradict: four have twelve coordinates for seven unknown lengths.
FEWEST_STOPS = 6

# Rows in another order, or angles read otherwise, are right if the rotations agree so many times
# better.
CLEARLY_BETTER = 3.0

# Largest unexplained shares of the rotations: explained, to be tried otherwise, and not belonging
# together. Measured: three real arms (MoveIt, ETHZ, CamOdoCal) leave 0.015 to 0.07, simulated arms
# 0.01, sides that do not belong together 0.5.
EXPLAINED_SHARE = 0.04
LARGEST_SHARE = 0.3
UNRELATED_SHARE = 0.5

# A repeated pose differs from the one before by less than this (m, rad), by rounding.
_ROUNDING = 1e-6

# Largest shift of rows that is tried.
_LARGEST_SHIFT = 3

# Gain of log likelihood for each pair of stops from which on a block of rows is shifted. Measured
# on 7 to 30 stops of KinHEC and of simulated arms: at most 0.21 without a fault; 0.4 or more in
# 99 % of the sets with a missing row.
_LEAST_BLOCK_GAIN = 0.3

# Readings of angles that leave less than this times the smallest difference agree equally well.
_ABOUT_EQUAL = 1.5

# Random orders of rows that are compared with the given one.
_RANDOM_ORDERS = 8

_BOTH_WAYS = (("parent", "child"), ("child", "parent"))


def check_frozen(poses: StopPoses) -> Iterator[Finding]:
    """Yield a finding for a side that repeats its pose while the other side rotates."""
    for stream, other in _BOTH_WAYS:
        own = getattr(poses, stream)
        others = se3.rotation_of(getattr(poses, other))
        steps = se3.log(se3.inverse(own[:-1]) @ own[1:])
        is_repeated = np.abs(steps).max(axis=1) < _ROUNDING
        turns_rad = se3.rotation_angle(np.swapaxes(others[:-1], 1, 2) @ others[1:])
        share = float(np.mean(is_repeated & (turns_rad > LEAST_TURN_RAD)))
        if share == 0.0:
            continue
        is_frozen_throughout = is_repeated.all() and median(turns_rad) > LEAST_TURN_RAD
        share = 1.0 if is_frozen_throughout else min(share, 0.99)
        yield finding("frozen_stops", stream, share=share)


def check_rows(poses: StopPoses) -> Iterator[Finding]:
    """Yield a finding if the sides agree only with rows shifted or in another order."""
    of_parent = angles_between(poses.parent[:MOST_COMPARED])
    of_child = angles_between(poses.child[:MOST_COMPARED])
    difference_rad = median_difference(of_parent, of_child)
    best = ""
    smallest_rad = difference_rad / CLEARLY_BETTER
    for order in _usual_orders(len(of_parent)):
        reordered_parent = of_parent[np.ix_(order.parent_rows, order.parent_rows)]
        reordered_child = of_child[np.ix_(order.child_rows, order.child_rows)]
        reordered_rad = median_difference(reordered_parent, reordered_child)
        if reordered_rad < smallest_rad:
            best = order.text
            smallest_rad = reordered_rad
    # Poses that hardly differ agree in any order.
    if best and difference_rad > LEAST_TURN_RAD / 2:
        yield finding("rows", text=best)
    else:
        yield from _check_shifted_block(of_parent, of_child)


class _Order(NamedTuple):
    """An order of rows in which both sides may belong together."""

    text: str
    parent_rows: IntArray
    child_rows: IntArray


def _usual_orders(n: int) -> Iterator[_Order]:
    """Yield the orders of n rows that usual mistakes lead to."""
    rows = np.arange(n)
    for shift in range(1, _LARGEST_SHIFT + 1):
        if n - shift < FEWEST_STOPS:
            continue
        by_rows = "by 1 row" if shift == 1 else f"by {shift} rows"
        later = rows[shift:]
        earlier = rows[:-shift]
        yield _Order(f"if the child's are moved down {by_rows}", later, earlier)
        yield _Order(f"if the parent's are moved down {by_rows}", earlier, later)
    yield _Order("if those of one side are read from the last to the first", rows, rows[::-1])
    for first in (0, 1):
        by_name = np.argsort([str(row + first) for row in rows], kind="stable")
        if np.array_equal(by_name, rows):
            continue
        text = f"if one side was sorted by names {first}, {first + 1}, 10, 11, ..."
        yield _Order(f"{text} and the other by numbers (child)", by_name, rows)
        yield _Order(f"{text} and the other by numbers (parent)", rows, by_name)


def _check_shifted_block(of_parent: FloatArray, of_child: FloatArray) -> Iterator[Finding]:
    """Yield a finding if rows agree from some row on only with one side shifted by one row.

    Parameters
    ----------
    of_parent, of_child : (N, N) arrays
        Angles between the stops of each side, rad.
    """
    blocks = [_likeliest_block(of_parent, of_child), _likeliest_block(of_child, of_parent)]
    gain, first_row = max(blocks)
    if gain > _LEAST_BLOCK_GAIN:
        text = f"from row {first_row + 1} on if one side is moved by one row"
        yield finding("rows", text=text)


def _likeliest_block(of_one: FloatArray, of_other: FloatArray) -> tuple[float, int]:
    """Return gain and first row of the likeliest block in which row i belongs to row i + 1.

    The gain is that of the log likelihood, per pair of stops.

    Differences of the angles (N, N) between stops have a Cauchy distribution. Its scale is the
    20 % quantile in place or shifted by one row: whichever is smaller.
    """
    in_place = np.abs(of_one - of_other)[:-1, :-1]
    shifted = np.abs(of_one[:-1, :-1] - of_other[1:, 1:])
    # Between a row in place and a shifted row.
    across = np.abs(of_one[:-1, :-1] - of_other[:-1, 1:])
    quantiles_rad = [np.quantile(above_diagonal(off), 0.2) for off in (in_place, shifted)]
    scale_rad = min(quantiles_rad) + _ROUNDING
    in_place, shifted, across = [
        np.log1p((off / scale_rad) ** 2) for off in (in_place, shifted, across)
    ]
    n = len(in_place)
    costs = []
    for first in range(n):
        cost = in_place[:first, :first].sum() + shifted[first:, first:].sum()
        costs.append(cost + 2.0 * across[:first, first:].sum())
    gain = (in_place.sum() - min(costs)) / (n * (n - 1))
    return float(gain), int(np.argmin(costs))


# ------------------------------------------------------------------ angles read otherwise

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
    """Return the rotation vectors (N, 3) beyond half a turn of the same rotations."""
    vectors = se3.rotation_log(rotations)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-12
    return np.asarray(vectors * (1.0 - 2.0 * np.pi / lengths))


def _vectors_of_one_sign(rotations: FloatArray) -> FloatArray:
    """Return rotation vectors (N, 3) with one sign along their main axis.

    The rotation vectors of a tool that points down are near half a turn, of one sign.
    """
    vectors = se3.rotation_log(rotations)
    main_axis = int(np.argmax(medians(np.abs(vectors.T))))
    is_negative = vectors[:, main_axis] < 0.0
    return np.where(is_negative[:, None], _long_vectors(rotations), vectors)


_VECTORS = "rotation vectors"
_FIXED = "angles about the fixed axes x, y, z (roll, pitch, yaw)"
_MOVING = "angles about the moving axes x, y, z"
_REVERSED = "angles about the fixed axes x, y, z in the order yaw, pitch, roll (A, B, C)"

# Rotations (N, 3, 3) of three numbers (N, 3), by what the numbers are.
_ROTATIONS_OF: dict[str, _Conversion] = {
    _VECTORS: se3.rotation_exp,
    _FIXED: se3.rotation_from_rpy,
    _MOVING: _rotations_about_moving_axes,
    _REVERSED: _rotations_of_reversed_angles,
}

# The three numbers of rotations, by what the numbers are; vectors are ambiguous by a turn.
_NUMBERS_OF: tuple[tuple[str, _Conversion], ...] = (
    (_VECTORS, se3.rotation_log),
    (_VECTORS, _long_vectors),
    (_VECTORS, _vectors_of_one_sign),
    (_FIXED, se3.rotation_to_rpy),
    (_MOVING, _angles_about_moving_axes),
    (_REVERSED, _reversed_angles),
)


class _AngleReading(NamedTuple):
    """Another reading of the numbers of one side's rotations."""

    difference_rad: float
    stream: str
    text: str
    poses: StopPoses

    @property
    def unexplained(self) -> float:
        """Share that a rough fit leaves unexplained with these rotations."""
        fits = [rough_fit(self.poses, Mistakes(is_inverse=way)) for way in (False, True)]
        return min(fit.unexplained for fit in fits)


def check_angles(poses: StopPoses) -> Iterator[Finding]:
    """Yield a finding if the rotations agree only with their numbers read as other angles, or in no
    way.
    """
    sample = poses.sample()
    of_parent = angles_between(sample.parent)
    of_child = angles_between(sample.child)
    difference_rad = median_difference(of_parent, of_child)
    turn_rad = max(median(above_diagonal(of_parent)), median(above_diagonal(of_child)))
    are_equal = difference_rad < LARGEST_SHARE * LEAST_TURN_RAD
    if are_equal or difference_rad < EXPLAINED_SHARE * turn_rad:
        return
    within_rad = min(difference_rad / CLEARLY_BETTER, LARGEST_SHARE * turn_rad)
    readings = [*_readings(sample, "parent", of_child), *_readings(sample, "child", of_parent)]
    agreeing = [reading for reading in readings if reading.difference_rad < within_rad]
    if agreeing:
        smallest_rad = min(reading.difference_rad for reading in agreeing)
        best = [
            reading for reading in agreeing if reading.difference_rad <= _ABOUT_EQUAL * smallest_rad
        ]
        chosen = min(best, key=lambda reading: reading.unexplained)
        yield finding("angles", chosen.stream, detail=chosen.text)
    elif difference_rad > LEAST_TURN_RAD and _are_unrelated(of_parent, of_child):
        yield finding("unrelated_stops", off_deg=float(np.degrees(difference_rad)))


def _readings(sample: StopPoses, stream: str, of_other: FloatArray) -> Iterator[_AngleReading]:
    """Yield other readings of the rotations of a stream.

    ``of_other`` has the angles (N, N) between the stops of the other side, rad.
    """
    Ts = getattr(sample, stream)
    for read_as, numbers_of in _NUMBERS_OF:
        numbers = numbers_of(se3.rotation_of(Ts))
        for meant, rotations_of in _ROTATIONS_OF.items():
            if meant == read_as:
                continue
            rotations = rotations_of(numbers)
            reread = se3.from_rotation_translation(rotations, se3.translation_of(Ts))
            yield _AngleReading(
                difference_rad=median_difference(angles_between(reread), of_other),
                stream=stream,
                text=f"{meant}, not {read_as}",
                poses=sample.with_side(stream, reread),
            )


def _are_unrelated(of_parent: FloatArray, of_child: FloatArray) -> bool:
    """Return whether both sides agree hardly better than in random orders of the rows."""
    random = np.random.default_rng(0)
    in_random_order_rad = []
    for _ in range(_RANDOM_ORDERS):
        rows = random.permutation(len(of_child))
        in_random_order_rad.append(median_difference(of_parent, of_child[np.ix_(rows, rows)]))
    difference_rad = median_difference(of_parent, of_child)
    return difference_rad > UNRELATED_SHARE * median(in_random_order_rad)
