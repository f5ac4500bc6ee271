"""Hypotheses about what is wrong with two streams: each undoes one usual mistake, and the fit that
follows shows whether the streams agree without it.

For every motion pair and any X, both sensors rotate through the same angle and move by the same
distance along the same screw axis. The robust fit of
:mod:`~hand_eye_calib.core.alignment.similarity` measures how much of the motion breaks this. The
plain hypothesis, nothing is wrong, is kept unless another leaves several times less of the motion
unexplained.

Two inverted streams agree with each other as well as two correct ones: X is then the pose of one
world in the other. Vehicles move in a steady direction of their own. Of other bodies, some point
moves less than any point of the world does, seen from the sensor; and the lever arm between the
worlds is longer than that between the sensors.
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

# Motions over these times (s) are compared, the shorter ones only if the longer ones do not agree;
# so many at most, and to see which mistake it is.
LAGS_S = (3.0, 1.0, 0.4)
MAX_PAIRS = 400
_MAX_ROUGH = 120
MIN_PAIRS = 12

# Largest angle (rad) of a rotation vector: near half a turn its sign is ambiguous.
MAX_ROTATION_RAD = 2.8

# A hypothesis holds if it leaves at most this share of the motion unexplained. If the plain one
# does not hold, another replaces it that leaves this many times less.
HOLDS = 0.12
_DECISIVE = 2.0

# Largest unexplained share that noise can cause, in streams whose angular rates clearly agree.
_NOISY = 0.3

# Among hypotheses that are about equally good the simpler one is taken, and the child's rather than
# the parent's. A scale farther from 1 than this (logarithm) makes one less simple.
_ABOUT_EQUAL = 1.5
_ODD_SCALE = 0.05

# Shape of the motion: the sum of the logarithms of paths and of lever arms. In 190 right recordings
# (KinHEC, real, simulated) it was -0.25 at most, and below -0.4 in all but six; inverted, it has
# the other sign. Another reading is considered above the first; the second decides where the noise
# does not.
_SUSPICIOUS = -0.2
CLEAR_SHAPE = 0.4
# Paths say less by this much if the sensors look at a point. A camera around its target had 0.4.
_OF_TARGET = 0.5
# What counts as the shape where a steady direction of travel decides.
STEADY_SHAPE = 1.0

# Rounds of weights of the shortest path.
_ROUNDS = 5

# Frames with parallel axes this close (m, rad) may be one: hardly two sensors are. Of one world for
# both streams, the lever arm between the worlds says nothing.
_SAME_FRAME_M = 0.03
_SAME_FRAME_RAD = 0.01
# Shortest lever arm (m) that is compared.
_SHORTEST_ARM_M = 0.01

# An arm about its base may move more than the base seen from it. Sensors that stay within this
# distance (m), an arm's reach, may be such; stops too.
_REACH_M = 3.0


@dataclass(frozen=True)
class StreamPair:
    """Two streams on about one clock, and the longest gap to interpolate across."""

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
        """Correlation of the angular rates of both."""
        return correlate_rates(self.parent, self.child, self.max_gap_s)

    def shifted(self, offset_s: float) -> "StreamPair":
        """The pair with ``offset_s`` added to the child's stamps."""
        return replace(self, child=self.child.shifted(offset_s))

    @cached_property
    def synchronised(self) -> motion_pairs.PosePairs:
        """Poses of both at common stamps."""
        return motion_pairs.synchronise(self.parent, self.child, self.max_gap_s)

    def pairs(self, lag_s: float, max_pairs: int) -> motion_pairs.MotionPairs:
        """Motion pairs over ``lag_s`` seconds.

        Raises
        ------
        NotEnoughDataError
            If the streams have too few in common.
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
    """What is wrong with each stream, as codes of findings. ``axes`` (3, 3) undoes wrong axes,
    which ``detail`` names as what (x, y, z) should be.
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
        """Code and stream of each mistake; one exporter often makes it in "both"."""
        streams = {(False, True): "child", (True, False): "parent", (True, True): "both"}
        codes = dict.fromkeys((*self.parent, *self.child))
        return [(code, streams[code in self.parent, code in self.child]) for code in codes]

    @property
    def complexity(self) -> tuple[int, int]:
        """How many mistakes there are, those of axes by how many are wrong; for equal numbers, the
        child's come first.
        """
        n_axes = 0 if self.axes is None else int((self.axes != np.eye(3)).any(axis=1).sum())
        return len(self.mistakes) + n_axes, 2 * len(self.parent) + len(self.child)

    def corrected(self, stream: str, poses: FloatArray) -> FloatArray:
        """The poses (N, 4, 4) of a stream without its mistakes."""
        way = self.child if stream == "child" else self.parent
        if way and self.axes is not None:
            return se3.from_rotation_translation(poses[:, :3, :3], poses[:, :3, 3] @ self.axes.T)
        if way == _EULER_ORDER:
            rotations = se3.in_other_order(poses[:, :3, :3])
            return se3.from_rotation_translation(rotations, poses[:, :3, 3])
        return se3.put_right(poses, **dict(map(CONVENTIONS.__getitem__, way)))

    def undo(self, streams: StreamPair) -> StreamPair:
        """Both streams without the mistakes."""
        if self is PLAIN:
            return streams
        given = (("parent", streams.parent), ("child", streams.child))
        right = {name: replace(one, poses=self.corrected(name, one.poses)) for name, one in given}
        return replace(streams, parent=right["parent"], child=right["child"])

    def inverted(self) -> "Hypothesis":
        """The one with both streams inverted besides, which fits as well."""
        parent, child = (
            tuple([code for code in CONVENTIONS if (code in way) != (code == "inverse")])
            for way in (self.parent, self.child)
        )
        return Hypothesis(parent, child)


