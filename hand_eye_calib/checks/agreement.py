"""Whether two streams can come from sensors on one rigid body, and if not, what is wrong with them.

For every motion pair, whatever X is, both sensors turn through the same angle and move by the same
length along the same screw axis. Streams that break this are wrong, and how they break it tells
what is wrong. Two steps find out:

1. Angles alone (:mod:`~hand_eye_calib.alignment.angular_rates`): do the streams turn together at any clock offset? Reordered or inverted
   quaternions, units and axes do not matter here.
2. Angles, screws and directions together (:mod:`~hand_eye_calib.alignment.similarity`): of all the usual mistakes, which one, undone, makes the streams
   agree? Each hypothesis is judged by how much of the motion a robust fit leaves unexplained. The
   plain one is kept unless another is several times better.

Two inverted streams agree with each other as well as before: X then is the pose of one world in the
other. What gives them away is that the way of the origin, seen from a turning sensor, is longer
than the sensor's own, and the lever between the worlds than that between the sensors.
"""

import dataclasses
import functools
import itertools
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.alignment.angular_rates import (
    MIN_VARIATION,
    NO_CORRELATION,
    Correlation,
    correlate_rates,
)
from hand_eye_calib.alignment.motions import pairs_over
from hand_eye_calib.alignment.scale import estimate_scale
from hand_eye_calib.alignment.similarity import EXPLAINED, SimilarityFit, fit_similarity
from hand_eye_calib.alignment.time_offset import refine_time_offset
from hand_eye_calib.checks.findings import Confidence, Finding, Severity
from hand_eye_calib.checks.stream_checks import (
    check_stamps,
    check_stream,
    coarse_poses,
    frozen_share,
)
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.synchronise import synchronise
from hand_eye_calib.solvers.separable import align_rotation_vectors

# Motions over this long (s; shorter ones where those fail) tell the hypotheses apart, that many of
# them.
_LAGS_S, _PAIRS, _PAIRS_FOR_AXES = (3.0, 1.0, 0.4), 400, 120
_FEWEST_PAIRS = 12

# A hypothesis holds where it leaves at most this share of the motion unexplained, and it replaces
# the plain one where it leaves this many times less.
HOLDS, DECISIVE = 0.12, 3.0

# Streams that clearly turn together are on one body; where so much of their motion stays
# unexplained at most, their noise is to blame.
_NOISY = 0.3

# Of hypotheses about equally good the simpler one, or that about the child, is taken.
_ABOUT_EQUAL, _ODD_SCALE = 1.5, 0.05

# Evidence (in logarithms of lengths) from which on both streams are said to be inverted, or that is
# likely.
_INVERTED, _LIKELY_INVERTED = 0.3, 1.0
_WAY_STEP_S = 0.3

# Frames this near to each other (m, rad) are one.
_NO_LEVER_M, _NO_TURN_RAD = 0.01, 0.01

# Offsets (s) that are worth a warning, a note; scales are significant by
# alignment.SCALE_IS_SIGNIFICANT.
_OFFSET_WARNING_S, _OFFSET_NOTE_S, _OFFSET_SIGMAS = 0.03, 0.005, 5.0
_UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 0.3048: "feet", 1e3: "kilometres"}
_UNIT_TOLERANCE = 0.1

# What it takes at least to tell faults while driving.
ENOUGH_S, ENOUGH_TURNED_RAD = 20.0, np.radians(30.0)

# Part of the time a stream may repeat its pose while the other moves.
_FROZEN = 0.02

# Turning about other axes than the main one (rad, or as a share of the main turning) below which
# their translation is not revealed.
_ONE_AXIS = 0.04
_NOISE_MARGIN = 1.7


@dataclass(frozen=True)
class Agreement:
    """What the checks found.

    Attributes
    ----------
    findings : tuple of Finding
        The gravest first.
    correlation : Correlation
        How the two streams turn together.
    fit : SimilarityFit or None
        The fit of the hypothesis that holds.
    turned_rad : dict
        Root mean square turning over 3 s about each axis of the parent sensor, rad; empty where
        unknown.
    """

    findings: tuple
    correlation: Correlation
    fit: SimilarityFit | None = None
    turned_rad: dict | None = None

    @property
    def is_good(self):
        """Whether nothing speaks against calibrating with these streams as they are."""
        return all(finding.severity is Severity.NOTE for finding in self.findings)


