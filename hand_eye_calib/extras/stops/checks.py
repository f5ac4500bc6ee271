"""Checks of stops before they are solved: rows, rotations, conventions, units, and frozen poses.

Between any two stops both sensors rotate through the same angle, whatever the extrinsic is. Rows
that do not belong together break this, and so do Euler angles that were read as rotation vectors.
Quaternions in another order do not: reading w x y z as x y z w turns a rotation into an inverse
one, seen from other axes. Only the positions contradict. So each usual mistake is undone in turn,
and a robust fit of ``A X = Z B`` shows whether rotations and positions agree without it.
"""

import itertools
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.config import defaults_of
from hand_eye_calib.core.base.stats import median, medians, robust_regression, robust_weights
from hand_eye_calib.core.checks.findings import CONVENTIONS, Finding, Severity, conventions, finding
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.robot_world import Stops, closest_rotations, solve

# Fewest stops that can contradict: four have twelve coordinates for seven unknown lengths.
_FEWEST = 6

# Most stops that are compared with each other: pairs are their square.
_MOST = 150

# Shares of the rotation or of the positions that stay unexplained. From the first on other
# explanations are tried, from the others on a warning and an error say so. Three real arms leave
# 0.015 to 0.07 (MoveIt's samples, ETHZ, CamOdoCal), simulated ones 0.01, sides that do not belong
# together 0.5.
_EXPLAINED = 0.04
_DOUBTFUL = 0.12
_HOLDS = 0.3
_UNRELATED = 0.5

# Errors of positions may be so many times those that the errors of the rotations cause at the
# distance of the target: 1 to 5 of real arms, 1 to 4 of KinHEC's with noise. Beyond the first
# number positions contradict if too much of them stays unexplained, beyond the second if it is
# this share.
_BY_NOISE = 4.0
_BEYOND_NOISE = 12.0
_CONTRADICTING = 0.08

# Rotations of rows in another order, or of angles read otherwise, agree if they are so many times
# closer.
_CLEARLY = 3.0

# A mistake is repaired if the log likelihood without it is larger by this number, and by the
# logarithm of the second for each coordinate of the stops. KinHEC's stops with strong noise have
# 190 to 400 for 30 stops, and the logarithm of 2 asks for 62.
_EVIDENCE = 36.0
_DECISIVE = 2.0

# Stops are right as they are if their log likelihood exceeds that of any mistake by this number:
# a factor of 1100 between the likelihoods. Between both numbers the stops do not tell.
_LEAD = 7.0

# Explanations that are solved to compare their likelihoods: the best ones of the rough fits.
_SOLVED = 6

# Mistakes that leave about as much unexplained, and are as simple, cannot be told apart.
_ABOUT_EQUAL = 1.5

# A hand or a target that rotates less than this between stops (rad) hardly rotates: 3 deg.
_ROTATES = 0.05

# A pose that is repeated differs from the one before by less than this (m, rad): by rounding.
_REPEATED = 1e-6

# Largest shift of rows that is looked for.
_MOST_SHIFTED = 3

# A stop agrees with the others if its angles to a third of them do, within three times their usual
# difference; a block that was shifted is named if it has at least this share of the stops.
_AGREEING = 0.3
_BLOCK = 0.15

# Rounds of weights of a fit.
_ROUNDS = 8

# Positions spread over more than this (m) are not those of an arm. They are mm if their median
# distance from their origin is above the second number, otherwise cm.
_WIDEST_M = 3.0
_FARTHEST_CM = 200.0

# What is left of a factor between the lengths of both sides once its unit is divided out: the size
# of a target is not wrong by more.
_LARGEST_LEFT = 3.0

# Factors of units to metres.
_UNITS = {0.01: "centimetres", 0.001: "millimetres"}


