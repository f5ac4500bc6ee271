"""Choice between the two readings of both streams.

A reading assumes that both streams contain poses of the sensors, or inverse poses. The second
reading inverts all poses of the first reading. Both fit equally well
(:class:`~hand_eye_calib.core.checks.hypothesis.Readings`), so there are two other criteria: the
likelihood of the noise (:mod:`~hand_eye_calib.core.noise.readings`), and the shape of the motion.
The noise decides, unless a clear shape is evidence for the other reading. In a small space, the
noise decides only if the shape is evidence for the same reading: a camera that observes a target
has the same noise as inverse poses. If the criteria are not clear, the verdict is DO NOT USE, and
both results are reported.
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

# The noise decides if the losses (negative log likelihoods) of both readings differ by more than
# this. In 200 recordings without target cameras, the loss of the wrong reading was at most 9
# smaller than that of the right one.
CLEAR_NOISE = 20.0

# A shape decides against the noise if `Readings.shape` (a logarithm) exceeds this in size. In 190
# recordings, the shape never had the wrong sign. The noise was wrong for a stream almost without
# errors, and the shape there was -2.9.
_OVERRULING_SHAPE = 2.0

# In a small space, `Readings.paths` (a logarithm) is evidence for the reading of the noise if it
# exceeds this.
_CLEAR_PATHS = 0.06


@dataclass(frozen=True)
class Choice:
    """Chosen reading of both streams.

    Attributes
    ----------
    findings : tuple of Finding
        Findings of the check for the chosen reading.
    doubts : tuple of Finding
        Findings about an uncertain choice. They are added to the result.
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
        Function ``pairs_of(options)`` that returns the pose pairs with these options, on one clock.
    answer_with : callable
        Function ``answer_with(options)`` that returns the result with these options, on one clock;
        None if the solve fails.
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
    # The findings of the chosen reading replace the findings of both readings.
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
    """Return the index of the right reading, or None if noise and shape are not clear.

    Parameters
    ----------
    readings : Readings
    difference : float
        Loss of the second reading minus loss of the first reading.
    has_late_stamps : bool
        Whether the stamps of a stream are times of arrival.
    """
    by_noise = 0
    if abs(difference) > CLEAR_NOISE:
        by_noise = -int(np.sign(difference))
    # Late stamps move each pose along its path, which looks like the noise of inverse poses. A
    # clear shape then decides alone.
    if has_late_stamps and readings.by_shape != 0:
        by_noise = 0
    choice = _clear_choice(readings, by_noise)
    is_first_uninverted = readings.hypotheses[0].is_uninverted
    is_inverted_by_noise = choice == 1 and readings.by_shape <= 0
    if is_first_uninverted and has_late_stamps and is_inverted_by_noise:
        # Without this rule, an excavator with late stamps was read as inverse, 5 m off.
        return None
    if is_first_uninverted and choice == 0:
        # If nothing is clear, keep the streams as they are, unless a criterion is evidence for
        # inversion.
        is_inversion_supported = readings.shape >= 0.0 or by_noise > 0
        choice = 0 if is_inversion_supported else -1
    # Convert 1 (second reading) and -1 (first reading) to an index.
    return {1: 1, -1: 0}.get(choice)


def _clear_choice(readings: Readings, by_noise: int) -> int:
    """Return 1 for the second reading, -1 for the first, and 0 if neither is clear.

    ``by_noise`` has the same values; it is the choice by the noise alone.
    """
    by_shape = readings.by_shape
    if by_noise == 0:
        return by_shape if readings.is_clear else 0
    if readings.is_small and by_noise != by_shape:
        return _choice_in_small_space(readings, by_noise)
    if by_noise == -by_shape:
        # Only a very clear shape decides against the noise. If the shape is clear but not so much,
        # nothing decides.
        return by_shape if abs(readings.shape) > _OVERRULING_SHAPE else 0
    return by_noise


def _choice_in_small_space(readings: Readings, by_noise: int) -> int:
    """Return the clear choice in a small space, if shape and noise do not agree."""
    by_shape = readings.by_shape
    # The paths alone, without the lever arms, may agree with the noise.
    if by_noise * readings.paths > _CLEAR_PATHS:
        return by_noise
    # If both readings invert a stream, no reading keeps the streams as they are.
    if not readings.hypotheses[0].is_uninverted:
        return by_shape or by_noise
    # If the shape is not clear, the noise may only confirm the streams as they are.
    is_confirmed = by_noise < 0 and by_shape == 0
    return by_noise if is_confirmed else 0


def _loss_difference(first: PosePairs, second: PosePairs) -> float:
    """Return the loss of the second reading minus the loss of the first, at common stamps.

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
    """Return all options that the findings propose."""
    options: dict[str, float | str] = {}
    for suspect in findings:
        options.update(suspect.options)
    return options


def _unclear(
    options: Sequence[Options],
    answers: Sequence[Calibration | None],
    difference: float,
) -> Finding:
    """Return the finding that both readings are possible, with their results."""
    texts = []
    for reading_options, answer in zip(options, answers, strict=True):
        values = options_in_words(reading_options)
        reading = f"with {values}" if values else "without options"
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