def check_streams(parent, child, time_offset_s=0.0, scale=1.0, max_gap_s=CalibratorConfig.max_gap):
    """Check two streams before believing them.

    Parameters
    ----------
    parent, child : Trajectory
    time_offset_s : float
        Known already: seconds that are added to the child's stamps.
    scale : float
        Known already: factor of the child's lengths.
    max_gap_s : float

    Returns
    -------
    Agreement
    """
    findings = (
        check_stamps(parent.stamps_ns, child.stamps_ns) if min(len(parent), len(child)) else []
    )
    for name, stream in (("parent", parent), ("child", child)):
        findings += check_stream(stream, name, max_gap_s)
    if any(finding.severity is Severity.ERROR for finding in findings):
        return _agreement(findings, NO_CORRELATION)
    child = child.shifted(time_offset_s).scaled(scale)
    correlation = correlate_rates(parent, child, max_gap_s)
    aligned = child.shifted(correlation.offset_s) if correlation.is_clear else child
    frozen = [
        _frozen(name, share)
        for name, share in (
            ("parent", frozen_share(parent, aligned)),
            ("child", frozen_share(aligned, parent)),
        )
        if share > _FROZEN
    ]
    findings += frozen
    try:
        verdict = _best_hypothesis(parent, aligned, max_gap_s, thorough=correlation.is_clear)
    except NotEnoughDataError as error:
        verdict, reason = None, str(error)
    # Short drives may not tell the offset, and yet the streams agree at the one that is given.
    if not correlation.is_clear and (verdict is None or not verdict.holds):
        return _agreement(
            findings if frozen else [*findings, _not_together(correlation)], correlation
        )
    if verdict is None:
        too_short = _finding(
            "too_short", "both", Severity.ERROR, Confidence.CERTAIN, reason, "record longer"
        )
        return _agreement([*findings, too_short], correlation)
    findings += verdict.findings
    if not verdict.holds:
        return _agreement(findings, correlation)
    if not correlation.is_clear:
        correlation = dataclasses.replace(correlation, offset_s=0.0)
    parent_as_meant, child_as_meant = verdict.undo(parent, child)
    findings += _offset(
        parent_as_meant, child_as_meant, correlation, time_offset_s, max_gap_s, verdict.fit
    )
    pose_pairs = synchronise(
        parent_as_meant, child_as_meant.shifted(correlation.offset_s), max_gap_s
    )
    findings += _scale(estimate_scale(pose_pairs, start=verdict.fit), scale)
    excitation, turned = _excitation(pose_pairs, verdict.fit)
    return _agreement(findings + excitation, correlation, verdict.fit, turned)


def tell_enough(parent, child):
    """Whether two streams last so long, and turn so far, that the checks mean something: while one
    is still driving.

    Parameters
    ----------
    parent, child : Trajectory
    """
    return min(stream.duration_s for stream in (parent, child)) >= ENOUGH_S and any(
        se3.rotation_angle(stream.poses[0, :3, :3].T @ stream.poses[:, :3, :3]).max()
        >= ENOUGH_TURNED_RAD
        for stream in (parent, child)
    )


def _agreement(findings, correlation, fit=None, turned=None):
    order = list(Severity)
    return Agreement(
        tuple(sorted(findings, key=lambda f: -order.index(f.severity))), correlation, fit, turned
    )


def _finding(code, stream, severity, confidence, what, advice, **options):
    return Finding(code, stream, severity, confidence, what, advice, tuple(options.items()))


# ---------------------------------------------------------------- hypotheses


@dataclass(frozen=True)
class _Hypothesis:
    """A mistake that can be undone: on one stream, by a function of its trajectory."""

    code: str
    stream: str
    undone_by: callable
    complexity: int = 1
    detail: str = ""

    def undo(self, parent, child):
        """Both trajectories without the mistake."""
        return (
            (self.undone_by(parent), child)
            if self.stream == "parent"
            else (parent, self.undone_by(child))
        )


