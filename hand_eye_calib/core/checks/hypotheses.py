"""Hypotheses about mistakes in two streams.

Each hypothesis undoes one usual mistake, and a fit measures whether the streams agree without it.

Model: in every motion pair, whatever X is, both sensors rotate through the same angle and move by
the same distance along the same screw axis. The robust fit of
:mod:`~hand_eye_calib.core.alignment.similarity` measures the share of the motion that breaks this
rule. The plain hypothesis (no mistake) is rejected only if another hypothesis leaves several times
less of the motion unexplained.

Two inverted streams agree as well as two correct ones. X is then the pose of one world in the
other. Three signs decide between both readings. Vehicles travel in a steady direction in their own
frame. On other bodies, a point of the body moves less than any point of the world moves as seen
from the sensor. The lever arm between the worlds is longer than the lever arm between the sensors.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.alignment.similarity import EXPLAINED, SimilarityFit, fit_similarity
from hand_eye_calib.core.alignment.time_offset import Correlation, correlate_rates
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import median, medians, robust_weights
from hand_eye_calib.core.checks.findings import (
    CONVENTIONS,
    Finding,
    Severity,
    conventions,
    finding,
)
from hand_eye_calib.core.checks.streams import coarse
from hand_eye_calib.core.geometry import se3, trajectory
from hand_eye_calib.core.pairing import motion_pairs

# Durations of the compared motions, s. Shorter ones are used only if longer ones do not agree.
LAGS_S = (3.0, 1.0, 0.4)
# Most motions in a fit.
MAX_PAIRS = 400
# Most motions in the rough fits that rank the hypotheses.
_MAX_ROUGH = 120
# Fewest motions in a fit.
MIN_PAIRS = 12

# Largest angle (rad) of a rotation vector: near half a turn its sign is ambiguous.
MAX_ROTATION_RAD = 2.8

# A hypothesis holds if it leaves at most this share of the motion unexplained.
HOLDS = 0.12
# Another hypothesis replaces a plain one that does not hold if it leaves this many times less.
_DECISIVE = 2.0

# Largest unexplained share that noise can cause, in streams whose angular rates clearly agree.
_NOISY = 0.3

# Ratio of unexplained shares below which two hypotheses are equally good. The simpler one is then
# preferred, and a mistake of the child to one of the parent.
_ABOUT_EQUAL = 1.5
# A scale farther from 1 than this (logarithm) counts as one more mistake.
_ODD_SCALE = 0.05

# Shape of the motion: the sum of the log ratios of the paths and of the lever arms. In 190 right
# recordings (KinHEC, real, simulated) it was -0.25 at most, and below -0.4 in all but six. Inverse
# streams have the other sign.
# Above this shape, the reading with both streams inverted is considered.
_SUSPICIOUS = -0.2
# From this size on, the shape decides between two readings if the noise does not.
CLEAR_SHAPE = 0.4
# Subtracted from the log ratio of the paths if the sensors look at a point: a camera that moved
# around its target had 0.4.
_OF_TARGET = 0.5
# Shape if a steady direction of travel decides.
STEADY_SHAPE = 1.0

# Reweighted rounds of the search for the point with the shortest path.
_ROUNDS = 5

# Two frames with parallel axes may be one frame below this distance (m) and this angle (rad). If
# both streams have one world, the lever arm between the worlds is no evidence.
_SAME_FRAME_M = 0.03
_SAME_FRAME_RAD = 0.01
# Shortest lever arm (m) that is compared.
_SHORTEST_ARM_M = 0.01

# Reach of a robot arm (m). The hand of an arm may move more than its base does as seen from the
# hand: inverse poses may be right for sensors that stay within this distance.
_REACH_M = 3.0


@dataclass(frozen=True)
class StreamPair:
    """Two streams on about one clock, and the longest gap (s) to interpolate across."""

    parent: trajectory.Trajectory
    child: trajectory.Trajectory
    max_gap_s: float

    @property
    def interval_s(self) -> float:
        """Median time between poses of the faster stream, s."""
        return min(self.parent.interval_s, self.child.interval_s)

    @property
    def is_slow(self) -> bool:
        """Whether most poses are too far apart to interpolate between them."""
        return all(each.interval_s > self.max_gap_s for each in (self.parent, self.child))

    def correlate(self) -> Correlation:
        """Correlate the angular rates of both streams."""
        return correlate_rates(self.parent, self.child, self.max_gap_s)

    def shifted(self, offset_s: float) -> "StreamPair":
        """Return the pair with ``offset_s`` added to the child's stamps."""
        return replace(self, child=self.child.shifted(offset_s))

    @cached_property
    def synchronised(self) -> motion_pairs.PosePairs:
        """Poses of both streams at common stamps."""
        return motion_pairs.synchronise(self.parent, self.child, self.max_gap_s)

    def pairs(self, lag_s: float, max_pairs: int) -> motion_pairs.MotionPairs:
        """Motion pairs over ``lag_s`` seconds.

        Raises
        ------
        NotEnoughDataError
            If the streams have too few common motions.
        """
        pairs = motion_pairs.pairs_over(self.synchronised, lag_s, max_pairs)
        if len(pairs) < MIN_PAIRS:
            text = f"the streams have only {len(pairs)} motions over {lag_s:g} s in common"
            raise NotEnoughDataError(text)
        return pairs


