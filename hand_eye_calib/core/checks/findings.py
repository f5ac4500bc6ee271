"""Make findings of the stream checks from a key and values, and grade them by their size."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np

from hand_eye_calib.core.base.config import METHODS, CalibratorConfig, defaults_of
from hand_eye_calib.core.base.option import Options, options_in_words
from hand_eye_calib.core.checks.words import words_of
from hand_eye_calib.core.results.records import Finding, Severity, gravest_first

__all__ = [
    "Finding",
    "Severity",
    "answered",
    "finding",
    "graded",
    "gravest_first",
    "repair_message",
]

_NOTE = Severity.NOTE
_WARNING = Severity.WARNING

# Jumps up to this share hardly matter to the methods that reject outliers.
_FEW_JUMPS = 0.02


_NEVER = float("inf")

# How many standard deviations a fault must exceed, and from which size on it is a note, a warning
# and an error: at least half of what spoils an extrinsic by 1 cm or 0.5 deg.
LIMITS = {
    "time_offset": (5.0, 0.005, 0.01, 0.1),  # s
    "scale": (0.0, 0.01, 0.01, 0.03),  # of the factor, less 1; the fit knows more
    "jumps": (0.0, 0.002, 0.002, _NEVER),  # share of the steps
    # Share of the time; a second or more is at least a note.
    "frozen": (0.0, 1e-9, 0.02, 0.02),
    "coarse_positions": (0.0, 0.002, 0.005, 0.02),  # m
    # A delay is most of a lever arm at constant speed and needs less; the standard deviation of
    # smoothing does not contain noise of the columns. Both by the shift of positions, m.
    "late": (4.5, 0.008, 0.008, 0.05),
    "smoothed": (8.0, 0.008, 0.008, 0.02),
    "rotation_gain": (6.0, 0.003, 0.003, 0.03),  # of the factor, less 1
    # Symmetric part of the matrix between the rates (rad): the rotation is off by as much. The
    # visual-inertial odometries of three tango devices differ by up to 0.016.
    "misaligned": (6.0, 0.004, 0.004, 0.0175),
    "turns": (0.0, 0.4, 0.4, 0.4),  # logarithm of a factor that noise does not cause
    # Of the factor, less 1: of three scales of 0.9 to 11 % under USE, nobody was told but in the
    # paragraph on noise. Odometries are right to 1 %.
    "model_scale": (3.0, 0.01, 0.03, _NEVER),
    "axis_scale": (6.0, 0.015, 0.015, 0.05),  # of the factor, less 1
    "worlds_turned": (6.0, np.radians(0.5), np.radians(0.5), np.radians(1.5)),  # rad
    # Share of the speed: the direction is then off by half the usual target of a rotation.
    "world_drift": (6.0, 0.003, 0.003, _NEVER),
    "mount_moved": (0.0, 0.005, 0.005, 0.0175),  # m, of a place up to 1 m from the sensor
}


def graded(
    key: str, stream: str, size: float, sigma: float = 0.0, /, **values: Any
) -> Finding | None:
    """The finding of a row, as grave as its size; None for a size that does not matter, or within
    its noise.
    """
    sigmas, *begin = LIMITS[key]
    if not abs(size) >= max(begin[0], sigmas * sigma):
        return None
    severity = [_NOTE, _WARNING, Severity.ERROR][sum(abs(size) > limit for limit in begin[1:])]
    return finding(key, stream, severity, **values)


def finding(
    key: str,
    stream: str = "both",
    severity: Severity | None = None,
    options: Mapping[str, float | str] | None = None,
    **values: Any,
) -> Finding:
    """The finding of a row with its values.

    Parameters
    ----------
    key : str
        Of the row.
    stream : str
        "parent", "child" or "both".
    severity : Severity, optional
        Instead of that of the row.
    options : mapping, optional
        Options that help, by name.
    **values
        What the texts of the row name; the numbers among them are the evidence.
    """
    row = words_of(key)
    whose = "both streams'" if stream == "both" else f"the {stream} stream's"
    values |= {"stream": stream, "whose": whose}
    return Finding(
        code=row.code.format(**values) or key,
        stream=stream,
        severity=severity or row.severity,
        what=row.what.format(**values),
        advice=row.advice.format(**values),
        cause=row.cause.format(**values),
        evidence={name: float(value) for name, value in values.items() if isinstance(value, Real)},
        options=options or {},
    )


# Code of a finding to the option that puts a stream right, and its value, in the order in which
# mistakes are undone.
CONVENTIONS = {
    "quaternion_order": ("quaternion", "wxyz"),
    "quaternion_names": ("quaternion", "yzwx"),
    "inverse": ("invert", "poses"),
    "inverse_orientation": ("invert", "orientations"),
}


def conventions(code: str, stream: str) -> dict[str, float | str]:
    """The options that put the convention of a stream, or of both, right; empty if none can."""
    if code not in CONVENTIONS:
        return {}
    kind, value = CONVENTIONS[code]
    return {f"{each}_{kind}": value for each in ("parent", "child") if stream in (each, "both")}


def repair_message(findings: Sequence[Finding], options: Options, verdicts: str = "") -> str:
    """Return what was repaired, the options that did it, and those that undo it.

    Parameters
    ----------
    findings : sequence of Finding
        Those that the options repair.
    options : mapping
    verdicts : str
        Verdicts with and without the repair, in words.
    """
    what = "; ".join(found.what for found in findings)
    undo = options_in_words(defaults_of(options))
    return f"repaired: {what}. Solved with {options_in_words(options)}{verdicts} (undo with {undo})"


def answered(findings: Sequence[Finding], config: CalibratorConfig) -> list[Finding]:
    """Grade findings by the options that are set. A finding that an option answers becomes a note,
    and so do a few jumps if the method rejects outliers.
    """
    given = config.to_options()
    told = []
    for each in findings:
        options = dict(each.options)
        if each.code in CONVENTIONS:
            # A stream that was put right already, and needs it again, was right before.
            set_so = [name for name, value in options.items() if given[name] == value]
            options |= defaults_of(set_so)
        is_answered = options and all(given.get(name) == options[name] for name in options)
        if each.code == "jumps" and METHODS[config.method].rejects_outliers:
            is_answered = is_answered or each.evidence["share"] < _FEW_JUMPS
        severity = Severity.NOTE if is_answered else each.severity
        told.append(replace(each, options=options, severity=severity))
    return told