@dataclass(frozen=True)
class _Verdict:
    hypothesis: _Hypothesis
    fit: SimilarityFit
    findings: list
    limit: float = HOLDS

    @property
    def holds(self):
        return self.fit.unexplained < self.limit

    def undo(self, parent, child):
        return self.hypothesis.undo(parent, child)


def _reordered(trajectory):
    """Quaternions that were written w x y z and read as x y z w, put right."""
    quats = np.roll(se3.to_quat_xyzw(trajectory.poses), -1, axis=1)
    return Trajectory(trajectory.stamps_ns, se3.from_quat_xyzw(trajectory.poses[:, :3, 3], quats))


def _inverted(trajectory):
    return Trajectory(trajectory.stamps_ns, se3.inverse(trajectory.poses))


def _with_axes(matrix):
    def apply(trajectory):
        poses = trajectory.poses.copy()
        poses[:, :3, 3] = poses[:, :3, 3] @ matrix.T
        return Trajectory(trajectory.stamps_ns, poses)

    return apply


_PLAIN = _Hypothesis("", "child", lambda trajectory: trajectory, 0)
_USUAL = [
    _Hypothesis(code, stream, undone_by)
    for stream in ("child", "parent")
    for code, undone_by in (
        ("quaternion_order", _reordered),
        ("inverse", _inverted),
        ("left_handed", _with_axes(-np.eye(3))),
    )
]


@functools.cache
def _axis_hypotheses():
    """All ways to permute and flip the axes of the positions but for mirroring all three, the
    simplest first.
    """
    hypotheses = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            changes = _changes(matrix)
            if changes and not np.array_equal(matrix, -np.eye(3)):
                detail = " ".join(
                    f"{'-' * (sign < 0)}{'xyz'[column]}"
                    for column, sign in zip(order, signs, strict=True)
                )
                hypotheses += [
                    _Hypothesis("axes", stream, _with_axes(matrix), changes, detail)
                    for stream in ("child", "parent")
                ]
    return sorted(hypotheses, key=lambda hypothesis: hypothesis.complexity)


def _changes(matrix):
    """Axes that do not stay where they are."""
    return int(3 - np.isclose(matrix.diagonal(), 1.0).sum())


def _best_hypothesis(parent, child, max_gap_s, thorough):
    """The Verdict on the mistake that explains the streams, or on none; over shorter motions where
    jumps spoil the longer ones.

    Wrong axes are tried only on a ``thorough`` search, and at most twice: there are many of them,
    and streams that do not turn together need none.
    """
    failed = []
    for lag_s in _LAGS_S:
        try:
            chosen = _plain_or_usual(parent, child, max_gap_s, lag_s)
        except NotEnoughDataError as error:
            too_few = error
            continue
        if not chosen.holds and thorough and not failed:
            chosen = _or_other_axes(chosen, parent, child, max_gap_s, lag_s)
        if chosen.holds:
            return _attribute(chosen, parent, child, max_gap_s, lag_s)
        failed.append((lag_s, chosen))
    if not failed:
        raise too_few
    lag_s, best = min(failed, key=lambda tried: tried[1].fit.unexplained)
    if thorough and lag_s != failed[0][0]:
        best = _or_other_axes(best, parent, child, max_gap_s, lag_s)
        if best.holds:
            return _attribute(best, parent, child, max_gap_s, lag_s)
    if thorough and best.fit.unexplained < _NOISY:
        return dataclasses.replace(best, findings=[_noisy(best.fit)], limit=_NOISY)
    return dataclasses.replace(best, findings=[_not_one_body(best.fit)])


def _plain_or_usual(parent, child, max_gap_s, lag_s):
    plain = _judge(_PLAIN, parent, child, max_gap_s, lag_s)
    if plain.fit.unexplained < EXPLAINED:
        return plain
    usual = _simplest_of_the_best(
        [_judge(hypothesis, parent, child, max_gap_s, lag_s) for hypothesis in _USUAL]
    )
    return usual if _is_decisive(plain, usual) else plain