@dataclass(frozen=True, kw_only=True)
class Readings:
    """Two hypotheses that fit alike, as the second inverts both streams besides.

    Attributes
    ----------
    hypotheses : tuple of two Hypothesis
        The first is the upright one, if there is one.
    shape : float
        By how much the shape of the motion speaks for the second: the sum of the logarithms of
        paths and lever arms.
    paths : float
        The part of the paths.
    is_small : bool
        Whether all sensors stay within the reach of an arm. Inverse poses may be right there: those
        of an arm beside a fixed camera.
    """

    hypotheses: tuple["Hypothesis", "Hypothesis"]
    shape: float
    paths: float
    is_small: bool

    @property
    def by_shape(self) -> int:
        """1 if the shape speaks clearly for the second reading, -1 for the first, 0 for neither."""
        return int(np.sign(self.shape)) if abs(self.shape) > CLEAR_SHAPE else 0

    @property
    def is_clear(self) -> bool:
        """Whether the shape decides: not if a fixed camera beside an arm would explain it, too."""
        is_fixed_camera = self.is_small and self.hypotheses[0].is_upright and self.shape > 0.0
        return self.by_shape != 0 and not is_fixed_camera

    def ordered(self) -> "Readings":
        """The same readings, the upright one first."""
        first, second = self.hypotheses
        if not second.is_upright:
            return self
        return replace(self, hypotheses=(second, first), shape=-self.shape, paths=-self.paths)


@dataclass(frozen=True)
class Explanation:
    """A hypothesis with its fit, which holds below the unexplained share ``limit``; with
    ``same_unit`` its scale was kept at 1. ``readings`` are there if another one may be right.
    """

    hypothesis: Hypothesis
    fit: SimilarityFit
    findings: tuple[Finding, ...] = ()
    limit: float = HOLDS
    same_unit: bool = False
    readings: Readings | None = None

    @property
    def may_be_upright(self) -> bool:
        """Whether another reading is open, and the streams may be right as they are."""
        return self.readings is not None and self.readings.hypotheses[0].is_upright

    @property
    def holds(self) -> bool:
        """Whether the streams agree under the hypothesis."""
        return self.fit.unexplained < self.limit

    @property
    def complexity(self) -> tuple[int, int]:
        """That of the hypothesis; an odd scale is one more mistake."""
        n_mistakes, of_streams = self.hypothesis.complexity
        return n_mistakes + int(abs(np.log(self.fit.scale)) > _ODD_SCALE), of_streams


_MIRROR = -np.eye(3)
# Orientations that are inverted and written w x y z are those of other axes.
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