@dataclass(frozen=True)
class GivenStops:
    """Poses of both sensors at N stops as they were given, before conventions are put right.

    Attributes
    ----------
    parent, child : (N, 4, 4) arrays
        Poses of the parent sensor in its world and of the child sensor in its own. Of an arm:
        poses of the hand in the base, and of the target in the camera.
    is_arm : bool
        The camera may be on the hand or beside the robot.
    has_positions : bool
        False if only the rotations are known.
    """

    parent: FloatArray
    child: FloatArray
    is_arm: bool = False
    has_positions: bool = True

    def __len__(self) -> int:
        return len(self.parent)

    def __getitem__(self, rows: IntArray) -> "GivenStops":
        parent = self.parent[rows]
        child = self.child[rows]
        return GivenStops(parent, child, self.is_arm, self.has_positions)

    def sides(self, mistakes: "Mistakes") -> tuple[FloatArray, FloatArray]:
        """A and B (N, 4, 4) of A X = Z B without these mistakes."""
        A = _put_right(self.parent, mistakes.parent)
        B = _put_right(self.child, mistakes.child)
        if self.is_arm:
            B = se3.inverse(B)
        if mistakes.is_inverse:
            A = se3.inverse(A)
        return A, B

    def child_scaled(self, factor: float) -> "GivenStops":
        """Return the stops with the child's lengths multiplied by a factor."""
        return replace(self, child=scaled(self.child, factor))


@dataclass(frozen=True)
class Mistakes:
    """Codes of the conventions that are wrong, empty for none; ``is_inverse`` if one side is
    inverse: of an arm, the camera is beside the robot.
    """

    parent: str = ""
    child: str = ""
    is_inverse: bool = False

    @property
    def complexity(self) -> int:
        """Number of different mistakes: one exporter often makes the same on both sides."""
        return len({self.parent, self.child} - {""})


@dataclass(frozen=True)
class RoughFit:
    """Robust closed-form fit of ``A X = Z B``.

    Attributes
    ----------
    turning, placing : float
        Shares of the rotations and of the positions that stay unexplained.
    beyond : float
        Median error of the positions over that which the errors of the rotations cause.
    scale : float or None
        Factor of the child's lengths; None if the stops do not determine it.
    log_likelihood : float
        Of the median errors, with a free factor of the child's lengths, but for a constant.
    """

    turning: float
    placing: float
    beyond: float = 0.0
    scale: float | None = None
    log_likelihood: float = 0.0

    @property
    def unexplained(self) -> float:
        """The larger one of both shares."""
        return max(self.turning, self.placing)

    @property
    def is_noise(self) -> bool:
        """Whether nothing contradicts beyond noise that the rotations have as well."""
        is_rough = max(self.turning / _HOLDS, self.placing / _UNRELATED) > 1.0
        is_beyond = self.placing > _EXPLAINED and self.beyond > _BY_NOISE
        return not (is_rough or is_beyond)


@dataclass(frozen=True)
class Examination:
    """What stops look like before the solve.

    Attributes
    ----------
    findings : tuple of Finding
        Errors that no option repairs for certain.
    repairs : tuple of Finding
        Mistakes that their options repair.
    scale : float or None
        Rough factor of the child's lengths after the repairs; None if it is not determined.
    """

    findings: tuple[Finding, ...] = ()
    repairs: tuple[Finding, ...] = ()
    scale: float | None = None


def scaled(Ts: FloatArray, factor: float) -> FloatArray:
    """Return poses (N, 4, 4) with their lengths multiplied by a factor."""
    return se3.from_rotation_translation(Ts[:, :3, :3], factor * Ts[:, :3, 3])


def stops_of(given: GivenStops, mistakes: Mistakes, scale: float = 1.0) -> Stops:
    """Return the stops of A X = Z B without mistakes, with a factor of the child's lengths."""
    return Stops.of_one(*given.child_scaled(scale).sides(mistakes))


