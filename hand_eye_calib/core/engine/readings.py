"""Choice between two readings of both streams.

A reading is an interpretation of both streams, as poses or as inverse poses of the sensors. The
second reading inverts all poses of the first one. Both readings fit equally well
(:class:`~hand_eye_calib.core.checks.hypothesis.Readings`), so two other criteria distinguish them:
the likelihood of the noise (:mod:`~hand_eye_calib.core.noise.readings`) and the shape of the
motion. The noise decides unless a clear shape contradicts the noise. In a small space the shape
must support the noise, because the poses of a camera that observes a target have the same noise as
inverted poses. If the criteria are not clear, both results are reported, and the verdict is DO NOT
USE.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.alignment.scale import estimate_scale
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.option import Options, options_in_words
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import Finding, finding, gravest_first
from hand_eye_calib.core.checks.hypotheses import findings_of
from hand_eye_calib.core.checks.hypothesis import Readings
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise.readings import loss_difference
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration

# The noise decides between both readings if their losses (negative log likelihoods) differ by more
# than this. In 200 recordings without target cameras whose first reading is right, the loss of the
# second reading was never smaller by more than 9.
CLEAR_NOISE = 20.0

# Smallest absolute `Readings.shape` (a logarithm) that overrules the noise. In 190 recordings the
# shape never had the wrong sign. The noise was wrong for a stream almost without errors, and there
# the shape was -2.9.
_OVERRULING_SHAPE = 2.0

# Smallest `Readings.paths` (a logarithm) that supports the noise in a small space.
_CLEAR_PATHS = 0.06


@dataclass(frozen=True)
class Choice:
    """Chosen reading of both streams.

    Attributes
    ----------
    findings : tuple of Finding
        Findings of the check for the chosen reading.
    doubts : tuple of Finding
        Findings about an uncertain choice, which are added to the result.
    is_repair : bool
        Whether the chosen reading sets options, such as ``child_invert``.
    """

    findings: tuple[Finding, ...]
    doubts: tuple[Finding, ...]
    is_repair: bool


def choose(
    result: CheckResult,
    pairs_of: Callable[[Options], PosePairs],
    answer_with: Callable[[Options], Calibration | None],
) -> Choice:
    """Choose between the two readings of a check.

    Parameters
    ----------
    result : CheckResult
        Check whose ``readings`` are not None.
    pairs_of : callable
        ``pairs_of(options)`` returns the pose pairs with these options, on one clock.
    answer_with : callable
        ``answer_with(options)`` returns the result with these options, on one clock; None if the
        solve fails.
    """
    readings = result.readings
    assert readings is not None
    findings_of_readings = [
        findings_of(hypothesis) for hypothesis in readings.hypotheses
    ]
    options = [_options_of(findings) for findings in findings_of_readings]
    difference = _loss_difference(pairs_of(options[0]), pairs_of(options[1]))
    has_late_stamps = any(
        suspect.code == "arrival" for suspect in result.findings
    )
    index = decide(readings, difference, has_late_stamps)
    # Whether the first reading inverts no stream.
    can_be_right = readings.hypotheses[0].is_uninverted
    doubts: tuple[Finding, ...] = ()
    if index is None:
        answers = [answer_with(reading_options) for reading_options in options]
        doubts = (_unclear(options, answers, difference),)
        index = 0 if can_be_right else int(readings.shape > 0.0)
    elif index == 1 and can_be_right and readings.is_small:
        doubts = (finding("inverse_small", "both"),)
    # The findings of the chosen reading replace those of both readings.
    codes = {"inverse_both"}
    for findings in findings_of_readings:
        codes.update(suspect.code for suspect in findings)
    others = [other for other in result.findings if other.code not in codes]
    return Choice(
        findings=gravest_first((*others, *findings_of_readings[index])),
        doubts=doubts,
        is_repair=bool(options[index]),
    )


def decide(
    readings: Readings, difference: float, has_late_stamps: bool = False
) -> int | None:
    """Return the index of the right reading; None if noise and shape do not decide clearly.

    Parameters
    ----------
    readings : Readings
    difference : float
        Loss of the second reading minus the loss of the first.
    has_late_stamps : bool
        Whether the stamps of a stream are those of arrival.
    """
    by_noise = 0
    if abs(difference) > CLEAR_NOISE:
        by_noise = -int(np.sign(difference))
    # Late stamps move each pose along its path, which looks like the noise of inverse poses. Then a
    # clear shape decides alone.
    if has_late_stamps and readings.by_shape != 0:
        by_noise = 0
    choice = _vote(readings, by_noise)
    can_be_right = readings.hypotheses[0].is_uninverted
    if (
        choice == 1
        and can_be_right
        and has_late_stamps
        and readings.by_shape <= 0
    ):
        # An excavator with late stamps was read as inverse, 5 m off.
        return None
    if choice == 0 and can_be_right:
        # Without a clear vote, the streams stay as they are if no criterion supports an inversion.
        is_inversion_supported = readings.shape >= 0.0 or by_noise > 0
        choice = 0 if is_inversion_supported else -1
    # From a vote (1 for the second reading, -1 for the first) to an index.
    return {1: 1, -1: 0}.get(choice)


def _vote(readings: Readings, by_noise: int) -> int:
    """Return 1 for the second reading, -1 for the first, and 0 without a clear vote.

    ``by_noise`` has the same values, and is the vote of the noise alone.
    """
    by_shape = readings.by_shape
    if by_noise == 0:
        return by_shape if readings.is_clear else 0
    if readings.is_small and by_noise != by_shape:
        return _vote_in_small_space(readings, by_noise)
    if by_noise == -by_shape:
        # Only a very clear shape overrules the noise. The noise overrules no clear shape.
        return by_shape if abs(readings.shape) > _OVERRULING_SHAPE else 0
    return by_noise


def _vote_in_small_space(readings: Readings, by_noise: int) -> int:
    """Return the vote in a small space if the shape does not support the noise, see _vote."""
    by_shape = readings.by_shape
    # The paths alone may support the noise.
    if by_noise * readings.paths > _CLEAR_PATHS:
        return by_noise
    # If both readings invert a stream, the streams cannot stay as they are.
    if not readings.hypotheses[0].is_uninverted:
        return by_shape or by_noise
    # Without a vote of the shape, the noise can only confirm the streams as they are.
    is_confirmed = by_noise < 0 and by_shape == 0
    return by_noise if is_confirmed else 0


def _loss_difference(first: PosePairs, second: PosePairs) -> float:
    """Return the loss of the second reading minus that of the first, at their common stamps.

    The difference is 0 if the scale or the noise model of a reading cannot be estimated.
    """
    _, of_first, of_second = np.intersect1d(
        first.stamps_ns,
        second.stamps_ns,
        assume_unique=True,
        return_indices=True,
    )
    first = first[of_first]
    second = second[of_second]
    try:
        fit = estimate_scale(first)
    except NotEnoughDataError:
        return 0.0
    scale = fit.scale if fit.has_own_unit else 1.0
    first = first.child_scaled(scale)
    second = second.child_scaled(scale)
    try:
        return loss_difference(
            first.stamps_ns,
            (first.Ts_pw_p, first.Ts_cw_c),
            (second.Ts_pw_p, second.Ts_cw_c),
        )
    except np.linalg.LinAlgError:
        return 0.0


def _options_of(findings: Collection[Finding]) -> dict[str, float | str]:
    """Return the options that all findings propose."""
    options: dict[str, float | str] = {}
    for suspect in findings:
        options.update(suspect.options)
    return options


def _unclear(
    options: Sequence[Options],
    answers: Sequence[Calibration | None],
    difference: float,
) -> Finding:
    """Return the finding that both readings are possible, with the results of both readings."""
    texts = []
    for reading_options, answer in zip(options, answers, strict=True):
        values = options_in_words(reading_options)
        reading = f"with {values}" if values else "as the streams are"
        pose = _pose_text(answer.T_parent_child) if answer else "no result"
        texts.append(f"{reading} ({pose})")
    code = "inverse" if options[0] else "inverse_both"
    return finding(
        "inverse_unclear",
        code=code,
        first=texts[0],
        second=texts[1],
        difference=difference,
    )


def _pose_text(T_parent_child: np.ndarray) -> str:
    """Format a pose as position (m) and Euler angles (deg)."""
    x, y, z, *rpy = se3.xyz_rpy(T_parent_child)
    roll, pitch, yaw = np.degrees(rpy)
    position = f"x {x:.3f}, y {y:.3f}, z {z:.3f} m"
    return f"{position}, roll {roll:.2f}, pitch {pitch:.2f}, yaw {yaw:.2f} deg"