# Those that invert both streams besides fit about as well.
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
    """Find the mistake that explains the streams, or that none does; ``thorough`` if the angular
    rates agree, so that it pays to try wrong axes, too, which are many. ``start`` (4, 4) is the
    extrinsic if the streams are as they should be.

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
        # Streams that nearly agree may have one mistake: an arm's, or one on nearly flat ground.
        rivals = [each for each in _USUAL if len(each.mistakes) == 1 or not plain.holds]
        if not plain.holds:
            # A body that rotates about one of its sensors: that one's translations are noise.
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
        # Jumps spoil long motions more than short ones.
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
    """The simplest of the rivals that explain the motion best, if they are decisively better."""
    most = min(limit, plain.fit.unexplained / _DECISIVE)
    if plain.fit.unexplained < EXPLAINED or not (best := _below(most, rivals, streams, lag_s)):
        return plain
    return _fitted(min(best, key=lambda each: each.complexity).hypothesis, streams, lag_s)


def _below(
    most: float, rivals: Iterable[Hypothesis], streams: StreamPair, lag_s: float
) -> list[Explanation]:
    """The best of the rivals, and those about as good, that leave less than this unexplained."""
    pairs = streams.pairs(lag_s, _MAX_ROUGH)
    few = streams.synchronised[np.concatenate([pairs.i, pairs.j])]
    first = np.arange(len(pairs))
    tried: list[Explanation] = []
    for rival in rivals:
        poses = rival.corrected("parent", few.Ts_pw_p), rival.corrected("child", few.Ts_cw_c)
        motions = motion_pairs.pairs_between(*poses, first, first + len(pairs))
        # The start of a fit leaves about as much as the fit.
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
    """The explanation by other orientations, but wrong axes if they explain clearly more; or the
    finding that they would explain about as much.
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
    """The explanation, or one that holds, too, with which both sensors move in a steady direction
    of their own, as those of vehicles do; and whether they do.
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
    """Add the findings of an explanation, after a choice between two readings that fit alike: the
    hypothesis, and both streams inverted besides.

    The shape of the motion chooses here. Where another reading is possible, the explanation has
    :class:`Readings`, so that the noise can be compared as well.
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
        # A steady direction of travel speaks for the hypothesis as clearly as paths ever do.
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
    # An option repairs only what is clear.
    findings = findings_of(likelier, has_options=readings.is_clear or likelier.is_upright)
    if likelier.is_upright:
        options = conventions("inverse", "both")
        findings += (finding("inverse_both", "both", Severity.WARNING, options),)
    return replace(explanation, findings=findings, readings=readings.ordered())


def findings_of(hypothesis: Hypothesis, has_options: bool = True) -> tuple[Finding, ...]:
    """Return the findings of the mistakes of a hypothesis; inverse poses without the options that
    repair them unless ``has_options``.
    """
    findings = []
    for code, stream in hypothesis.mistakes:
        key = "inverse_both" if (code, stream) == ("inverse", "both") else code
        options = conventions(code, stream) if has_options or code != "inverse" else {}
        findings.append(finding(key, stream, options=options, detail=hypothesis.detail))
    return tuple(findings)


def _may_be_an_arm(streams: StreamPair) -> bool:
    """Whether inverse poses may be right, or paths deceive: stops, or a small space."""
    both = (streams.parent.poses, streams.child.poses)
    positions = [poses[:, :3, 3] for given in both for poses in (given, se3.inverse(given))]
    return streams.is_slow or all(
        np.linalg.norm(each - medians(each.T), axis=1).max() < _REACH_M for each in positions
    )


def _evidence_for_inverse(right: StreamPair, fit: SimilarityFit) -> tuple[float, float]:
    """Return the logarithms by which the paths, and half of that by which the lever arm, are
    shorter with both streams inverted.

    A body moves little beside some point of its own, such as an axle. The inverse of its path is
    that of some point of the world, seen from the body. Sensors that move around a point that they
    look at have paths like those of inverse poses: less than half of their path is that point's.
    """
    logs = []
    for stream in (right.parent, right.child):
        poses = coarse(stream, LAGS_S[-1]).poses
        # Of stops only their places are known, not how it moves between them.
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
    arms_m = np.maximum(np.linalg.norm(Ts[:, :3, 3], axis=1), _SHORTEST_ARM_M)
    angles_rad = se3.rotation_angle(Ts[:, :3, :3])
    is_same = bool(((arms_m <= _SAME_FRAME_M) & (angles_rad <= _SAME_FRAME_RAD)).any())
    arms = 0.0 if is_same else 0.5 * np.log(arms_m[0] / arms_m[1])
    return float(paths), float(arms)


def _least(poses: FloatArray, order: int) -> tuple[float, float]:
    """Return the sums of the changes of place (m), or of velocity for order 2, of the point that is
    fixed to a body with these poses and has the least, and of its origin.
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