def examine(given: GivenStops) -> Examination:
    """Look for usual mistakes in stops.

    Parameters
    ----------
    given : GivenStops
        With the options of the user applied.
    """
    if len(given) < _FEWEST:
        return Examination()
    findings = [*_frozen(given)]
    if all(each.evidence["share"] < 1.0 for each in findings):
        findings += _rows(given)
    if not findings:
        findings += _angles(given)
    if findings:
        return Examination(tuple(findings))
    few = given[_spread_over(len(given))]
    if not turns_about_two_axes(given.parent):
        # The rotations do not determine where the positions belong.
        return _of_lengths(few, None, [], [])
    mistakes, fit, rivals = _explained(few)
    findings, repairs = _named(given, mistakes, rivals)
    if axes := _axes(few, fit):
        return Examination((axes,))
    if not (findings or repairs):
        findings += _disagreeing(fit)
    if any(found.makes_unusable for found in findings):
        return Examination(tuple(findings), tuple(repairs))
    return _of_lengths(few, fit.scale, findings, repairs)


def _of_lengths(
    few: GivenStops, scale: float | None, findings: list[Finding], repairs: list[Finding]
) -> Examination:
    """The examination with what there is to say of units."""
    if few.has_positions:
        lengths, scale = _units(few, scale)
        # Stops of two vehicles may be far apart; an arm is not that large.
        is_sure = few.is_arm or (len(lengths) == 1 and scale is not None)
        (repairs if is_sure else findings).extend(lengths)
    return Examination(tuple(findings), tuple(repairs), scale)


# ------------------------------------------------------------------ rows and rotations


def angles_between(Ts: FloatArray) -> FloatArray:
    """Angles (N, N), rad, of the rotations between stops."""
    quats = se3.to_quat_xyzw(Ts)
    return np.asarray(2.0 * np.arccos(np.clip(np.abs(quats @ quats.T), 0.0, 1.0)))


def turns_about_two_axes(Ts: FloatArray) -> bool:
    """Whether poses (N, 4, 4) differ by rotations about two axes at least, of 3 deg and more."""
    rotations = Ts[:, :3, :3]
    central = rotations[int(np.argmin(medians(angles_between(Ts))))]
    vectors = se3.rotation_log(central.T @ rotations)
    sizes = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(vectors))
    return bool(sizes[1] > _ROTATES)


