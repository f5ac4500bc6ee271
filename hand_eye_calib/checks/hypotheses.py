"""Hypotheses about what is wrong with two streams: each undoes one usual mistake, and the fit that
follows shows whether the streams agree without it.

For every motion pair and any X, both sensors rotate through the same angle and move by the same
distance along the same screw axis. The robust fit of :mod:`~hand_eye_calib.alignment.similarity`
measures how much of the motion breaks this. The plain hypothesis, nothing is wrong, is kept unless
another leaves several times less of the motion unexplained.

Two inverted streams agree with each other as well as two correct ones: X is then the pose of one
world in the other. Path lengths tell them apart. The path of the world's origin, seen from a
rotating sensor, is longer than the sensor's own path, and the lever arm between the worlds is
longer than that between the sensors.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.alignment.similarity import EXPLAINED, SimilarityFit, fit_similarity
from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.checks.findings import Finding, Severity, conventions, finding
from hand_eye_calib.checks.streams import coarse
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.motion_pairs import MotionPairs, pairs_over
from hand_eye_calib.pairing.synchronise import PosePairs, synchronise
from hand_eye_calib.solvers.park import align_rotation_vectors
from hand_eye_calib.stats import median

# Motions over these times (s) are compared, the shorter ones only if the longer ones do not agree.
LAGS_S = (3.0, 1.0, 0.4)
MAX_PAIRS, _MAX_PAIRS_FOR_AXES = 400, 120
MIN_PAIRS = 12

# A hypothesis holds if it leaves at most this share of the motion unexplained. It replaces the
# plain one if it leaves this many times less.
HOLDS, _DECISIVE = 0.12, 3.0

# Largest unexplained share that noise can cause, in streams whose angular rates clearly agree.
_NOISY = 0.3

# Among hypotheses that are about equally good the simpler one is taken, and the child's rather than
# the parent's. A scale farther from 1 than this (logarithm) makes one less simple.
_ABOUT_EQUAL, _ODD_SCALE = 1.5, 0.05

# Evidence (in logarithms of lengths) from which on streams are called inverted, and likely so.
# Paths are over steps so coarse (s) that noise does not add to them. Frames this close (m, rad) may
# be one: of one world for both streams, the lever arm between the worlds says nothing.
_INVERTED, _LIKELY_INVERTED = 0.3, 1.0
_PATH_STEP_S, _SAME_FRAME = 0.3, 0.01

# An arm about its base, or a camera around its target, moves less than the base or target seen from
# it. Sensors that stay within this distance (m), an arm's reach, may be such; stops too.
_REACH_M = 3.0


@dataclass(frozen=True)
class StreamPair:
    """Two streams on about one clock, and the longest gap to interpolate across."""

    parent: Trajectory
    child: Trajectory
    max_gap_s: float

    @property
    def interval_s(self) -> float:
        """Median time between poses of the faster stream, s."""
        return min(self.parent.interval_s, self.child.interval_s)

    @property
    def are_slow(self) -> bool:
        """Whether nothing is interpolated between most poses of both streams."""
        return self.interval_s > self.max_gap_s

    def shifted(self, offset_s: float) -> "StreamPair":
        """The same with another clock of the child."""
        return replace(self, child=self.child.shifted(offset_s))

    @functools.cached_property
    def synchronised(self) -> PosePairs:
        """Poses of both at common stamps."""
        return synchronise(self.parent, self.child, self.max_gap_s)

    def pairs(self, lag_s: float, max_pairs: int) -> MotionPairs:
        """Motion pairs over ``lag_s`` seconds.

        Raises
        ------
        NotEnoughDataError
            If the streams have too few in common.
        """
        pairs = pairs_over(self.synchronised, lag_s, max_pairs)
        if len(pairs) < MIN_PAIRS:
            raise NotEnoughDataError(
                f"the streams have only {len(pairs)} motions over {lag_s:g} s in common"
            )
        return pairs


@dataclass(frozen=True)
class Hypothesis:
    """A mistake that ``correct`` undoes in a trajectory of a stream, "parent", "child" or "both".
    ``code`` is that of its finding, empty if nothing is wrong; ``complexity`` counts what is wrong;
    ``detail`` says of wrong axes what (x, y, z) should be.
    """

    code: str
    stream: str
    correct: Callable[[Trajectory], Trajectory]
    complexity: int = 1
    detail: str = ""

    def undo(self, streams: StreamPair) -> StreamPair:
        """Both streams without the mistake."""
        if not self.code:
            return streams
        parent, child = streams.parent, streams.child
        return replace(
            streams,
            parent=parent if self.stream == "child" else self.correct(parent),
            child=child if self.stream == "parent" else self.correct(child),
        )


@dataclass(frozen=True)
class Explanation:
    """A hypothesis with its fit, which holds below the unexplained share ``limit``; with
    ``same_unit`` its scale was kept at 1.
    """

    hypothesis: Hypothesis
    fit: SimilarityFit
    findings: tuple[Finding, ...] = ()
    limit: float = HOLDS
    same_unit: bool = False

    @property
    def holds(self) -> bool:
        """Whether the streams agree under the hypothesis."""
        return self.fit.unexplained < self.limit

    @property
    def complexity(self) -> tuple[int, int]:
        """Number of things that would have to be wrong; for equal numbers, the child's first."""
        odd_scale = abs(np.log(self.fit.scale)) > _ODD_SCALE
        by_stream = ("child", "parent", "both").index(self.hypothesis.stream)
        return self.hypothesis.complexity + int(odd_scale), by_stream