def _or_other_axes(plain, parent, child, max_gap_s, lag_s):
    """The Verdict on wrong axes where they are to blame, or the one that is given."""
    rotation = _agreed_rotation(parent, child, max_gap_s, lag_s)
    if rotation is None:
        return plain
    start = dataclasses.replace(
        plain.fit, T_parent_child=se3.from_rotation_translation(rotation, np.zeros(3))
    )
    rough = [
        _judge(hypothesis, parent, child, max_gap_s, lag_s, _PAIRS_FOR_AXES, start)
        for hypothesis in _axis_hypotheses()
    ]
    axes = _simplest_of_the_best(rough)
    return axes if _is_decisive(plain, axes) else plain


def _judge(hypothesis, parent, child, max_gap_s, lag_s, most=_PAIRS, start=None):
    pairs = _pairs(*hypothesis.undo(parent, child), max_gap_s, lag_s, most)
    return _Verdict(hypothesis, fit_similarity(pairs, start=start), [])


def _pairs(parent, child, max_gap_s, lag_s, most=_PAIRS):
    pose_pairs = synchronise(parent, child, max_gap_s)
    pairs = pairs_over(pose_pairs, lag_s, most)
    if len(pairs) < _FEWEST_PAIRS:
        raise NotEnoughDataError(
            f"the streams have only {len(pairs)} motions over {lag_s:g} s in common"
        )
    return pairs


def _agreed_rotation(parent, child, max_gap_s, lag_s):
    """The rotation on which the rotations alone agree, or None: wrong axes of the positions do not
    touch them.
    """
    pairs = _pairs(parent, child, max_gap_s, lag_s)
    rotation = align_rotation_vectors(pairs)
    rotation_a, rotation_b = pairs.Ts_parenti_parentj[:, :3, :3], pairs.Ts_childi_childj[:, :3, :3]
    errors = se3.rotation_angle(np.swapaxes(rotation_a @ rotation, 1, 2) @ (rotation @ rotation_b))
    agree = np.median(errors) < 2 * HOLDS * np.sqrt(np.mean(se3.rotation_angle(rotation_a) ** 2))
    return rotation if agree else None


def _simplest_of_the_best(verdicts):
    limit = _ABOUT_EQUAL * min(verdict.fit.unexplained for verdict in verdicts)
    return min(
        (verdict for verdict in verdicts if verdict.fit.unexplained <= limit), key=_strangeness
    )


def _strangeness(verdict):
    """Number of things that would have to be wrong; for equal numbers, it is the child that is."""
    odd_scale = abs(np.log(verdict.fit.scale)) > _ODD_SCALE
    return verdict.hypothesis.complexity + odd_scale, verdict.hypothesis.stream == "parent"


def _is_decisive(plain, rival):
    return rival.holds and DECISIVE * rival.fit.unexplained < plain.fit.unexplained


def _attribute(verdict, parent, child, max_gap_s, lag_s):
    """Settle what the agreement of both streams cannot: which of them is inverted, or both."""
    hypothesis = verdict.hypothesis
    if hypothesis.code not in ("", "inverse"):
        return _Verdict(hypothesis, verdict.fit, [_MAKERS[hypothesis.code](hypothesis)])
    as_meant = hypothesis.undo(parent, child)
    evidence, fit_inverted = _evidence_for_inverse(*as_meant, verdict.fit, max_gap_s, lag_s)
    if evidence < _INVERTED:
        return _Verdict(
            hypothesis,
            verdict.fit,
            [_inverse(hypothesis.stream, -evidence)] if hypothesis.code else [],
        )
    if hypothesis.code:
        other = "parent" if hypothesis.stream == "child" else "child"
        return _Verdict(
            _Hypothesis("inverse", other, _inverted), fit_inverted, [_inverse(other, evidence)]
        )
    both = _BothInverted("inverse_both", "both", _inverted)
    return _Verdict(both, fit_inverted, [_inverse_both(evidence)])


class _BothInverted(_Hypothesis):
    def undo(self, parent, child):
        return self.undone_by(parent), self.undone_by(child)