def _spread_over(n: int) -> IntArray:
    """Rows of at most 150 of n stops, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, _MOST)).astype(np.int64))


def _upper(angles: FloatArray) -> FloatArray:
    return np.asarray(angles[np.triu_indices(len(angles), 1)])


def _frozen(given: GivenStops) -> Iterator[Finding]:
    """A side that repeats its pose at stops between which the other side rotates."""
    sides = {"parent": given.parent, "child": given.child}
    for stream, other in (("parent", "child"), ("child", "parent")):
        steps = se3.log(se3.inverse(sides[stream][:-1]) @ sides[stream][1:])
        is_repeated = np.abs(steps).max(axis=1) < _REPEATED
        others = sides[other]
        turned = se3.rotation_angle(np.swapaxes(others[:-1, :3, :3], 1, 2) @ others[1:, :3, :3])
        share = float(np.mean(is_repeated & (turned > _ROTATES)))
        if share > 0.0:
            everywhere = is_repeated.all() and median(turned) > _ROTATES
            share = 1.0 if everywhere else min(share, 0.99)
            yield finding("frozen_stops", stream, share=share)


def _rows(given: GivenStops) -> Iterator[Finding]:
    """Rows that belong together only if those of one side are shifted, or in another order."""
    n = min(len(given), _MOST)
    of_parent = angles_between(given.parent[:n])
    of_child = angles_between(given.child[:n])
    apart = median(np.abs(_upper(of_parent - of_child)))
    best = ""
    least = apart / _CLEARLY
    for text, rows in _orders(n):
        left = median(
            np.abs(_upper(of_parent[np.ix_(rows[0], rows[0])] - of_child[np.ix_(rows[1], rows[1])]))
        )
        if left < least:
            best = text
            least = left
    # Rows of poses that hardly differ agree anyhow.
    if best and apart > _ROTATES / 2:
        yield finding("rows", text=best)
        return
    yield from _shifted_block(of_parent, of_child)


def _orders(n: int) -> Iterator[tuple[str, tuple[IntArray, IntArray]]]:
    """Usual orders of rows: what is said of them, and the rows of both sides that pair up."""
    rows = np.arange(n)
    for shift in range(1, _MOST_SHIFTED + 1):
        if n - shift < _FEWEST:
            continue
        times = f"{shift} row{'s' if shift > 1 else ''}"
        later = rows[shift:]
        earlier = rows[:-shift]
        yield f"if the child's are moved down by {times}", (later, earlier)
        yield f"if the parent's are moved down by {times}", (earlier, later)
    yield "if those of one side are read from the last to the first", (rows, rows[::-1])
    for first in (0, 1):
        names = np.argsort([str(row + first) for row in rows], kind="stable")
        if np.any(names != rows):
            text = f"if one side was sorted by names {first}, {first + 1}, 10, 11, ..."
            yield text + " and the other by numbers (child)", (names, rows)
            yield text + " and the other by numbers (parent)", (rows, names)


def _shifted_block(of_parent: FloatArray, of_child: FloatArray) -> Iterator[Finding]:
    """Rows that agree from some row on only if one side is shifted: a row is missing there."""
    n = len(of_parent)
    usual = _agreeing(of_parent, of_child)
    for shift in (1, -1):
        later = slice(max(shift, 0), n + min(shift, 0))
        earlier = slice(max(-shift, 0), n - max(shift, 0))
        agreeing = _agreeing(of_parent[later, later], of_child[earlier, earlier])
        lost = agreeing & ~usual[later] & ~usual[earlier]
        if lost.mean() > _BLOCK:
            first = int(np.flatnonzero(lost)[0]) + 1
            yield finding("rows", text=f"from row {first} on if one side is moved by one row")
            return


def _agreeing(of_parent: FloatArray, of_child: FloatArray) -> BoolArray:
    """Whether (N,) each stop rotates as far from a third of the others on both sides."""
    apart = np.abs(of_parent - of_child)
    within = 3.0 * float(np.quantile(_upper(apart), 0.2)) + 1e-9
    return np.asarray(np.mean(apart < min(within, _ROTATES), axis=1) > _AGREEING)


# ------------------------------------------------------------------ angles read as others

_Numbers: TypeAlias = Callable[[FloatArray], FloatArray]


def _moving_axes(angles: FloatArray) -> FloatArray:
    """Rotations of angles about the moving axes x, y, z in this order."""
    return np.swapaxes(se3.rotation_from_rpy(-angles), 1, 2)


def _angles_of_moving_axes(rotations: FloatArray) -> FloatArray:
    return -se3.rotation_to_rpy(np.swapaxes(rotations, 1, 2))


def _reversed_angles(angles: FloatArray) -> FloatArray:
    return se3.rotation_from_rpy(angles[:, ::-1])


def _angles_in_reverse(rotations: FloatArray) -> FloatArray:
    return se3.rotation_to_rpy(rotations)[:, ::-1]


def _long_vectors(rotations: FloatArray) -> FloatArray:
    """The rotation vectors beyond half a turn of the same rotations."""
    vectors = se3.rotation_log(rotations)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-12
    return np.asarray(vectors * (1.0 - 2.0 * np.pi / lengths))


def _vectors_of_one_side(rotations: FloatArray) -> FloatArray:
    """Rotation vectors on one side of their main axis: a tool that points down has angles near half
    a turn of one sign.
    """
    vectors = se3.rotation_log(rotations)
    axis = int(np.argmax(medians(np.abs(vectors.T))))
    is_other = vectors[:, axis] < 0.0
    return np.where(is_other[:, None], _long_vectors(rotations), vectors)


_VECTORS = "rotation vectors"
_FIXED = "angles about the fixed axes x, y, z (roll, pitch, yaw)"
_MOVING = "angles about the moving axes x, y, z"
_REVERSED = "angles about the fixed axes x, y, z in the order yaw, pitch, roll (A, B, C)"

# Rotations of three numbers, and the numbers that rotations were made of if they were read so.
_ROTATIONS_OF: dict[str, _Numbers] = {
    _VECTORS: se3.rotation_exp,
    _FIXED: se3.rotation_from_rpy,
    _MOVING: _moving_axes,
    _REVERSED: _reversed_angles,
}
_NUMBERS_OF: tuple[tuple[str, _Numbers], ...] = (
    (_VECTORS, se3.rotation_log),
    (_VECTORS, _long_vectors),
    (_VECTORS, _vectors_of_one_side),
    (_FIXED, se3.rotation_to_rpy),
    (_MOVING, _angles_of_moving_axes),
    (_REVERSED, _angles_in_reverse),
)


def _angles(given: GivenStops) -> Iterator[Finding]:
    """Rotations that agree once their three numbers are taken for other angles."""
    few = given[_spread_over(len(given))]
    angles = {"parent": angles_between(few.parent), "child": angles_between(few.child)}
    apart = median(np.abs(_upper(angles["parent"] - angles["child"])))
    spread = max(median(_upper(angles["parent"])), median(_upper(angles["child"])))
    if apart < _HOLDS * _ROTATES or apart < _EXPLAINED * spread:
        return
    least = min(apart / _CLEARLY, _HOLDS * spread)
    agreeing = []
    for stream, other in (("parent", "child"), ("child", "parent")):
        for detail, rotations in _read_otherwise(getattr(few, stream)):
            left = median(np.abs(_upper(angles_between(rotations) - angles[other])))
            if left < least:
                agreeing.append((left, stream, detail, rotations))
    if agreeing:
        smallest = min(left for left, *_ in agreeing)
        alike = [each for each in agreeing if each[0] <= _ABOUT_EQUAL * smallest]
        _, stream, detail, _ = min(alike, key=lambda reading: _left_by(few, *reading[1::2]))
        yield finding("angles", stream, detail=detail)
    elif apart > _ROTATES and _is_unrelated(angles):
        yield finding("unrelated_stops", off_deg=float(np.degrees(apart)))


def _left_by(few: GivenStops, stream: str, rotations: FloatArray) -> float:
    """The share that stays unexplained with other rotations (N, 3, 3) of a stream."""
    other = _with_poses(few, stream, rotations, getattr(few, stream)[:, :3, 3])
    return min(rough_fit(other, Mistakes(is_inverse=way)).unexplained for way in (False, True))


def _with_poses(
    given: GivenStops, stream: str, rotations: FloatArray, positions: FloatArray
) -> GivenStops:
    """The stops with other poses of a stream."""
    poses = se3.from_rotation_translation(rotations, positions)
    return replace(given, parent=poses) if stream == "parent" else replace(given, child=poses)


def _read_otherwise(Ts: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Other readings of the three numbers behind rotations, and the rotations (N, 3, 3) then."""
    for read_as, numbers_of in _NUMBERS_OF:
        numbers = numbers_of(Ts[:, :3, :3])
        for meant, rotation_of in _ROTATIONS_OF.items():
            if meant != read_as:
                yield f"{meant}, not {read_as}", rotation_of(numbers)