#: Codes of the conventions that a stream breaks.
_Way: TypeAlias = tuple[str, ...]
_EULER_ORDER: _Way = ("euler_order",)


@dataclass(frozen=True)
class Hypothesis:
    """Mistakes of each stream, as codes of findings.

    ``axes`` (3, 3) undoes wrong axes of positions; ``detail`` names what (x, y, z) should be.
    """

    parent: _Way = ()
    child: _Way = ()
    axes: FloatArray | None = None
    detail: str = ""

    @property
    def ways(self) -> tuple[_Way, _Way]:
        """Mistakes of the parent and of the child."""
        return self.parent, self.child

    @property
    def is_upright(self) -> bool:
        """Whether neither stream holds inverse poses."""
        return "inverse" not in self.parent and "inverse" not in self.child

    @property
    def mistakes(self) -> list[tuple[str, str]]:
        """Code and stream ("parent", "child" or "both") of each mistake."""
        streams = {(False, True): "child", (True, False): "parent", (True, True): "both"}
        codes = dict.fromkeys((*self.parent, *self.child))
        return [(code, streams[code in self.parent, code in self.child]) for code in codes]

    @property
    def complexity(self) -> tuple[int, int]:
        """Number of mistakes, and a number that prefers mistakes of the child among equals.

        Each wrong axis counts as one mistake.
        """
        n_axes = 0 if self.axes is None else int((self.axes != np.eye(3)).any(axis=1).sum())
        return len(self.mistakes) + n_axes, 2 * len(self.parent) + len(self.child)

    def corrected(self, stream: str, poses: FloatArray) -> FloatArray:
        """Return the poses (N, 4, 4) of a stream without its mistakes."""
        way = self.child if stream == "child" else self.parent
        if way and self.axes is not None:
            return se3.from_rotation_translation(
                se3.rotation_of(poses), se3.translation_of(poses) @ self.axes.T
            )
        if way == _EULER_ORDER:
            rotations = se3.in_other_order(se3.rotation_of(poses))
            return se3.from_rotation_translation(rotations, se3.translation_of(poses))
        return se3.put_right(poses, **dict(map(CONVENTIONS.__getitem__, way)))

    def undo(self, streams: StreamPair) -> StreamPair:
        """Return both streams without the mistakes."""
        if self is PLAIN:
            return streams
        given = (("parent", streams.parent), ("child", streams.child))
        right = {name: replace(one, poses=self.corrected(name, one.poses)) for name, one in given}
        return replace(streams, parent=right["parent"], child=right["child"])

    def inverted(self) -> "Hypothesis":
        """Return the hypothesis that also inverts both streams. It fits equally well."""
        parent, child = (
            tuple([code for code in CONVENTIONS if (code in way) != (code == "inverse")])
            for way in (self.parent, self.child)
        )
        return Hypothesis(parent, child)