def _misread(trajectory: Trajectory, **convention: str) -> Trajectory:
    """The trajectory with its poses put right, but for its names."""
    return Trajectory(trajectory.stamps_ns, se3.put_right(trajectory.poses, **convention))


_reordered = functools.partial(_misread, quaternion="wxyz")
_inverted = functools.partial(_misread, invert="poses")
_orientations_inverted = functools.partial(_misread, invert="orientations")


def _with_axes(matrix: FloatArray, trajectory: Trajectory) -> Trajectory:
    poses = trajectory.poses.copy()
    poses[:, :3, 3] = poses[:, :3, 3] @ matrix.T
    return Trajectory(trajectory.stamps_ns, poses)


_MIRROR = -np.eye(3)
_PLAIN = Hypothesis("", "child", lambda trajectory: trajectory, 0)
_BOTH_INVERTED = Hypothesis("inverse_both", "both", _inverted)
_USUAL = [
    *(
        Hypothesis(code, stream, correct)
        for stream in ("child", "parent")
        for code, correct in (
            ("quaternion_order", _reordered),
            ("inverse", _inverted),
            ("left_handed", functools.partial(_with_axes, _MIRROR)),
        )
    ),
    # One exporter often writes both streams.
    Hypothesis("quaternion_order", "both", _reordered),
]

# Less usual, and on flat ground the same as two axes swapped.
_ORIENTATIONS = [
    Hypothesis("inverse_orientation", stream, _orientations_inverted, 2)
    for stream in ("child", "parent", "both")
]


def _axis_hypotheses() -> Iterator[Hypothesis]:
    """All permutations and flips of the axes of the positions, except the mirror of all three."""
    for order, signs in itertools.product(
        itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)
    ):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        n_changed = int(3 - np.isclose(matrix.diagonal(), 1.0).sum())
        parts = zip(order, signs, strict=True)
        detail = " ".join(f"{'-' * (sign < 0)}{'xyz'[k]}" for k, sign in parts)
        if n_changed and not np.array_equal(matrix, _MIRROR):
            correct = functools.partial(_with_axes, matrix)
            for stream in ("child", "parent"):
                yield Hypothesis("axes", stream, correct, n_changed, detail)


def explain(streams: StreamPair, thorough: bool) -> Explanation:
    """Find the mistake that explains the streams, or that none does; ``thorough`` if the angular
    rates agree, so that it pays to try wrong axes, too, which are many.

    Raises
    ------
    NotEnoughDataError
        If the streams have too few motions in common.
    """
    failed: list[Explanation] = []
    for lag_s in LAGS_S:
        try:
            chosen = _plain_or_usual(streams, lag_s, _NOISY if thorough else HOLDS)
        except NotEnoughDataError as error:
            too_few = error
            continue
        if not chosen.holds and thorough and not failed:
            chosen = _or_other_axes(chosen, streams, lag_s)
        if chosen.holds:
            return _attributed(chosen, streams)
        # Jumps spoil long motions more than short ones.
        failed.append(chosen)
    if not failed:
        raise too_few
    best = min(failed, key=lambda tried: tried.fit.unexplained)
    unexplained = best.fit.unexplained
    if thorough and unexplained < _NOISY:
        attributed = _attributed(best, streams)
        findings = (*attributed.findings, finding("noisy", share=unexplained))
        return replace(attributed, findings=findings, limit=_NOISY)
    share = min(unexplained, 1.0)
    text = f"no extrinsic, scale or usual mistake explains {share:.0%} of the motion"
    return replace(best, findings=(finding("unrelated", text=text, share=share),))


def _plain_or_usual(streams: StreamPair, lag_s: float, limit: float) -> Explanation:
    plain = _fitted(_PLAIN, streams, lag_s)
    if plain.fit.unexplained < EXPLAINED:
        return plain
    usual = _simplest_of_the_best([_fitted(hypothesis, streams, lag_s) for hypothesis in _USUAL])
    if _is_decisive(plain, usual, limit):
        return usual
    if plain.holds:
        return plain
    # A body that rotates about one of its sensors: that one's translations are noise.
    in_one_unit = _fitted(_PLAIN, streams, lag_s, same_unit=True)
    return in_one_unit if in_one_unit.holds else plain