def _is_unrelated(angles: dict[str, FloatArray]) -> bool:
    """Whether the stops of both sides agree hardly better than in any other order."""
    of_parent = angles["parent"]
    of_child = angles["child"]
    random = np.random.default_rng(0)
    apart = median(np.abs(_upper(of_parent - of_child)))
    others = []
    for _ in range(_ROUNDS):
        rows = random.permutation(len(of_child))
        others.append(median(np.abs(_upper(of_parent - of_child[np.ix_(rows, rows)]))))
    return apart > _UNRELATED * median(others)


# ------------------------------------------------------------------ conventions

_WAYS = ("", "quaternion_order", "quaternion_names", "inverse_orientation")


def _put_right(Ts: FloatArray, code: str) -> FloatArray:
    return se3.put_right(Ts, **dict([CONVENTIONS[code]])) if code else Ts


def _explained(few: GivenStops) -> tuple[Mistakes, RoughFit, list[Mistakes]]:
    """The mistakes that explain the stops best, none unless they are decisively better; their fit;
    and other mistakes that are as simple and about as good.
    """
    plain = [Mistakes()] + [Mistakes(is_inverse=True)] * few.is_arm
    fits = [(mistakes, rough_fit(few, mistakes)) for mistakes in plain]
    # Where the rotations say which way round it is, the positions do not overrule them.
    most = _CLEARLY * min(fit.turning for _, fit in fits)
    given = min((candidate for candidate in fits if candidate[1].turning <= most), key=_badness)
    if given[1].unexplained < _EXPLAINED or not few.has_positions:
        return *given, []
    rivals = _rivals(few, plain)
    solved = [(_objective(few, *rival), *rival) for rival in rivals]
    least = min(objective for objective, *_ in solved)
    lead = min(_objective(few, *candidate) for candidate in fits) - least
    if lead < -_LEAD:
        return *given, []
    good = [(mistakes, fit) for objective, mistakes, fit in solved if objective < least + _LEAD]
    simplest = min(mistakes.complexity for mistakes, _ in good)
    good = [rival for rival in good if rival[0].complexity == simplest]
    if lead < _decisive(len(few)):
        return *given, [mistakes for mistakes, _ in good]
    chosen, fit = min(good, key=_badness)
    if fit.unexplained > _HOLDS:
        return *given, []
    return chosen, fit, [mistakes for mistakes, _ in good if mistakes != chosen]


