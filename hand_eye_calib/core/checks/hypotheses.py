"""Search for usual mistakes in two streams, such as inverse poses or reordered quaternions.

Model: a rigid mount X gives both sensors the same angle of rotation, and the same distance along
the screw axis, in every motion pair (screw congruence). The robust fit of
:mod:`~hand_eye_calib.core.alignment.similarity` measures the unexplained share: the share of the
motion that breaks this rule. Each hypothesis corrects the streams for its mistakes, and the fit is
repeated. The plain hypothesis (no mistake) is rejected only if another hypothesis leaves less than
half of its unexplained share.

The fit is equally good if both streams are inverted. X is then the pose of the child's world in the
parent's world. So there are two readings: the streams contain poses, or inverse poses. Three
properties of the motion decide between the two readings:

- Vehicles travel in a steady direction in their own frame.
- On other bodies, some point of the body has a shorter path than any point of the world has in the
  frame of the sensor.
- The lever arm between the worlds is longer than the lever arm between the sensors.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from hand_eye_calib.core.alignment.similarity import EXPLAINED, fit_similarity
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.checks.findings import (
    Finding,
    Severity,
    conventions,
    finding,
)
from hand_eye_calib.core.checks.hypothesis import (
    CODES_OF_STREAM,
    CONVENTIONAL,
    EULER_ORDER,
    HOLDS,
    PLAIN,
    USUAL,
    Explanation,
    Hypothesis,
    Readings,
    hypotheses_of_axes,
)
from hand_eye_calib.core.checks.shape import evidence_for_inverse, may_be_an_arm
from hand_eye_calib.core.checks.stream_pair import LAGS_S, MAX_PAIRS, StreamPair
from hand_eye_calib.core.geometry import trajectory
from hand_eye_calib.core.pairing import motion_pairs

# Largest number of motions in the rough fits that rank the hypotheses.
_MAX_ROUGH = 120
# A hypothesis replaces another one if its unexplained share is smaller by this factor.
_DECISIVE = 2.0

# Largest unexplained share that noise can cause if the angular rates of the streams clearly agree.
_NOISY = 0.3

# Two hypotheses fit equally well if their unexplained shares differ by less than this factor. The
# hypothesis with fewer mistakes is then chosen, and a mistake of the child before a mistake of the
# parent.
_ABOUT_EQUAL = 1.5

# The streams may be inverse if the shape of the motion exceeds this limit; both readings are then
# kept. The shape is the sum of two log ratios: of the paths and of the lever arms. For 190 correct
# recordings (KinHEC, real, simulated) the shape was at most -0.25, and below -0.4 in all but six.
# For inverse streams the shape has the opposite sign.
_SUSPICIOUS = -0.2
# Shape that is stored if a steady direction of travel decides between the readings.
STEADY_SHAPE = 1.0


def explain(
    streams: StreamPair, thorough: bool, start: FloatArray | None = None
) -> Explanation:
    """Find the mistakes under which both streams agree.

    Parameters
    ----------
    streams : StreamPair
        Streams on one clock.
    thorough : bool
        Whether to try all wrong axes as well. Set it only if the angular rates of the streams
        agree.
    start : (4, 4) array, optional
        Start of the fit without mistakes: an estimate of the extrinsic.

    Returns
    -------
    Explanation
        The plain hypothesis, if it holds and no mistake explains far more. Otherwise the hypothesis
        that holds; if none holds, the best hypothesis with the finding "unexplained".

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
            chosen = _or_rival(
                chosen, hypotheses_of_axes(), streams, lag_s, HOLDS
            )
        if chosen.holds:
            return _with_findings(chosen, streams, lag_s)
        # Continue with shorter motions: jumps affect fewer of them.
        failed.append(chosen)
    if not failed:
        raise too_few
    best = min(failed, key=lambda explanation: explanation.fit.unexplained)
    return _unexplained(best, streams, thorough)


def _plain(
    streams: StreamPair, lag_s: float, start: FloatArray | None
) -> Explanation:
    """Fit the uncorrected streams from ``start``; if this fails, without ``start``."""
    plain = _fitted(PLAIN, streams, lag_s, start)
    if start is not None and not plain.holds:
        plain = _fitted(PLAIN, streams, lag_s)
    return plain


def _or_usual_mistake(
    plain: Explanation, streams: StreamPair, lag_s: float, thorough: bool
) -> Explanation:
    """Return the explanation by a usual mistake, or ``plain`` if no mistake is far better."""
    if plain.holds:
        # Uncorrected streams of an arm, or on nearly flat ground, may fit in spite of a mistake.
        rivals = [
            hypothesis for hypothesis in USUAL if len(hypothesis.mistakes) == 1
        ]
    else:
        rivals = USUAL
        # If the body rotates about one of the sensors, the translations of this sensor are noise.
        in_one_unit = _fitted(PLAIN, streams, lag_s, same_unit=True)
        if in_one_unit.holds:
            plain = in_one_unit
    limit = _NOISY if thorough else HOLDS
    return _or_rival(plain, rivals, streams, lag_s, limit)