@dataclass(frozen=True, kw_only=True)
class Readings:
    """Two hypotheses that fit alike: the second one also inverts both streams.

    Attributes
    ----------
    hypotheses : tuple of two Hypothesis
        An upright hypothesis is the first.
    shape : float
        Evidence of the shape of the motion for the second hypothesis: the sum of the log ratios of
        paths and lever arms.
    paths : float
        The part of ``shape`` from the paths.
    is_small : bool
        Whether all sensors stay within the reach of an arm. Inverse poses may be right for an arm
        beside a fixed camera.
    """

    hypotheses: tuple["Hypothesis", "Hypothesis"]
    shape: float
    paths: float
    is_small: bool

    @property
    def by_shape(self) -> int:
        """1 if the shape is clear evidence for the second reading, -1 for the first, else 0."""
        return int(np.sign(self.shape)) if abs(self.shape) > CLEAR_SHAPE else 0

    @property
    def is_clear(self) -> bool:
        """Whether the shape decides. A fixed camera beside an arm may explain it as well."""
        is_fixed_camera = self.is_small and self.hypotheses[0].is_upright and self.shape > 0.0
        return self.by_shape != 0 and not is_fixed_camera

    def ordered(self) -> "Readings":
        """Return the readings with the upright one first."""
        first, second = self.hypotheses
        if not second.is_upright:
            return self
        return replace(self, hypotheses=(second, first), shape=-self.shape, paths=-self.paths)


@dataclass(frozen=True)
class Explanation:
    """A hypothesis with its fit.

    The hypothesis holds below the unexplained share ``limit``. With ``same_unit``, the scale of the
    fit is 1. ``readings`` are set if another reading may be right.
    """

    hypothesis: Hypothesis
    fit: SimilarityFit
    findings: tuple[Finding, ...] = ()
    limit: float = HOLDS
    same_unit: bool = False
    readings: Readings | None = None

    @property
    def may_be_upright(self) -> bool:
        """Whether another reading is possible in which the streams are right as they are."""
        return self.readings is not None and self.readings.hypotheses[0].is_upright

    @property
    def holds(self) -> bool:
        """Whether the streams agree under the hypothesis."""
        return self.fit.unexplained < self.limit

    @property
    def complexity(self) -> tuple[int, int]:
        """Complexity of the hypothesis. An odd scale is one more mistake."""
        n_mistakes, of_streams = self.hypothesis.complexity
        return n_mistakes + int(abs(np.log(self.fit.scale)) > _ODD_SCALE), of_streams


_MIRROR = -np.eye(3)
# Inverted orientations in the order w x y z are missing: they equal orientations of other axes.
_WAYS: list[_Way] = [
    (),
    ("inverse",),
    ("inverse_orientation",),
    ("quaternion_order",),
    ("quaternion_order", "inverse"),
    ("quaternion_names",),
]
_ALL_WAYS = [Hypothesis(of_parent, of_child) for of_parent in _WAYS for of_child in _WAYS]
PLAIN = _ALL_WAYS[0]


# Hypotheses that also invert both streams are missing: they fit equally well.
_USUAL = [
    *(each for each in _ALL_WAYS[1:] if ("inverse", "both") not in each.mistakes),
    Hypothesis(child=("left_handed",), axes=_MIRROR),
    Hypothesis(parent=("left_handed",), axes=_MIRROR),
    Hypothesis(child=_EULER_ORDER),
    Hypothesis(parent=_EULER_ORDER),
]


def _axes() -> Iterator[Hypothesis]:
    """Yield all permutations and flips of the axes of the positions, but not the mirror of all.

    On flat ground some of them are the same as an inverted orientation.
    """
    flips = itertools.product((1, -1), repeat=3)
    for order, signs in itertools.product(itertools.permutations(range(3)), flips):
        matrix = np.diag(signs) @ np.eye(3)[list(order)]
        names = []
        for axis, sign in zip(order, signs, strict=True):
            name = "xyz"[axis]
            names.append(name if sign > 0 else f"-{name}")
        detail = " ".join(names)
        if not (np.array_equal(matrix, np.eye(3)) or np.array_equal(matrix, _MIRROR)):
            yield Hypothesis((), ("axes",), matrix, detail)
            yield Hypothesis(("axes",), (), matrix, detail)


