"""Findings of the stream checks: texts by key; severity by the size of the fault or by options."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.config import (
    METHODS,
    CalibratorConfig,
    defaults_of,
)
from hand_eye_calib.core.base.option import Options, options_in_words
from hand_eye_calib.core.base.spelling import PLACEHOLDER
from hand_eye_calib.core.base.text import axes_in_words
from hand_eye_calib.core.results.records import (
    Finding,
    Severity,
    gravest_first,
    words_of,
)

__all__ = [
    "Finding",
    "Severity",
    "answered",
    "finding",
    "graded",
    "gravest_first",
    "repair_message",
    "unobservable_axes",
]

# Jumps in at most this share of the steps hardly affect methods that reject outliers.
_FEW_JUMPS = 0.02

_NEVER = float("inf")


class Limits(NamedTuple):
    """Limits of the size of a fault. They determine the severity of its finding.

    Attributes
    ----------
    sigmas : float
        Smallest size in standard deviations.
    note, warning, error : float
        Smallest size for a note, a warning and an error, in the unit of the fault.
    """

    sigmas: float
    note: float
    warning: float
    error: float


# Each limit is at least half of the fault that changes an extrinsic by 1 cm or 0.5 deg.
LIMITS = {
    # Clock offset, s.
    "time_offset": Limits(5.0, 0.005, 0.01, 0.1),
    # Scale minus 1. The significance was already tested by the fit.
    "scale": Limits(0.0, 0.01, 0.01, 0.03),
    # Jumps, as a share of the steps.
    "jumps": Limits(0.0, 0.002, 0.002, _NEVER),
    # Repeated poses, as a share of the time. A second or more is at least a note.
    "frozen": Limits(0.0, 1e-9, 0.02, 0.02),
    # Rounding step, m.
    "coarse_positions": Limits(0.0, 0.002, 0.005, 0.02),
    # Displacement of the positions by the delay, m. At constant speed a delay equals a lever arm,
    # so that fewer standard deviations suffice than for smoothing.
    "late": Limits(4.5, 0.008, 0.008, 0.05),
    # Displacement of the positions by the smoothing, m. Its standard deviation does not contain the
    # noise of the regressors.
    "smoothed": Limits(8.0, 0.008, 0.008, 0.02),
    # Largest distance between the interpolated line and the true arc, m.
    "interpolated": Limits(0.0, 0.0, 0.0, 0.02),
    # Displacement of a point 1 m from the sensor by a correction, m.
    "propagated": Limits(0.0, 0.008, 0.008, 0.03),
    # Displacement of the positions by the scatter of the stamps, m. Most of the scatter averages
    # out.
    "arrival": Limits(0.0, 0.008, 0.008, _NEVER),
    # Gain of the rotations minus 1.
    "rotation_gain": Limits(6.0, 0.003, 0.003, 0.03),
    # Gain of the angular rates about an axis of the sensor, minus 1.
    "gain_of_axis": Limits(6.0, 0.003, 0.003, 0.03),
    # Symmetric part of the matrix that maps the rates of one sensor to those of the other, rad. The
    # rotation of X is wrong by about as much. The visual-inertial odometries of three Tango devices
    # differ by up to 0.016.
    "misaligned": Limits(6.0, 0.004, 0.004, 0.0175),
    # Log ratio of the rotation angles of both streams.
    "turns": Limits(0.0, 0.4, 0.4, 0.4),
    # Scale of the noise model, minus 1. Scales of odometries are accurate to 1 %. Without this
    # limit, three recordings with scale errors of 0.9 to 11 % were judged USE.
    "model_scale": Limits(3.0, 0.01, 0.03, _NEVER),
    # Scale of one axis minus 1.
    "axis_scale": Limits(6.0, 0.015, 0.015, 0.05),
    # Angle between both worlds, rad.
    "worlds_turned": Limits(
        6.0, np.radians(0.5), np.radians(0.5), np.radians(1.5)
    ),
    # Drift as a share of the speed. An error of the direction by 0.003 rad is half of the usual
    # target of a rotation.
    "world_drift": Limits(6.0, 0.003, 0.003, _NEVER),
    # Displacement of a point up to 1 m from the sensor, m.
    "mount_moved": Limits(0.0, 0.005, 0.005, 0.0175),
}


def graded(
    key: str, stream: str, size: float, sigma: float = 0.0, /, **values: Any
) -> Finding | None:
    """Return a finding whose severity follows from its size, or None below its limits.

    Parameters
    ----------
    key : str
        Key of the words and of the limits.
    stream : str
        "parent", "child" or "both".
    size, sigma : float
        Size of the fault and its standard deviation, in the unit of the limits.
    **values
        Values of the finding, see :func:`finding`.
    """
    limits = LIMITS[key]
    size = abs(size)
    # NaN is below all limits.
    is_noted = size >= max(limits.note, limits.sigmas * sigma)
    if not is_noted:
        return None
    if size > limits.error:
        severity = Severity.ERROR
    elif size > limits.warning:
        severity = Severity.WARNING
    else:
        severity = Severity.NOTE
    return finding(key, stream, severity, **values)


def finding(
    key: str,
    stream: str = "both",
    severity: Severity | None = None,
    options: Mapping[str, float | str] | None = None,
    **values: Any,
) -> Finding:
    """Return a finding with the texts of a key and with measured values.

    Parameters
    ----------
    key : str
        Key of its words, see :mod:`hand_eye_calib.core.checks.words`.
    stream : str
        "parent", "child" or "both".
    severity : Severity, optional
        Severity that replaces the usual severity of the key.
    options : mapping, optional
        Options that repair the fault, by name.
    **values
        Values that appear in the texts, and further measured numbers.
    """
    words = words_of(key)
    return Finding(
        code=words.code.format(**values) or key,
        key=key,
        stream=stream,
        severity=severity or words.severity,
        values={name: _plain_value(value) for name, value in values.items()},
        options=options or {},
    )


def _plain_value(value: Real | str) -> float | int | str:
    """Convert a NumPy number to a Python number, which files can contain. Texts are unchanged."""
    if isinstance(value, str):
        return value
    return int(value) if isinstance(value, Integral) else float(value)


# Code of a finding, and the option with its value that corrects the convention of a stream. The
# option is without the name of the stream. Streams are corrected in this order.
CONVENTIONS = {
    "quaternion_order": ("quaternion", "wxyz"),
    "quaternion_names": ("quaternion", "yzwx"),
    "inverse": ("invert", "poses"),
    "inverse_orientation": ("invert", "orientations"),
}


def conventions(code: str, stream: str) -> dict[str, float | str]:
    """Return the options that correct the convention of a stream ("parent", "child" or "both").

    The result is empty for a finding that is not about conventions.
    """
    if code not in CONVENTIONS:
        return {}
    kind, value = CONVENTIONS[code]
    names = ("parent", "child") if stream == "both" else (stream,)
    return {f"{name}_{kind}": value for name in names}


def repair_message(
    findings: Sequence[Finding], options: Options, verdicts: str = ""
) -> str:
    """Return the message about repaired faults: the options that were set, and how to undo them.

    Parameters
    ----------
    findings : sequence of Finding
        Findings about the faults.
    options : mapping
        Options that repair the faults, and their values.
    verdicts : str
        Text about the verdicts before and after the repair.
    """
    faults = "; ".join([issue.what for issue in findings])
    used = options_in_words(options)
    undo = options_in_words(defaults_of(options))
    return (
        f"repaired: {faults}. Solved with {used}{verdicts} (undo with {undo})"
    )


def unobservable_axes(axes: Sequence[str]) -> Finding:
    """Return the note that the motion does not determine some axes of X."""
    options = {f"prior.{axis}": PLACEHOLDER for axis in axes}
    pronoun = "it" if len(axes) == 1 else "them"
    return finding(
        "one_axis", options=options, axes=axes_in_words(axes), it=pronoun
    )


def _beside_priors(note: Finding, current: Options) -> Finding:
    """Return the note of :func:`unobservable_axes` for the axes that have no prior.

    If all axes have a prior, the note contains this fact. ``current`` are the options in use.
    """
    axes = [name.partition(".")[2] for name in note.options]
    without_prior = [axis for axis in axes if not current[f"prior.{axis}"]]
    if without_prior:
        return unobservable_axes(without_prior)
    return finding("one_axis_with_prior", axes=axes_in_words(axes))


def answered(
    findings: Sequence[Finding], config: CalibratorConfig
) -> list[Finding]:
    """Return findings with the severity that they have under a configuration.

    A finding becomes a note if the configuration has all options that repair the fault. The
    finding about jumps becomes a note if they are few and the method rejects outliers. Axes with a
    prior are not called unknown.
    """
    current = config.to_options()
    graded_findings = []
    for found in findings:
        options = dict(found.options)
        if found.code in CONVENTIONS:
            # The checks examine the streams after the corrections of the configuration. If a check
            # asks for a correction that was already made, this correction was the mistake: propose
            # the default in its place.
            repeated = [
                name
                for name, value in options.items()
                if current[name] == value
            ]
            options |= defaults_of(repeated)
        is_answered = options and all(
            current.get(name) == options[name] for name in options
        )
        if found.code == "jumps" and METHODS[config.method].rejects_outliers:
            is_answered = is_answered or found.evidence["share"] < _FEW_JUMPS
        severity = Severity.NOTE if is_answered else found.severity
        answer = replace(found, options=options, severity=severity)
        if found.key == "one_axis":
            answer = _beside_priors(found, current)
        graded_findings.append(answer)
    return graded_findings