def _with_findings(
    chosen: Explanation, streams: StreamPair, lag_s: float
) -> Explanation:
    """Add the findings to an explanation that holds.

    The streams may contain poses or inverse poses. The result has the likelier of these readings.
    """
    doubts: list[Finding] = []
    codes = {code for code, _ in chosen.hypothesis.mistakes}
    if codes - {"inverse", "axes"}:
        chosen, doubts = _or_axes(chosen, streams, lag_s)
    explanation = choose_reading(chosen, streams, lag_s)
    return replace(explanation, findings=(*explanation.findings, *doubts))


def _unexplained(
    best: Explanation, streams: StreamPair, thorough: bool
) -> Explanation:
    """Add the finding "unexplained" to the best explanation, if no explanation holds.

    After a thorough search, noise may be the cause of a small unexplained share. The explanation
    then holds, with the finding "noisy".
    """
    unexplained = best.fit.unexplained
    if thorough and unexplained < _NOISY:
        noisy = choose_reading(best, streams, LAGS_S[0])
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
    """Return the simplest of the best rivals if they are clearly better; otherwise ``plain``.

    The unexplained share of a rival must be below ``limit``, and smaller than that of ``plain`` by
    the factor _DECISIVE.
    """
    if plain.fit.unexplained < EXPLAINED:
        return plain
    max_unexplained = min(limit, plain.fit.unexplained / _DECISIVE)
    best = _best_rivals(max_unexplained, rivals, streams, lag_s)
    if not best:
        return plain
    return _fitted(_simplest(best).hypothesis, streams, lag_s)


def _simplest(explanations: Sequence[Explanation]) -> Explanation:
    """Return the explanation with the fewest mistakes."""
    return min(explanations, key=lambda explanation: explanation.complexity)


def _best_rivals(
    max_unexplained: float,
    rivals: Iterable[Hypothesis],
    streams: StreamPair,
    lag_s: float,
) -> list[Explanation]:
    """Return the rivals whose unexplained share is about the smallest of all rivals.

    The result is empty if all shares exceed ``max_unexplained``.
    """
    pairs = streams.pairs(lag_s, _MAX_ROUGH)
    # Correct only the poses that the motions use: first all starts, then all ends.
    used_poses = streams.synchronised[np.concatenate([pairs.i, pairs.j])]
    starts = np.arange(len(pairs))
    tried: list[Explanation] = []
    for rival in rivals:
        parent = rival.corrected("parent", used_poses.Ts_pw_p)
        child = rival.corrected("child", used_poses.Ts_cw_c)
        motions = motion_pairs.pairs_between(
            parent, child, starts, starts + len(pairs)
        )
        # Stop a fit early if its start leaves far more than ``max_unexplained``.
        fit = fit_similarity(
            motions, max_unexplained=_DECISIVE * max_unexplained
        )
        tried.append(Explanation(rival, fit))
        max_unexplained = min(max_unexplained, _ABOUT_EQUAL * fit.unexplained)
    return [
        explanation
        for explanation in tried
        if explanation.fit.unexplained <= max_unexplained
    ]


def _fitted(
    hypothesis: Hypothesis,
    streams: StreamPair,
    lag_s: float,
    start: FloatArray | None = None,
    same_unit: bool = False,
) -> Explanation:
    """Correct the streams by a hypothesis, and fit them."""
    pairs = hypothesis.undo(streams).pairs(lag_s, MAX_PAIRS)
    fit = fit_similarity(pairs, start=start, same_unit=same_unit)
    return Explanation(hypothesis, fit, same_unit=same_unit)


def _or_axes(
    chosen: Explanation, streams: StreamPair, lag_s: float
) -> tuple[Explanation, list[Finding]]:
    """Compare wrong orientations with wrong axes of the positions, as explanations.

    Wrong axes are returned if they explain clearly more. If they explain about as much, the chosen
    explanation gets the finding "ambiguous".
    """
    unexplained = chosen.fit.unexplained
    rivals = _best_rivals(
        _ABOUT_EQUAL * unexplained, hypotheses_of_axes(), streams, lag_s
    )
    if not rivals:
        return chosen, []
    simplest = _simplest(rivals).hypothesis
    smallest = min(rival.fit.unexplained for rival in rivals)
    if _ABOUT_EQUAL**0.5 * smallest < unexplained:
        return _fitted(simplest, streams, lag_s), []
    _, stream = simplest.mistakes[0]
    return chosen, [finding("ambiguous", stream, detail=simplest.detail)]