def _rivals(few: GivenStops, plain: Collection[Mistakes]) -> list[tuple[Mistakes, RoughFit]]:
    """Return the mistakes with the best rough fits."""
    rivals = []
    for ways in itertools.product(_WAYS, _WAYS, (False, True)):
        mistakes = Mistakes(*ways)
        if mistakes not in plain:
            rivals.append((mistakes, rough_fit(few, mistakes)))
    rivals.sort(key=lambda rival: -rival[1].log_likelihood)
    return rivals[:_SOLVED]


def _objective(few: GivenStops, mistakes: Mistakes, fit: RoughFit) -> float:
    """Negative log likelihood of the stops without these mistakes, in lengths of the parent."""
    return solve(stops_of(few, mistakes, fit.scale or 1.0)).objective


def _decisive(n_stops: int) -> float:
    """Return the difference of log likelihoods that decides for a mistake in so many stops."""
    return max(_EVIDENCE, 3.0 * n_stops * float(np.log(_DECISIVE)))


def _badness(tried: tuple[Mistakes, RoughFit]) -> float:
    return tried[1].unexplained


def rough_fit(given: GivenStops, mistakes: Mistakes) -> RoughFit:
    """Fit stops without these mistakes robustly, with a free scale if the stops determine it."""
    A, B = given.sides(mistakes)
    weights = np.ones(len(A))
    for _ in range(_ROUNDS):
        X, Z = closest_rotations(A[:, :3, :3], B[:, :3, :3], weights)
        left = se3.rotation_angle(np.swapaxes(Z @ B[:, :3, :3], 1, 2) @ A[:, :3, :3] @ X)
        weights = robust_weights("cauchy", (left / max(median(left), 1e-12)) ** 2)
    left_rad = median(left)
    spread = max(median(_upper(angles_between(A))), median(_upper(angles_between(B))))
    # Rotations of a few degrees are not judged: noise may be as large.
    turning = left_rad / max(spread, _ROTATES)
    if not given.has_positions:
        return RoughFit(turning, 0.0)
    placing, position, scale = _placed(A, B, Z)
    distance = (scale or 1.0) * median(np.linalg.norm(B[:, :3, 3], axis=1))
    beyond = position / max(left_rad * distance, 1e-12)
    logs = np.log(max(left_rad, 1e-12)) + np.log(max(position, 1e-12))
    return RoughFit(turning, placing, beyond, scale, -3.0 * len(A) * float(logs))