def explain(streams: StreamPair, thorough: bool, start: FloatArray | None = None) -> Explanation:
    """Find the mistake that explains the streams, if one does.

    Parameters
    ----------
    streams : StreamPair
    thorough : bool
        Whether to try all wrong axes, too. It pays only if the angular rates agree.
    start : (4, 4) array, optional
        The extrinsic if the streams have no mistake.

    Raises
    ------
    NotEnoughDataError
        If the streams have too few motions in common.
    """
    failed: list[Explanation] = []
    for lag_s in LAGS_S:
        try:
            plain = _fitted(PLAIN, streams, lag_s, start)
            if start is not None and not plain.holds:
                plain = _fitted(PLAIN, streams, lag_s)
        except NotEnoughDataError as error:
            too_few = error
            continue
        # Streams of an arm, or on nearly flat ground, may agree in spite of one mistake.
        rivals = [each for each in _USUAL if len(each.mistakes) == 1 or not plain.holds]
        if not plain.holds:
            # If a body rotates about one of its sensors, the translations of that sensor are noise.
            in_one_unit = _fitted(PLAIN, streams, lag_s, same_unit=True)
            plain = in_one_unit if in_one_unit.holds else plain
        chosen = _or_rival(plain, rivals, streams, lag_s, _NOISY if thorough else HOLDS)
        if not chosen.holds and thorough and not failed:
            chosen = _or_rival(chosen, _axes(), streams, lag_s, HOLDS)
        if chosen.holds:
            doubts: list[Finding] = []
            hypothesis = chosen.hypothesis
            if {*dict(hypothesis.mistakes)} - {"inverse", "axes"}:
                chosen, doubts = _or_axes(chosen, streams, lag_s)
            found = attributed(chosen, streams, lag_s)
            return replace(found, findings=(*found.findings, *doubts))
        # Jumps affect long motions more than short ones.
        failed.append(chosen)
    if not failed:
        raise too_few
    best = min(failed, key=lambda tried: tried.fit.unexplained)
    unexplained = best.fit.unexplained
    if thorough and unexplained < _NOISY:
        noisy = attributed(best, streams, LAGS_S[0])
        findings = (*noisy.findings, finding("noisy", share=unexplained))
        return replace(noisy, findings=findings, limit=_NOISY)
    share = min(unexplained, 1.0)
    return replace(best, findings=(finding("unexplained", share=share),))


def _or_rival(
    plain: Explanation,
    rivals: Iterable[Hypothesis],
    streams: StreamPair,
    lag_s: float,
    limit: float,
) -> Explanation:
    """Return the simplest of the best rivals, or ``plain`` if no rival is decisively better."""
    most = min(limit, plain.fit.unexplained / _DECISIVE)
    if plain.fit.unexplained < EXPLAINED or not (best := _below(most, rivals, streams, lag_s)):
        return plain
    return _fitted(min(best, key=lambda each: each.complexity).hypothesis, streams, lag_s)


def _below(
    most: float, rivals: Iterable[Hypothesis], streams: StreamPair, lag_s: float
) -> list[Explanation]:
    """Return the best rivals: about equal, and with at most the share ``most`` unexplained."""
    pairs = streams.pairs(lag_s, _MAX_ROUGH)
    few = streams.synchronised[np.concatenate([pairs.i, pairs.j])]
    first = np.arange(len(pairs))
    tried: list[Explanation] = []
    for rival in rivals:
        poses = rival.corrected("parent", few.Ts_pw_p), rival.corrected("child", few.Ts_cw_c)
        motions = motion_pairs.pairs_between(*poses, first, first + len(pairs))
        # A fit is stopped early if its start leaves far more than ``most`` unexplained.
        tried.append(Explanation(rival, fit_similarity(motions, most=_DECISIVE * most)))
        most = min(most, _ABOUT_EQUAL * tried[-1].fit.unexplained)
    return [each for each in tried if each.fit.unexplained <= most]


def _fitted(
    hypothesis: Hypothesis,
    streams: StreamPair,
    lag_s: float,
    start: FloatArray | None = None,
    same_unit: bool = False,
) -> Explanation:
    pairs = hypothesis.undo(streams).pairs(lag_s, MAX_PAIRS)
    fit = fit_similarity(pairs, start=start, same_unit=same_unit)
    return Explanation(hypothesis, fit, same_unit=same_unit)


