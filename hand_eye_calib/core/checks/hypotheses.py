"""Hypotheses about mistakes in two streams.

Each hypothesis undoes one usual mistake, and a fit measures whether the streams agree without it.

Model: in every motion pair, whatever X is, both sensors rotate through the same angle and move by
the same distance along the same screw axis. The robust fit of
:mod:`~hand_eye_calib.core.alignment.similarity` measures the share of the motion that breaks this
rule. The plain hypothesis (no mistake) is rejected only if another hypothesis leaves several times
less of the motion unexplained.

Two inverted streams agree as well as two correct ones. X is then the pose of one world in the
other. Three properties of the motion decide between both readings:

- Vehicles travel in a steady direction in their own frame.
- On other bodies, some point of the body has a shorter path than any point of the world has in the
  frame of the sensor.
- The lever arm between the worlds is longer than the lever arm between the sensors.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.alignment.similarity import EXPLAINED, SimilarityFit, fit_similarity
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.checks.findings import (
    CONVENTIONS,
    Finding,
    Severity,
    conventions,
    finding,
)
from hand_eye_calib.core.checks.shape import evidence_for_inverse, may_be_an_arm
from hand_eye_calib.core.checks.stream_pair import LAGS_S, MAX_PAIRS, StreamPair
from hand_eye_calib.core.geometry import se3, trajectory
from hand_eye_calib.core.pairing import motion_pairs

# Most motions in the rough fits that rank the hypotheses.
_MAX_ROUGH = 120
# A hypothesis holds if it leaves at most this share of the motion unexplained.
HOLDS = 0.12
# Another hypothesis replaces a plain one that does not hold if it leaves this many times less.
_DECISIVE = 2.0

# Largest unexplained share that noise can cause, in streams whose angular rates clearly agree.
_NOISY = 0.3

# Two hypotheses are equally good if their unexplained shares differ by less than this factor. The
# simpler hypothesis is then preferred, and a mistake of the child to a mistake of the parent.
_ABOUT_EQUAL = 1.5
# A scale farther from 1 than this (in the logarithm) counts as one more mistake.
_ODD_SCALE = 0.05

# Shape of the motion: the sum of the log ratios of the paths and of the lever arms. The shape of
# 190 correct recordings (KinHEC, real, simulated) was -0.25 at most, and below -0.4 in all but six.
# Inverse streams have the other sign.
# The reading with both streams inverted is considered above this shape.
_SUSPICIOUS = -0.2
# The shape decides between two readings from this size on, if the noise does not decide.
CLEAR_SHAPE = 0.4
# Shape if a steady direction of travel decides.
STEADY_SHAPE = 1.0

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
    def is_uninverted(self) -> bool:
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
        parent = self.corrected("parent", streams.parent.poses)
        child = self.corrected("child", streams.child.poses)
        return replace(
            streams,
            parent=replace(streams.parent, poses=parent),
            child=replace(streams.child, poses=child),
        )

    def inverted(self) -> "Hypothesis":
        """Return the hypothesis that also inverts both streams. It fits equally well."""
        return Hypothesis(_inverted_way(self.parent), _inverted_way(self.child))


def _inverted_way(way: _Way) -> _Way:
    """Return the mistakes of a stream whose poses are inverted beside its other mistakes."""
    return tuple([code for code in CONVENTIONS if (code in way) != (code == "inverse")])


@dataclass(frozen=True, kw_only=True)
class Readings:
    """Two hypotheses that fit alike: the second one also inverts both streams.

    Attributes
    ----------
    hypotheses : tuple of two Hypothesis
        A hypothesis that inverts neither stream is the first.
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
        is_fixed_camera = self.is_small and self.hypotheses[0].is_uninverted and self.shape > 0.0
        return self.by_shape != 0 and not is_fixed_camera

    def ordered(self) -> "Readings":
        """Return the readings with the uninverted one first."""
        first, second = self.hypotheses
        if not second.is_uninverted:
            return self
        return replace(self, hypotheses=(second, first), shape=-self.shape, paths=-self.paths)


