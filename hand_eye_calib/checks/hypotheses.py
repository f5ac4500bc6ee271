"""Hypotheses about what is wrong with two streams: each undoes one usual mistake, and the fit that
follows shows whether the streams agree without it.

For every motion pair and any X, both sensors rotate through the same angle and move by the same
distance along the same screw axis. The robust fit of :mod:`~hand_eye_calib.alignment.similarity`
measures how much of the motion breaks this. The plain hypothesis, nothing is wrong, is kept unless
another leaves several times less of the motion unexplained. Before a fit, a closed form says about
how much another one leaves: a fit that cannot win is not made.

Two inverted streams agree with each other as well as two correct ones: X is then the pose of one
world in the other. Path lengths tell them apart. The path of the world's origin, seen from a
rotating sensor, is longer than the sensor's own path, and the lever arm between the worlds is
longer than that between the sensors.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from hand_eye_calib.alignment.similarity import EXPLAINED, SimilarityFit, fit_similarity
from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.checks.findings import LIMITS, Finding, Severity, conventions, finding
from hand_eye_calib.checks.streams import PATH_STEP_S, coarse
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    motions,
    pairs_over,
    synchronise,
)
from hand_eye_calib.stats import medians, robust_sigma

# Motions over these times (s) are compared, the shorter ones only if the longer ones do not agree;
# so many at most, and in closed form.
LAGS_S = (3.0, 1.0, 0.4)
MAX_PAIRS, _MAX_ROUGH = 400, 120
MIN_PAIRS = 12

# A hypothesis holds if it leaves at most this share of the motion unexplained. It replaces the
# plain one if it leaves this many times less. The closed form is right to this factor.
HOLDS, _DECISIVE, _ROUGHLY = 0.12, 3.0, 2.0

# Rounds of weights for motions that are far off, in the closed form.
_ROUNDS = 2

# Largest unexplained share that noise can cause, in streams whose angular rates clearly agree.
_NOISY = 0.3

# Among hypotheses that are about equally good the simpler one is taken, and the child's rather than
# the parent's. A scale farther from 1 than this (logarithm) makes one less simple.
_ABOUT_EQUAL, _ODD_SCALE = 1.5, 0.05

# Frames this close (m, rad) may be one: of one world for both streams, the lever arm between the
# worlds says nothing.
_SAME_FRAME = 0.01

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

    def shifted(self, offset_s: float) -> "StreamPair":
        """The same with another clock of the child."""
        return replace(self, child=self.child.shifted(offset_s))

    @cached_property
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
    """A mistake that ``correct`` undoes in the poses (N, 4, 4) of a stream, "parent", "child" or
    "both". ``code`` is that of its finding, empty if nothing is wrong; ``complexity`` counts what
    is wrong; ``detail`` says of wrong axes what (x, y, z) should be.
    """

    code: str
    stream: str
    correct: Callable[[FloatArray], FloatArray]
    complexity: int = 1
    detail: str = ""

    def corrected(self, stream: str, poses: FloatArray) -> FloatArray:
        """The poses of a stream without the mistake."""
        return self.correct(poses) if self.stream in (stream, "both") else poses

    def undo(self, streams: StreamPair) -> StreamPair:
        """Both streams without the mistake."""
        if not self.code:
            return streams
        parent, child = (
            Trajectory(stream.stamps_ns, self.corrected(name, stream.poses))
            for name, stream in (("parent", streams.parent), ("child", streams.child))
        )
        return replace(streams, parent=parent, child=child)


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


def _with_axes(matrix: FloatArray, poses: FloatArray) -> FloatArray:
    poses = poses.copy()
    poses[:, :3, 3] = poses[:, :3, 3] @ matrix.T
    return poses


_MIRROR = -np.eye(3)
_REORDERED = partial(se3.put_right, quaternion="wxyz")
_INVERTED_POSES = partial(se3.put_right, invert="poses")
_PLAIN = Hypothesis("", "child", lambda poses: poses, 0)
_USUAL = [
    *(
        Hypothesis(code, stream, correct)
        for stream in ("child", "parent")
        for code, correct in (
            ("quaternion_order", _REORDERED),
            ("inverse", _INVERTED_POSES),
            ("left_handed", partial(_with_axes, _MIRROR)),
        )
    ),
    # One exporter often writes both streams.
    Hypothesis("quaternion_order", "both", _REORDERED),
]


def _unusual() -> Iterator[Hypothesis]:
    """Inverted orientations, on flat ground the same as two axes swapped; and all permutations and
    flips of the axes of the positions, except the mirror of all three.
    """
    for stream in ("child", "parent", "both"):
        yield Hypothesis(
            "inverse_orientation", stream, partial(se3.put_right, invert="orientations"), 2
        )
    for order, signs in itertools.product(
        itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)
    ):
        matrix = np.diag(signs) @ np.eye(3)[list(order)]
        n_changed = int(3 - np.isclose(matrix.diagonal(), 1.0).sum())
        parts = zip(order, signs, strict=True)
        detail = " ".join(f"{'-' * (sign < 0)}{'xyz'[k]}" for k, sign in parts)
        if n_changed and not np.array_equal(matrix, _MIRROR):
            for stream in ("child", "parent"):
                yield Hypothesis("axes", stream, partial(_with_axes, matrix), n_changed, detail)


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
            plain = _fitted(_PLAIN, streams, lag_s, start)
            if start is not None and not plain.holds:
                plain = _fitted(_PLAIN, streams, lag_s)
        except NotEnoughDataError as error:
            too_few = error
            continue
        chosen = _or_rival(plain, _USUAL, streams, lag_s, _NOISY if thorough else HOLDS)
        if chosen is plain and not plain.holds:
            # A body that rotates about one of its sensors: that one's translations are noise.
            in_one_unit = _fitted(_PLAIN, streams, lag_s, same_unit=True)
            chosen = in_one_unit if in_one_unit.holds else plain
        if not chosen.holds and thorough and not failed:
            chosen = _or_rival(chosen, _unusual(), streams, lag_s, HOLDS)
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


def _or_rival(
    plain: Explanation,
    rivals: Iterable[Hypothesis],
    streams: StreamPair,
    lag_s: float,
    limit: float,
) -> Explanation:
    """The simplest of the rivals that explain the motion best, if they are decisively better."""
    most = min(limit, plain.fit.unexplained / _DECISIVE)
    if plain.fit.unexplained < EXPLAINED:
        return plain
    pairs, rivals = streams.pairs(lag_s, _MAX_ROUGH), [*rivals]
    few = streams.synchronised[np.concatenate([pairs.i, pairs.j])]
    moved = []
    for stream, Ts in (("parent", few.Ts_pw_p), ("child", few.Ts_cw_c)):
        corrected = np.stack([rival.corrected(stream, Ts) for rival in rivals])
        moved.append(motions(*np.split(corrected, 2, axis=1)))
    left = zip(rivals, _left_unexplained(*moved), strict=True)
    tried = [_fitted(rival, streams, lag_s) for rival, share in left if share < _ROUGHLY * most]
    least = min((each.fit.unexplained for each in tried), default=np.inf)
    if least >= most:
        return plain
    best = [each for each in tried if each.fit.unexplained <= _ABOUT_EQUAL * least]
    return min(best, key=lambda each: each.complexity)


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


def _left_unexplained(A: FloatArray, B: FloatArray) -> FloatArray:
    """About the share of the motion that no extrinsic and scale explain, in closed form: (H,) of H
    sets (H, K, 4, 4) of motions each of parent and child.
    """
    (a, t_a), (b, t_b) = ((se3.rotation_log(Ts[..., :3, :3]), Ts[..., :3, 3]) for Ts in (A, B))
    # No extrinsic changes an angle: where angles differ, one is of a jump.
    apart = np.abs(np.linalg.norm(a, axis=-1) - np.linalg.norm(b, axis=-1))
    kept = a * (apart <= 3.0 * medians(apart)[:, None])[..., None]
    back = np.swapaxes(se3.nearest_rotation(np.swapaxes(kept, 1, 2) @ b), 1, 2)
    # The rotations may leave the angle about their main axis open: the translations show it then.
    axis = np.linalg.eigh(np.swapaxes(kept, 1, 2) @ kept)[1][..., -1]
    chords, moved = A[..., :3, :3] - np.eye(3), t_b @ back
    along = (moved @ axis[..., None]) * axis[:, None]
    columns = np.stack([along - moved, np.cross(moved, axis[:, None]), -along], axis=-1)
    of_path, _ = _fit_robustly(np.concatenate([chords, columns], axis=-1), -t_a)
    shares = []
    for angle in (np.zeros(len(A)), np.arctan2(of_path[:, 4], of_path[:, 3])):
        turned = np.swapaxes(se3.rotation_exp(angle[:, None] * axis), 1, 2)
        column = -(moved @ turned)[..., None]
        x, left_m = _fit_robustly(np.concatenate([chords, column], axis=-1), -t_a)
        left_rad = robust_sigma(a - b @ back @ turned)
        sizes_m = np.linalg.norm(t_a, axis=(1, 2)), np.linalg.norm(moved, axis=(1, 2))
        size_m = np.minimum(sizes_m[0], np.maximum(x[:, 3], 0.0) * sizes_m[1])
        size_rad = np.linalg.norm(a, axis=(1, 2))
        shares.append(np.hypot(left_m / (size_m + 1e-12), left_rad / (size_rad + 1e-12)))
    return np.asarray(np.minimum(*shares) * np.sqrt(A.shape[1]))


def _fit_robustly(rows: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unknowns (H, p) of the equations ``rows @ x = target`` of (H, K, 3, p) and (H, K, 3), of
    which some are far off, and the standard deviations (H,) per axis of what is left.
    """
    both, weights = np.concatenate([rows, target[..., None]], axis=-1), np.ones(target.shape[:2])
    for _ in range(_ROUNDS):
        flat = (weights[..., None, None] * both).reshape(len(both), -1, both.shape[-1])
        products = np.swapaxes(flat, 1, 2) @ flat
        inverse = np.linalg.pinv(products[:, :-1, :-1], rcond=1e-12, hermitian=True)
        x = (inverse @ products[:, :-1, -1:])[..., 0]
        left = (rows @ x[:, None, :, None])[..., 0] - target
        sigmas = robust_sigma(left)
        weights = 1.0 / (1.0 + (left**2).sum(axis=-1) / (6.0 * sigmas[:, None] + 1e-12) ** 2)
    return x, sigmas


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
    likely, clear = LIMITS["inverse_both"][-2:]
    if code:
        fit = explanation.fit
        if evidence >= likely:
            stream, fit = ("parent" if stream == "child" else "child"), inverted
        # An option mends only what is clear.
        options = conventions(code, stream) if abs(evidence) > likely else {}
        found = finding(code, stream, options=options)
        hypothesis = Hypothesis(code, stream, _INVERTED_POSES)
        return replace(explanation, hypothesis=hypothesis, fit=fit, findings=(found,))
    if evidence < likely:
        return explanation
    if evidence <= clear or _may_be_an_arm(streams):
        found = finding("inverse_both", "both", Severity.WARNING)
        return replace(explanation, findings=(found,))
    found = finding("inverse_both", options=conventions("inverse", "both"))
    return Explanation(Hypothesis("inverse_both", "both", _INVERTED_POSES), inverted, (found,))