def _evidence_for_inverse(parent, child, fit, max_gap_s, lag_s):
    """How much shorter ways and lever are (sum of logarithms) where both streams are inverted, and
    the fit then.
    """
    inverted = _judge(_BothInverted("", "both", _inverted), parent, child, max_gap_s, lag_s).fit
    ways = sum(np.log(_way(stream) / _way(_inverted(stream))) for stream in (parent, child))
    if any(_is_none(each) for each in (fit, inverted)):
        return float(
            ways
        ), inverted  # one world for both streams: no lever between worlds tells anything
    levers = [
        max(float(np.linalg.norm(f.T_parent_child[:3, 3])), 3 * f.sigma_translation, 1e-3)
        for f in (fit, inverted)
    ]
    return float(ways + 0.5 * np.log(levers[0] / levers[1])), inverted


def _is_none(fit):
    """Whether a fit's transform is no more than noise."""
    far = np.linalg.norm(fit.T_parent_child[:3, 3]) > max(_NO_LEVER_M, 3 * fit.sigma_translation)
    return not far and se3.rotation_angle(fit.T_parent_child[:3, :3]) < max(
        _NO_TURN_RAD, 3 * fit.sigma_rotation
    )


def _way(trajectory):
    """Length of the way, in coarse steps so that noise does not count."""
    places = coarse_poses(trajectory, _WAY_STEP_S)[:, :3, 3]
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()) + 1e-9


# ------------------------------------------------------------------ findings


def _frozen(stream, share):
    return _finding(
        "frozen", stream, Severity.ERROR, Confidence.CERTAIN,
        f"the {stream} stream repeats one and the same pose for {share:.0%} of the time while the other sensor moves",
        "find out why its source stopped, and cut that part out",
    )  # fmt: skip


def _not_together(correlation):
    if correlation.variation < MIN_VARIATION:
        return _finding(
            "no_turning", "both", Severity.ERROR, Confidence.LIKELY,
            "the streams hardly turn, or at a constant rate, so that neither clock nor extrinsic can be checked",
            "drive curves, over slopes if there are any",
        )  # fmt: skip
    return _finding(
        "unrelated", "both", Severity.ERROR, Confidence.LIKELY,
        f"the two streams do not turn together at any clock offset: {correlation.doubt()}",
        "check that both sensors are on one rigid body, that the topics are of the same drive, and that neither is derived from another body",
    )  # fmt: skip


def _not_one_body(fit):
    return _finding(
        "unrelated", "both", Severity.ERROR, Confidence.LIKELY,
        f"no extrinsic, scale or usual mistake explains both streams: {fit.unexplained:.0%} of the motion remain (at most "
        f"{HOLDS:.0%} would be good)",
        "check that both sensors are on one rigid body and that the poses are those of the sensors",
    )  # fmt: skip


def _noisy(fit):
    return _finding(
        "noisy", "both", Severity.NOTE, Confidence.LIKELY,
        f"the streams turn together, but {fit.unexplained:.0%} of the motion stay unexplained: noise or jumps are strong",
        "expect large standard deviations; drive longer and livelier, or repair the source",
    )  # fmt: skip


def _quaternion_order(hypothesis):
    return _finding(
        "quaternion_order", hypothesis.stream, Severity.ERROR, Confidence.LIKELY,
        f"the {hypothesis.stream} stream's quaternions seem to be written w x y z and read as x y z w",
        "write them as x y z w",
    )  # fmt: skip


def _inverse(stream, evidence):
    confidence = Confidence.LIKELY if evidence > _INVERTED else Confidence.POSSIBLE
    return _finding(
        "inverse", stream, Severity.ERROR, confidence,
        f"the {stream} stream seems to hold inverse poses (of the world in the sensor, not of the sensor in its world)",
        f"invert every pose of the {stream} stream",
    )  # fmt: skip


def _inverse_both(evidence):
    confidence = Confidence.LIKELY if evidence > _LIKELY_INVERTED else Confidence.POSSIBLE
    return _finding(
        "inverse_both", "both", Severity.ERROR, confidence,
        "both streams seem to hold inverse poses (of the world in the sensor): inverted, their ways and the lever between them are shorter",
        "invert every pose of both streams; otherwise the result is the pose of one world in the other",
    )  # fmt: skip