def _or_axes(
    chosen: Explanation, streams: StreamPair, lag_s: float
) -> tuple[Explanation, list[Finding]]:
    """Compare an explanation by orientations with explanations by wrong axes.

    Wrong axes are returned if they explain clearly more. If they explain about as much, the finding
    "ambiguous" is returned as well.
    """
    unexplained = chosen.fit.unexplained
    rivals = _below(_ABOUT_EQUAL * unexplained, _axes(), streams, lag_s)
    if not rivals:
        return chosen, []
    best = min(rivals, key=lambda each: each.complexity)
    if _ABOUT_EQUAL**0.5 * min(each.fit.unexplained for each in rivals) < unexplained:
        return _fitted(best.hypothesis, streams, lag_s), []
    detail = best.hypothesis.detail
    _, stream = best.hypothesis.mistakes[0]
    return chosen, [finding("ambiguous", stream, detail=detail)]


def _steadier(chosen: Explanation, streams: StreamPair, lag_s: float) -> tuple[Explanation, bool]:
    """Return an explanation in which both sensors travel in a steady direction, as on vehicles.

    If there is none, return the chosen explanation. The second value says whether the direction is
    steady, or cannot be judged.
    """
    if chosen.hypothesis.axes is not None or _EULER_ORDER in chosen.hypothesis.ways:
        return chosen, True
    both = streams.parent, streams.child
    few = [stream.poses[:: 1 + len(stream) // MAX_PAIRS] for stream in both]
    right = [[Hypothesis(way).corrected("parent", each) for way in _WAYS] for each in few]
    scatters = [[*map(trajectory.scatter_of_direction, each)] for each in right]
    scatter = dict(zip(_ALL_WAYS, np.maximum.outer(*scatters).flat, strict=True))
    of_chosen = scatter[chosen.hypothesis]
    least = min(scatter.values())
    if least < min(trajectory.STEADY, of_chosen / trajectory.CLEARLY):
        # Rounding makes the scatter of exact motion negative.
        limit = max(_ABOUT_EQUAL * least, 0.0)
        best = [way for way in _ALL_WAYS if scatter[way] <= limit]
        steady = _fitted(min(best, key=lambda each: each.complexity), streams, lag_s)
        if steady.holds:
            return steady, True
    return chosen, of_chosen < trajectory.STEADY


def attributed(explanation: Explanation, streams: StreamPair, lag_s: float) -> Explanation:
    """Choose between two readings that fit alike, and add the findings of the choice.

    The readings are the hypothesis, and the hypothesis with both streams inverted. The shape of the
    motion decides. If the other reading is possible, the explanation has :class:`Readings`, so that
    the noise of both readings can be compared later.
    """
    given = explanation.hypothesis
    explanation, is_settled = _steadier(explanation, streams, lag_s)
    hypothesis = explanation.hypothesis
    has_own_axes = hypothesis.axes is not None
    if has_own_axes or any("inverse_orientation" in way for way in hypothesis.ways):
        return replace(explanation, findings=findings_of(hypothesis))
    if is_settled:
        if hypothesis.is_upright and hypothesis == given:
            return replace(explanation, findings=findings_of(hypothesis))
        # A steady direction of travel is as clear evidence as paths can be.
        readings = Readings(
            hypotheses=(hypothesis.inverted(), hypothesis),
            shape=STEADY_SHAPE,
            paths=STEADY_SHAPE,
            is_small=False,
        )
        return replace(explanation, findings=findings_of(hypothesis), readings=readings.ordered())
    right = hypothesis.undo(streams)
    paths, arms = _evidence_for_inverse(right, explanation.fit)
    readings = Readings(
        hypotheses=(hypothesis, hypothesis.inverted()),
        shape=paths + arms,
        paths=paths,
        is_small=_may_be_an_arm(right),
    )
    if hypothesis.is_upright and readings.shape < 0.0:
        findings = findings_of(hypothesis)
        is_doubtful = readings.shape > _SUSPICIOUS
        return replace(explanation, findings=findings, readings=readings if is_doubtful else None)
    likelier = readings.hypotheses[int(readings.shape > 0.0)]
    if hypothesis.is_upright and not readings.is_clear:
        likelier = hypothesis
    if likelier is not hypothesis:
        explanation = _fitted(likelier, streams, lag_s)
    # Options are set only if the choice is clear.
    findings = findings_of(likelier, has_options=readings.is_clear or likelier.is_upright)
    if likelier.is_upright:
        options = conventions("inverse", "both")
        findings += (finding("inverse_both", "both", Severity.WARNING, options),)
    return replace(explanation, findings=findings, readings=readings.ordered())


def findings_of(hypothesis: Hypothesis, has_options: bool = True) -> tuple[Finding, ...]:
    """Return the findings of the mistakes of a hypothesis.

    Inverse poses have the options that repair them only with ``has_options``.
    """
    findings = []
    for code, stream in hypothesis.mistakes:
        key = "inverse_both" if (code, stream) == ("inverse", "both") else code
        options = conventions(code, stream) if has_options or code != "inverse" else {}
        findings.append(finding(key, stream, options=options, detail=hypothesis.detail))
    return tuple(findings)


def _may_be_an_arm(streams: StreamPair) -> bool:
    """Whether the streams are stops, or stay within the reach of an arm."""
    both = (streams.parent.poses, streams.child.poses)
    positions = [
        se3.translation_of(poses) for given in both for poses in (given, se3.inverse(given))
    ]
    return streams.is_slow or all(
        np.linalg.norm(each - medians(each.T), axis=1).max() < _REACH_M for each in positions
    )


def _evidence_for_inverse(right: StreamPair, fit: SimilarityFit) -> tuple[float, float]:
    """Return evidence for inverse poses: the log ratio of the paths, and half that of lever arms.

    A ratio is that of the streams as they are over both streams inverted. Some point of a body,
    such as an axle, has a short path. With inverse poses, the point is one of the world, seen from
    the body. Sensors that move around a point that they look at have such paths, too: the path of
    that point is less than half of their own.
    """
    logs = []
    for stream in (right.parent, right.child):
        poses = coarse(stream, LAGS_S[-1]).poses
        # Stops show only places, and not the motion between them.
        order = 2 if stream.interval_s < LAGS_S[-1] else 1
        least, of_origin = _least(poses, order)
        of_inverse, _ = _least(se3.inverse(poses), order)
        logs.append(np.log([least / of_inverse, least / of_origin]))
    paths, around = np.mean(logs, axis=0)
    looks_at_a_point = around < np.log(0.5)
    if looks_at_a_point and paths > 0.0:
        paths = max(paths - _OF_TARGET, 0.0)
    pairs = right.synchronised.child_scaled(fit.scale)
    worlds = pairs.Ts_pw_p @ fit.T_parent_child @ se3.inverse(pairs.Ts_cw_c)
    Ts = np.array([fit.T_parent_child, medians(np.moveaxis(worlds, 0, 2))])
    arms_m = np.maximum(np.linalg.norm(se3.translation_of(Ts), axis=1), _SHORTEST_ARM_M)
    angles_rad = se3.rotation_angle(se3.rotation_of(Ts))
    is_same = bool(((arms_m <= _SAME_FRAME_M) & (angles_rad <= _SAME_FRAME_RAD)).any())
    arms = 0.0 if is_same else 0.5 * np.log(arms_m[0] / arms_m[1])
    return float(paths), float(arms)


def _least(poses: FloatArray, order: int) -> tuple[float, float]:
    """Return the path (m) of the point of a body with the shortest path, and that of its origin.

    For ``order`` 2 the path is the sum of the changes of velocity instead of place.
    """
    changes = np.diff(poses[:, :3], order, axis=0)
    steps = changes[:, :, 3]
    chords = changes[:, :, :3]
    lengths = [np.linalg.norm(steps, axis=1) + 1e-9]
    for _ in range(_ROUNDS):
        least = 0.01 * median(lengths[-1])
        roots = np.sqrt(robust_weights("huber", (lengths[-1] / least) ** 2))
        rows = (roots[:, None, None] * chords).reshape(-1, 3)
        target = roots[:, None] * steps
        point = np.linalg.lstsq(rows, target.ravel(), rcond=1e-6)[0]
        lengths.append(np.linalg.norm(steps - chords @ point, axis=1) + 1e-9)
    sums = [float(each.sum()) for each in lengths]
    return min(sums), sums[0]