def _or_other_axes(plain: Explanation, streams: StreamPair, lag_s: float) -> Explanation:
    """The explanation by wrong axes, or by inverted orientations, if it is decisive, otherwise the
    given one.
    """
    tried = [_fitted(hypothesis, streams, lag_s) for hypothesis in _ORIENTATIONS]
    # Wrong axes of the positions do not affect the rotations: they agree alone.
    pairs = streams.pairs(lag_s, MAX_PAIRS)
    T_rotation = se3.from_rotation_translation(align_rotation_vectors(pairs), np.zeros(3))
    errors = np.linalg.norm(pairs.residuals(T_rotation)[1], axis=1)
    angles = se3.rotation_angle(pairs.Ts_parenti_parentj[:, :3, :3])
    if median(errors) < 2 * HOLDS * np.sqrt(np.mean(angles**2)):
        start = replace(plain.fit, T_parent_child=T_rotation)
        tried = [
            _fitted(hypothesis, streams, lag_s, _MAX_PAIRS_FOR_AXES, start)
            for hypothesis in _axis_hypotheses()
        ] + tried
    best = _simplest_of_the_best(tried)
    return best if _is_decisive(plain, best, HOLDS) else plain


def _fitted(
    hypothesis: Hypothesis,
    streams: StreamPair,
    lag_s: float,
    max_pairs: int = MAX_PAIRS,
    start: SimilarityFit | None = None,
    same_unit: bool = False,
) -> Explanation:
    pairs = hypothesis.undo(streams).pairs(lag_s, max_pairs)
    fit = fit_similarity(pairs, start=start, same_unit=same_unit)
    return Explanation(hypothesis, fit, same_unit=same_unit)


def _simplest_of_the_best(explanations: Sequence[Explanation]) -> Explanation:
    limit = _ABOUT_EQUAL * min(explanation.fit.unexplained for explanation in explanations)
    best = [explanation for explanation in explanations if explanation.fit.unexplained <= limit]
    return min(best, key=lambda explanation: explanation.complexity)


def _is_decisive(plain: Explanation, rival: Explanation, limit: float) -> bool:
    unexplained = rival.fit.unexplained
    return unexplained < limit and _DECISIVE * unexplained < plain.fit.unexplained


def _attributed(explanation: Explanation, streams: StreamPair) -> Explanation:
    """The explanation with its finding, after deciding by path lengths which stream is inverted, or
    both: the fits do not differ.
    """
    code, stream = explanation.hypothesis.code, explanation.hypothesis.stream
    if code not in ("", "inverse"):
        detail, options = explanation.hypothesis.detail, conventions(code, stream)
        found = finding(code, stream, options=options, detail=detail)
        return replace(explanation, findings=(found,))
    evidence, inverted = _evidence_for_inverse(streams, explanation)
    if code:
        fit = explanation.fit
        if evidence >= _INVERTED:
            stream, fit = ("parent" if stream == "child" else "child"), inverted
        # An option mends only what is clear.
        options = conventions(code, stream) if abs(evidence) > _INVERTED else {}
        found = finding(code, stream, options=options)
        hypothesis = Hypothesis(code, stream, _inverted)
        return replace(explanation, hypothesis=hypothesis, fit=fit, findings=(found,))
    if evidence < _INVERTED:
        return explanation
    if evidence <= _LIKELY_INVERTED or _may_be_an_arm(streams):
        found = finding("inverse_both", "both", Severity.WARNING)
        return replace(explanation, findings=(found,))
    found = finding("inverse_both", options=conventions("inverse", "both"))
    return Explanation(_BOTH_INVERTED, inverted, (found,))


def _may_be_an_arm(streams: StreamPair) -> bool:
    """Whether inverse poses may be right, or path lengths deceive: stops, or a small space."""
    both = (streams.parent.poses, streams.child.poses)
    positions = [poses[:, :3, 3] for given in both for poses in (given, se3.inverse(given))]
    return streams.are_slow or all(
        np.linalg.norm(each - np.median(each, axis=0), axis=1).max() < _REACH_M
        for each in positions
    )


def _evidence_for_inverse(
    streams: StreamPair, explanation: Explanation
) -> tuple[float, SimilarityFit]:
    """Sum of logarithms by which paths and lever arm are shorter with both streams inverted, and
    the fit then: its X is the pose of the child's world in the parent's.
    """
    streams, fit = explanation.hypothesis.undo(streams), explanation.fit
    evidence = 0.0
    for stream in (streams.parent, streams.child):
        poses = coarse(stream, _PATH_STEP_S).poses
        evidence += float(np.log(_path_m(poses) / _path_m(se3.inverse(poses))))
    pairs, Ts_c_cw = streams.synchronised, se3.inverse(streams.synchronised.Ts_cw_c)
    Ts_c_cw[:, :3, 3] *= fit.scale
    worlds = pairs.Ts_pw_p @ fit.T_parent_child @ Ts_c_cw
    off = np.linalg.norm(worlds[:, :3, 3] - np.median(worlds[:, :3, 3], axis=0), axis=1)
    inverted = replace(fit, T_parent_child=worlds[np.argmin(off)])
    Ts = np.array([fit.T_parent_child, inverted.T_parent_child])
    arms_m = np.maximum(np.linalg.norm(Ts[:, :3, 3], axis=1), _SAME_FRAME)
    if (np.maximum(arms_m, se3.rotation_angle(Ts[:, :3, :3])) > _SAME_FRAME).all():
        evidence += 0.5 * float(np.log(arms_m[0] / arms_m[1]))
    return evidence, inverted


def _path_m(poses: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()) + 1e-9