def _placed(A: FloatArray, B: FloatArray, Z: FloatArray) -> tuple[float, float, float | None]:
    """Share of the positions that stays unexplained, their median error, and the factor of the
    child's lengths.
    """
    ones = np.broadcast_to(-np.eye(3), (len(A), 3, 3))
    of_child = B[:, :3, 3] @ Z.T
    levers = np.concatenate([A[:, :3, :3], ones], axis=2)
    free = np.concatenate([levers, -of_child[:, :, None]], axis=2)
    without, _ = _least(levers, A[:, :3, 3])
    left, values = _least(free, A[:, :3, 3])
    spreads = [_spread(A[:, :3, 3]), _spread(of_child)]
    scale = float(values[6])
    if scale > 0.0 and without > left * np.exp(_decisive(len(A)) / (3.0 * len(A))):
        return left / max(min(spreads[0], scale * spreads[1]), 1e-12), left, scale
    # A hand that moves about one point, or a fault: one unit of length.
    left, _ = _least(levers, A[:, :3, 3] - of_child)
    return left / max(*spreads, 1e-12), left, None


def _spread(positions: FloatArray) -> float:
    """Median distance of positions (N, 3) from their median."""
    return median(np.linalg.norm(positions - medians(positions.T), axis=1))


def _least(rows: FloatArray, positions: FloatArray) -> tuple[float, FloatArray]:
    """Median length of ``rows @ values + positions``, and the values (k,), by robust weights."""
    values, lengths = robust_regression("cauchy", rows, -positions, _ROUNDS, median)
    return median(lengths), values


def _named(
    given: GivenStops, mistakes: Mistakes, rivals: Collection[Mistakes]
) -> tuple[list[Finding], list[Finding]]:
    """Findings of mistakes that no option repairs for certain, and of those that one does."""
    streams = _streams(mistakes)
    repairs = [finding(code, stream, options=conventions(code, stream)) for code, stream in streams]
    others = [other for other in rivals if _streams(other) != streams]
    findings: list[Finding] = []
    if mistakes.is_inverse and not given.is_arm:
        findings.append(finding("inverse_stops", "child", options={"child_invert": "poses"}))
    if others:
        findings.append(_ambiguous(mistakes, others[0]))
    return findings, repairs


def _ambiguous(mistakes: Mistakes, other: Mistakes) -> Finding:
    """Return the finding that two explanations fit alike, with the options of both."""
    first = _options_of(mistakes)
    second = _options_of(other)
    # Both explanations name all options that one of them sets, so that the options decide.
    of_first = first | defaults_of(name for name in second if name not in first)
    of_second = second | defaults_of(name for name in first if name not in second)
    return finding(
        "ambiguous_stops",
        options=of_second,
        given=" ".join(f"{name} {value}" for name, value in of_first.items()),
        other=" ".join(f"{name} {value}" for name, value in of_second.items()),
    )


def _options_of(mistakes: Mistakes) -> dict[str, float | str]:
    """Return the options that put mistakes right."""
    options: dict[str, float | str] = {}
    for code, stream in _streams(mistakes):
        options |= conventions(code, stream)
    return options


def _streams(mistakes: Mistakes) -> list[tuple[str, str]]:
    """Code and stream of each mistake."""
    if mistakes.parent == mistakes.child:
        return [(mistakes.parent, "both")] if mistakes.parent else []
    pairs = ((mistakes.parent, "parent"), (mistakes.child, "child"))
    return [(code, stream) for code, stream in pairs if code]