def _may_be_an_arm(streams: StreamPair) -> bool:
    """Whether inverse poses may be right, or path lengths deceive: stops, or a small space."""
    both = (streams.parent.poses, streams.child.poses)
    positions = [poses[:, :3, 3] for given in both for poses in (given, se3.inverse(given))]
    return streams.interval_s > streams.max_gap_s or all(
        np.linalg.norm(each - medians(each.T), axis=1).max() < _REACH_M for each in positions
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
        poses = coarse(stream, PATH_STEP_S).poses
        steps = (np.diff(Ts[:, :3, 3], axis=0) for Ts in (poses, se3.inverse(poses)))
        path_m, inverted_m = (np.linalg.norm(each, axis=1).sum() + 1e-9 for each in steps)
        evidence += float(np.log(path_m / inverted_m))
    pairs, Ts_c_cw = streams.synchronised, se3.inverse(streams.synchronised.Ts_cw_c)
    Ts_c_cw[:, :3, 3] *= fit.scale
    worlds = pairs.Ts_pw_p @ fit.T_parent_child @ Ts_c_cw
    off = np.linalg.norm(worlds[:, :3, 3] - medians(worlds[:, :3, 3].T), axis=1)
    inverted = replace(fit, T_parent_child=worlds[np.argmin(off)])
    Ts = np.array([fit.T_parent_child, inverted.T_parent_child])
    arms_m = np.maximum(np.linalg.norm(Ts[:, :3, 3], axis=1), _SAME_FRAME)
    if (np.maximum(arms_m, se3.rotation_angle(Ts[:, :3, :3])) > _SAME_FRAME).all():
        evidence += 0.5 * float(np.log(arms_m[0] / arms_m[1]))
    return evidence, inverted