@dataclass(frozen=True)
class Explanation:
    """A hypothesis with its fit.

    Attributes
    ----------
    hypothesis : Hypothesis
    fit : SimilarityFit
    findings : tuple of Finding
        Findings about the mistakes of the hypothesis.
    limit : float
        The hypothesis holds below this unexplained share.
    same_unit : bool
        Whether the scale of the fit was fixed to 1.
    readings : Readings or None
        Two readings of the streams, if another reading may be right.
    """

    hypothesis: Hypothesis
    fit: SimilarityFit
    findings: tuple[Finding, ...] = ()
    limit: float = HOLDS
    same_unit: bool = False
    readings: Readings | None = None

    @property
    def may_be_uninverted(self) -> bool:
        """Whether two readings are possible, and the first one inverts neither stream."""
        return self.readings is not None and self.readings.hypotheses[0].is_uninverted

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
_ALL_WAYS = [
    Hypothesis(way_of_parent, way_of_child) for way_of_parent in _WAYS for way_of_child in _WAYS
]
PLAIN = _ALL_WAYS[0]


# Hypotheses that also invert both streams are missing: they fit equally well.
_USUAL = [
    *(way for way in _ALL_WAYS[1:] if ("inverse", "both") not in way.mistakes),
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
        if np.array_equal(matrix, np.eye(3)) or np.array_equal(matrix, _MIRROR):
            continue
        names = []
        for axis, sign in zip(order, signs, strict=True):
            name = "xyz"[axis]
            names.append(name if sign > 0 else f"-{name}")
        detail = " ".join(names)
        yield Hypothesis((), ("axes",), matrix, detail)
        yield Hypothesis(("axes",), (), matrix, detail)


def explain(streams: StreamPair, thorough: bool, start: FloatArray | None = None) -> Explanation:
    """Find the mistake that explains the streams, if one does.

    Parameters
    ----------
    streams : StreamPair
    thorough : bool
        Whether to try all wrong axes, too. That is useful only if the angular rates agree.
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
            plain = _plain(streams, lag_s, start)
        except NotEnoughDataError as error:
            too_few = error
            continue
        chosen = _or_usual_mistake(plain, streams, lag_s, thorough)
        if not chosen.holds and thorough and not failed:
            chosen = _or_rival(chosen, _axes(), streams, lag_s, HOLDS)
        if chosen.holds:
            return _with_findings(chosen, streams, lag_s)
        # Jumps affect long motions more than short ones.
        failed.append(chosen)
    if not failed:
        raise too_few
    best = min(failed, key=lambda explanation: explanation.fit.unexplained)
    return _unexplained(best, streams, thorough)


def _plain(streams: StreamPair, lag_s: float, start: FloatArray | None) -> Explanation:
    """Return the fit of the streams as they are, from a start if it leads to a good fit."""
    plain = _fitted(PLAIN, streams, lag_s, start)
    if start is not None and not plain.holds:
        plain = _fitted(PLAIN, streams, lag_s)
    return plain


def _or_usual_mistake(
    plain: Explanation, streams: StreamPair, lag_s: float, thorough: bool
) -> Explanation:
    """Return the explanation by a usual mistake, or ``plain`` if no mistake explains more."""
    if plain.holds:
        # Streams of an arm, or on nearly flat ground, may agree in spite of one mistake.
        rivals = [hypothesis for hypothesis in _USUAL if len(hypothesis.mistakes) == 1]
    else:
        rivals = _USUAL
        # If a body rotates about one of its sensors, the translations of that sensor are noise.
        in_one_unit = _fitted(PLAIN, streams, lag_s, same_unit=True)
        if in_one_unit.holds:
            plain = in_one_unit
    limit = _NOISY if thorough else HOLDS
    return _or_rival(plain, rivals, streams, lag_s, limit)


def _with_findings(chosen: Explanation, streams: StreamPair, lag_s: float) -> Explanation:
    """Return an explanation that holds, in the likelier reading, with all its findings."""
    doubts: list[Finding] = []
    codes = {code for code, _ in chosen.hypothesis.mistakes}
    if codes - {"inverse", "axes"}:
        chosen, doubts = _or_axes(chosen, streams, lag_s)
    explanation = attributed(chosen, streams, lag_s)
    return replace(explanation, findings=(*explanation.findings, *doubts))


def _unexplained(best: Explanation, streams: StreamPair, thorough: bool) -> Explanation:
    """Return the best explanation that does not hold, with the finding about the share it leaves.

    A small share may be noise if the search was thorough: the explanation then holds.
    """
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
    if plain.fit.unexplained < EXPLAINED:
        return plain
    most = min(limit, plain.fit.unexplained / _DECISIVE)
    best = _below(most, rivals, streams, lag_s)
    if not best:
        return plain
    return _fitted(_simplest(best).hypothesis, streams, lag_s)


def _simplest(explanations: Sequence[Explanation]) -> Explanation:
    """Return the explanation with the fewest mistakes."""
    return min(explanations, key=lambda explanation: explanation.complexity)


def _below(
    most: float, rivals: Iterable[Hypothesis], streams: StreamPair, lag_s: float
) -> list[Explanation]:
    """Return the best rivals: about equal, and with at most the share ``most`` unexplained."""
    pairs = streams.pairs(lag_s, _MAX_ROUGH)
    few = streams.synchronised[np.concatenate([pairs.i, pairs.j])]
    first = np.arange(len(pairs))
    tried: list[Explanation] = []
    for rival in rivals:
        parent = rival.corrected("parent", few.Ts_pw_p)
        child = rival.corrected("child", few.Ts_cw_c)
        motions = motion_pairs.pairs_between(parent, child, first, first + len(pairs))
        # A fit is stopped early if its start leaves far more than ``most`` unexplained.
        fit = fit_similarity(motions, max_unexplained=_DECISIVE * most)
        tried.append(Explanation(rival, fit))
        most = min(most, _ABOUT_EQUAL * fit.unexplained)
    return [explanation for explanation in tried if explanation.fit.unexplained <= most]


def _fitted(
    hypothesis: Hypothesis,
    streams: StreamPair,
    lag_s: float,
    start: FloatArray | None = None,
    same_unit: bool = False,
) -> Explanation:
    """Return the fit of the streams without the mistakes of a hypothesis."""
    pairs = hypothesis.undo(streams).pairs(lag_s, MAX_PAIRS)
    fit = fit_similarity(pairs, start=start, same_unit=same_unit)
    return Explanation(hypothesis, fit, same_unit=same_unit)


def _or_axes(
    chosen: Explanation, streams: StreamPair, lag_s: float
) -> tuple[Explanation, list[Finding]]:
    """Compare an explanation by orientations with explanations by wrong axes.

    An explanation by wrong axes is returned if it explains clearly more. If it explains about as
    much, the finding "ambiguous" is returned as well.
    """
    unexplained = chosen.fit.unexplained
    rivals = _below(_ABOUT_EQUAL * unexplained, _axes(), streams, lag_s)
    if not rivals:
        return chosen, []
    simplest = _simplest(rivals).hypothesis
    if _ABOUT_EQUAL**0.5 * min(rival.fit.unexplained for rival in rivals) < unexplained:
        return _fitted(simplest, streams, lag_s), []
    _, stream = simplest.mistakes[0]
    return chosen, [finding("ambiguous", stream, detail=simplest.detail)]


def _steadier(chosen: Explanation, streams: StreamPair, lag_s: float) -> tuple[Explanation, bool]:
    """Return an explanation in which both sensors travel in a steady direction, as on vehicles.

    The chosen explanation is returned if no other one is steadier. The second value says whether
    the direction is steady, or cannot be judged.
    """
    if chosen.hypothesis.axes is not None or _EULER_ORDER in chosen.hypothesis.ways:
        return chosen, True
    scatters = np.maximum.outer(_scatters(streams.parent), _scatters(streams.child))
    scatter = dict(zip(_ALL_WAYS, scatters.flat, strict=True))
    scatter_of_chosen = scatter[chosen.hypothesis]
    smallest = min(scatter.values())
    if smallest < min(trajectory.STEADY, scatter_of_chosen / trajectory.CLEARLY):
        # Rounding makes the scatter of exact motion negative.
        limit = max(_ABOUT_EQUAL * smallest, 0.0)
        steadiest = [way for way in _ALL_WAYS if scatter[way] <= limit]
        simplest = min(steadiest, key=lambda hypothesis: hypothesis.complexity)
        steady = _fitted(simplest, streams, lag_s)
        if steady.holds:
            return steady, True
    return chosen, scatter_of_chosen < trajectory.STEADY


def _scatters(stream: trajectory.Trajectory) -> list[float]:
    """Return the scatter of the direction of travel without the mistakes of each way."""
    poses = stream.poses[:: 1 + len(stream) // MAX_PAIRS]
    return [
        trajectory.scatter_of_direction(Hypothesis(way).corrected("parent", poses)) for way in _WAYS
    ]


def attributed(explanation: Explanation, streams: StreamPair, lag_s: float) -> Explanation:
    """Choose between two readings that fit alike, and add the findings of the choice.

    The readings are the hypothesis, and the hypothesis with both streams inverted. The shape of the
    motion decides. If the other reading is possible, the explanation has :class:`Readings`, so that
    the noise of both readings can be compared later.
    """
    former = explanation.hypothesis
    explanation, is_settled = _steadier(explanation, streams, lag_s)
    hypothesis = explanation.hypothesis
    is_uninverted_as_before = hypothesis.is_uninverted and hypothesis == former
    if _has_one_reading(hypothesis) or (is_settled and is_uninverted_as_before):
        return replace(explanation, findings=findings_of(hypothesis))
    if is_settled:
        # A steady direction of travel is as clear evidence as paths can be.
        readings = Readings(
            hypotheses=(hypothesis.inverted(), hypothesis),
            shape=STEADY_SHAPE,
            paths=STEADY_SHAPE,
            is_small=False,
        )
        return replace(explanation, findings=findings_of(hypothesis), readings=readings.ordered())
    readings = _readings(explanation, streams)
    if hypothesis.is_uninverted and readings.shape < 0.0:
        findings = findings_of(hypothesis)
        is_doubtful = readings.shape > _SUSPICIOUS
        return replace(explanation, findings=findings, readings=readings if is_doubtful else None)
    return _in_likelier_reading(explanation, readings, streams, lag_s)


def _has_one_reading(hypothesis: Hypothesis) -> bool:
    """Return whether the same hypothesis with both streams inverted is no rival."""
    if hypothesis.axes is not None:
        return True
    return any("inverse_orientation" in way for way in hypothesis.ways)


def _readings(explanation: Explanation, streams: StreamPair) -> Readings:
    """Return a hypothesis and its inverse, with the evidence of the shape of the motion."""
    hypothesis = explanation.hypothesis
    right = hypothesis.undo(streams)
    paths, arms = evidence_for_inverse(right, explanation.fit)
    return Readings(
        hypotheses=(hypothesis, hypothesis.inverted()),
        shape=paths + arms,
        paths=paths,
        is_small=may_be_an_arm(right),
    )


def _in_likelier_reading(
    explanation: Explanation, readings: Readings, streams: StreamPair, lag_s: float
) -> Explanation:
    """Return the explanation in the likelier of two readings, with its findings."""
    hypothesis = explanation.hypothesis
    likelier = readings.hypotheses[int(readings.shape > 0.0)]
    if hypothesis.is_uninverted and not readings.is_clear:
        likelier = hypothesis
    if likelier is not hypothesis:
        explanation = _fitted(likelier, streams, lag_s)
    # Options are set only if the choice is clear.
    findings = findings_of(likelier, has_options=readings.is_clear or likelier.is_uninverted)
    if likelier.is_uninverted:
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