def _steadier(
    chosen: Explanation, streams: StreamPair, lag_s: float
) -> tuple[Explanation, bool]:
    """Find the explanation in which both sensors travel in a steady direction, as on vehicles.

    Returns
    -------
    Explanation
        The steadiest explanation that holds; ``chosen`` if no other explanation is clearly
        steadier.
    bool
        Whether the direction of travel decides between poses and inverse poses. The value is also
        True for mistakes whose direction is not compared (axes, Euler angles).
    """
    hypothesis = chosen.hypothesis
    if hypothesis.axes is not None or EULER_ORDER in (
        hypothesis.parent,
        hypothesis.child,
    ):
        return chosen, True
    # Scatter of the direction of travel under each hypothesis, of the less steady sensor.
    scatters = np.maximum.outer(
        _scatters(streams.parent), _scatters(streams.child)
    )
    scatter = dict(zip(CONVENTIONAL, scatters.flat, strict=True))
    scatter_of_chosen = scatter[hypothesis]
    smallest = min(scatter.values())
    clearly_smaller = scatter_of_chosen / trajectory.WRONG_SCATTER_RATIO
    if smallest < min(trajectory.STEADY_SCATTER, clearly_smaller):
        # The scatter of exact motion can be slightly negative by rounding.
        limit = max(_ABOUT_EQUAL * smallest, 0.0)
        steadiest = [rival for rival in CONVENTIONAL if scatter[rival] <= limit]
        simplest = min(steadiest, key=lambda rival: rival.complexity)
        steady = _fitted(simplest, streams, lag_s)
        if steady.holds:
            return steady, True
    return chosen, scatter_of_chosen < trajectory.STEADY_SCATTER


def _scatters(stream: trajectory.Trajectory) -> list[float]:
    """Return the scatter of the direction of travel for each entry of CODES_OF_STREAM."""
    poses = stream.poses[:: 1 + len(stream) // MAX_PAIRS]
    scatters = []
    for codes in CODES_OF_STREAM:
        corrected = Hypothesis(codes).corrected("parent", poses)
        scatters.append(trajectory.scatter_of_direction(corrected))
    return scatters


def choose_reading(
    explanation: Explanation, streams: StreamPair, lag_s: float
) -> Explanation:
    """Choose whether the streams contain poses or inverse poses, and add the findings.

    Both readings fit equally well: the hypothesis, and the same hypothesis with both streams
    inverted. A steady direction of travel decides; without it, the shape of the motion decides. If
    the other reading may be right, the result has :class:`Readings`, and the caller compares the
    noise of both readings.
    """
    former = explanation.hypothesis
    explanation, is_settled = _steadier(explanation, streams, lag_s)
    hypothesis = explanation.hypothesis
    is_uninverted_as_before = hypothesis.is_uninverted and hypothesis == former
    if _has_one_reading(hypothesis) or (is_settled and is_uninverted_as_before):
        return replace(explanation, findings=findings_of(hypothesis))
    if is_settled:
        # A steady direction of travel is clear evidence for this hypothesis, which is the second
        # reading.
        readings = Readings(
            hypotheses=(hypothesis.inverted(), hypothesis),
            shape=STEADY_SHAPE,
            paths=STEADY_SHAPE,
            is_small=False,
        )
        return replace(
            explanation,
            findings=findings_of(hypothesis),
            readings=readings.ordered(),
        )
    readings = _readings(explanation, streams)
    if hypothesis.is_uninverted and readings.shape < 0.0:
        findings = findings_of(hypothesis)
        is_doubtful = readings.shape > _SUSPICIOUS
        return replace(
            explanation,
            findings=findings,
            readings=readings if is_doubtful else None,
        )
    return _in_likelier_reading(explanation, readings, streams, lag_s)


def _has_one_reading(hypothesis: Hypothesis) -> bool:
    """Return whether a hypothesis is used without a comparison of poses and inverse poses."""
    if hypothesis.axes is not None:
        return True
    return any(code == "inverse_orientation" for code, _ in hypothesis.mistakes)


def _readings(explanation: Explanation, streams: StreamPair) -> Readings:
    """Return both readings of a hypothesis, with the evidence of the shape of the motion."""
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
    explanation: Explanation,
    readings: Readings,
    streams: StreamPair,
    lag_s: float,
) -> Explanation:
    """Return the explanation in its likelier reading, with the findings."""
    hypothesis = explanation.hypothesis
    likelier = readings.hypotheses[int(readings.shape > 0.0)]
    if hypothesis.is_uninverted and not readings.is_clear:
        likelier = hypothesis
    if likelier is not hypothesis:
        explanation = _fitted(likelier, streams, lag_s)
    # The options that invert streams are set only if the choice between the readings is clear.
    findings = findings_of(
        likelier, has_options=readings.is_clear or likelier.is_uninverted
    )
    if likelier.is_uninverted:
        options = conventions("inverse", "both")
        findings += (
            finding("inverse_both", "both", Severity.WARNING, options),
        )
    return replace(explanation, findings=findings, readings=readings.ordered())


def findings_of(
    hypothesis: Hypothesis, has_options: bool = True
) -> tuple[Finding, ...]:
    """Return a finding for each mistake of a hypothesis.

    Without ``has_options``, the findings about inverse poses lack the options that repair them.
    """
    findings = []
    for code, stream in hypothesis.mistakes:
        key = "inverse_both" if (code, stream) == ("inverse", "both") else code
        options = (
            conventions(code, stream)
            if has_options or code != "inverse"
            else {}
        )
        findings.append(
            finding(key, stream, options=options, detail=hypothesis.detail)
        )
    return tuple(findings)