def _disagreeing(fit: RoughFit) -> list[Finding]:
    """A finding if no usual mistake explains the stops."""
    if fit.is_noise:
        return []
    is_far = fit.placing > _CONTRADICTING and fit.beyond > _BEYOND_NOISE
    severity = Severity.WARNING
    if fit.unexplained > _HOLDS or is_far:
        severity = Severity.ERROR
    elif fit.unexplained < _DOUBTFUL:
        return []
    part = "rotations" if fit.turning > fit.placing else "positions"
    share = min(fit.unexplained, 1.0)
    return [finding("disagreeing_stops", severity=severity, part=part, share=share)]


def _axes(few: GivenStops, fit: RoughFit) -> Finding | None:
    """A finding if the positions of one side are clearly in other axes: that explains more than the
    best of the other mistakes, whose fit is given.
    """
    if fit.unexplained < _EXPLAINED:
        return None
    best: tuple[str, str] | None = None
    most = fit.log_likelihood + _decisive(len(few))
    for is_inverse in (False, True) if few.is_arm else (False,):
        mistakes = Mistakes(is_inverse=is_inverse)
        if rough_fit(few, mistakes).turning > _HOLDS:
            continue
        for detail, matrix in _signed_axes():
            for stream in ("child", "parent"):
                poses = getattr(few, stream)
                moved = _with_poses(few, stream, poses[:, :3, :3], poses[:, :3, 3] @ matrix.T)
                other = rough_fit(moved, mistakes)
                if other.log_likelihood > most and other.unexplained < _HOLDS:
                    best = stream, detail
                    most = other.log_likelihood
    return finding("axes", best[0], detail=best[1]) if best else None


def _signed_axes() -> Iterator[tuple[str, FloatArray]]:
    """All permutations and flips of the axes but the identity."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            matrix = np.diag(signs) @ np.eye(3)[list(order)]
            if not np.array_equal(matrix, np.eye(3)):
                names = []
                for sign, axis in zip(signs, order, strict=True):
                    names.append("xyz"[axis] if sign > 0 else f"-{'xyz'[axis]}")
                yield " ".join(names), matrix


# ------------------------------------------------------------------ lengths


def _units(few: GivenStops, scale: float | None) -> tuple[list[Finding], float | None]:
    """Findings of sides whose lengths are in other units, and the scale that is left then."""
    of_parent = _unit_of_size(few.parent[:, :3, 3])
    of_child = _unit_of_size(few.child[:, :3, 3])
    if scale is not None:
        needed = scale * of_parent
        units = (1.0, *_UNITS)
        left = [abs(np.log(needed / unit)) for unit in units]
        nearest = int(np.argmin(left))
        of_child = units[nearest] if left[nearest] < np.log(_LARGEST_LEFT) else 1.0
        scale = needed / of_child
    findings = []
    for stream, unit, option in (
        ("parent", of_parent, "parent_scale"),
        ("child", of_child, "scale"),
    ):
        if unit != 1.0:
            findings.append(
                finding("stop_units", stream, options={option: unit}, unit=_UNITS[unit])
            )
    return findings, scale


def _unit_of_size(positions: FloatArray) -> float:
    """The unit of positions (N, 3) by their size: 1 for metres."""
    if _spread(positions) <= _WIDEST_M:
        return 1.0
    is_cm = median(np.linalg.norm(positions, axis=1)) < _FARTHEST_CM
    centimetre, millimetre = _UNITS
    return centimetre if is_cm else millimetre


def scale_finding(scale: float, sigma: float) -> Finding:
    """Return the finding that the child's lengths are those of a target of another size."""
    return finding(
        "target_scale",
        "child",
        Severity.ERROR,
        {"scale": "estimate"},
        scale=scale,
        sigma=sigma,
        times=1.0 / scale,
    )