def _axes(hypothesis):
    return _finding(
        "axes", hypothesis.stream, Severity.ERROR, Confidence.LIKELY,
        f"the {hypothesis.stream} stream's positions are in other axes than its orientations: (x, y, z) should be ({hypothesis.detail})",
        "write positions and orientations in the same right-handed axes",
    )  # fmt: skip


def _left_handed(hypothesis):
    return _finding(
        "left_handed", hypothesis.stream, Severity.ERROR, Confidence.LIKELY,
        f"the {hypothesis.stream} stream's axes are left-handed: with all positions mirrored the streams agree",
        "convert the stream to right-handed axes (REP 103)",
    )  # fmt: skip


_MAKERS = {"quaternion_order": _quaternion_order, "axes": _axes, "left_handed": _left_handed}


def _offset(parent, child, correlation, known_s, max_gap_s, fit):
    found = refine_time_offset(parent, child, correlation, max_gap_s, fit)
    if abs(found.seconds) < max(_OFFSET_NOTE_S, _OFFSET_SIGMAS * found.sigma_s):
        return []
    total_s = round(known_s + found.seconds, 4)
    return [
        _finding(
            "time_offset", "child", Severity.WARNING if abs(found.seconds) > _OFFSET_WARNING_S else Severity.NOTE, Confidence.CERTAIN,
            f"the child's clock is {abs(found.seconds):.4f} +/- {found.sigma_s:.4f} s {'behind' if found.seconds > 0 else 'ahead of'} the parent's",
            f"add {total_s} s to the child's stamps, or have it estimated",
            time_offset=total_s,
        )
    ]  # fmt: skip


def _scale(scale, known):
    if not scale.differs:
        return []
    total = known * scale.value
    for factor, unit in _UNITS.items():
        if abs(scale.value / factor - 1.0) < _UNIT_TOLERANCE:
            return [
                _finding(
                    "units", "child", Severity.ERROR, Confidence.CERTAIN,
                    f"the child's lengths are {unit} where the parent's are metres (factor {scale.value:.5g} +/- {scale.sigma:.2g})",
                    "convert them to metres",
                    scale=round(known * factor, 9),
                )
            ]  # fmt: skip
    return [
        _finding(
            "scale", "child", Severity.WARNING, Confidence.CERTAIN,
            f"the child's lengths must be multiplied by {scale.value:.4f} +/- {scale.sigma:.4f} to agree with the parent's",
            "have the scale estimated, or find out which of the two measures wrongly",
            scale=round(total, 4),
        )
    ]  # fmt: skip


def _excitation(pose_pairs, fit):
    """A note where nearly all turning is about one axis, and how much the parent turned about each
    of its axes.
    """
    motions = (pairs_over(pose_pairs, lag_s, _PAIRS) for lag_s in _LAGS_S)
    # One of them there is: the fit is over it.
    pairs = next(pairs for pairs in motions if len(pairs) >= _FEWEST_PAIRS)
    rotation = pairs.Ts_parenti_parentj[:, :3, :3]
    vectors = se3.rotation_log(rotation)
    turned = dict(zip("xyz", np.sqrt((vectors**2).mean(axis=0)).tolist(), strict=True))
    moved = rotation - np.eye(3)
    powers, axes = np.linalg.eigh(np.einsum("kai,kaj->ij", moved, moved) / len(moved))
    least, most = np.sqrt(np.maximum(powers[[0, 2]], 0.0))
    if least > max(_ONE_AXIS * most, _NOISE_MARGIN * fit.sigma_rotation):
        return [], turned
    axis = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
    name = "xyz"[int(np.argmax(np.abs(axis)))]
    return [
        _finding(
            "one_axis", "both", Severity.NOTE, Confidence.LIKELY,
            f"nearly all turning is about one axis, ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}) in the parent sensor's frame: the "
            f"translation along it, {name}, will be unobservable",
            f"drive over slopes or kerbs, or measure {name} and give it",
            **{f"prior.{name}": "VALUE+/-SIGMA"},
        )
    ], turned  # fmt: skip
