"""The six axes of a node: progress towards the targets, printed pose, and shift of the mount."""

import math
from collections.abc import Iterator

from hand_eye_calib.core.base.stats import LARGEST_OF_SIX
from hand_eye_calib.core.base.text import (
    ABOUT,
    amount,
    change,
    fixed,
    two_digits,
)
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.online.live.progress import AXIS_KEYS, AxisProgress
from hand_eye_calib.online.live.state import (
    ExtrinsicState,
    MountState,
    ProgressState,
    ResultState,
)
from hand_eye_calib.online.watch.view import Bar, Line, Tone

# Names of the axes of the parent sensor's frame.
_NAMES = {axis: f"along {axis}" for axis in "xyz"}
_NAMES |= {axis: f"about {direction}" for axis, direction in ABOUT.items()}
# Meaning of the axes on a vehicle (REP 103).
_ON_A_VEHICLE = {
    "x": "forward",
    "y": "left",
    "z": "up",
    "roll": "tilt to a side",
    "pitch": "nose up or down",
    "yaw": "turn",
}

# Largest share of the bar for an axis outside its target. A full bar would contradict "go on".
_LARGEST_OUTSIDE = 0.99


def bar_of(
    axis: str, session: ProgressState, extrinsic: ExtrinsicState | None
) -> Bar:
    """Return the bar of an axis."""
    row = session.progress.axes[AXIS_KEYS[axis]]
    target = amount(axis, row.target)
    has_result = not session.progress.is_faulty
    if extrinsic and extrinsic.contradicted:
        has_result = False
    if not has_result:
        tone = Tone.UNKNOWN
        word = "no usable result"
        sigma = f"wanted: {target}"
    elif math.isfinite(row.sigma):
        tone, word = _progress_in_words(row, session, axis)
        sigma = f"± {amount(axis, row.sigma)}"
        sigma += ", typed in" if _has_prior(row) else f" of {target}"
    else:
        tone = Tone.UNKNOWN
        # If the standard deviation is unknown and the time left is 0, these streams never observe
        # the axis.
        is_out_of_reach = math.isfinite(row.seconds_left)
        word = "out of reach" if is_out_of_reach else "unknown yet"
        sigma = "" if is_out_of_reach else f"wanted: {target}"
    meaning = (
        _ON_A_VEHICLE[axis] if extrinsic and extrinsic.has_vehicle_axes else ""
    )
    difference = _difference(axis, session)
    share = _share_of(row) if has_result else 0.0
    return Bar(_NAMES[axis], meaning, share, tone, word, sigma, difference)


def _has_prior(row: AxisProgress) -> bool:
    """Return whether an axis has a prior: no time is left, although the target is not reached."""
    return row.seconds_left == 0 and row.target < row.sigma < math.inf


def _share_of(row: AxisProgress) -> float:
    """Return the information on an axis (1 / variance) as a share of the required information."""
    if row.sigma <= row.target or _has_prior(row):
        return 1.0
    return min((row.target / row.sigma) ** 2, _LARGEST_OUTSIDE)


def _difference(axis: str, session: ProgressState) -> str:
    """Return the difference of an axis from the installed transform; empty if unknown."""
    if session.comparison is None or not session.comparison.differences:
        return ""
    row = session.comparison.differences[0].axes[AXIS_KEYS[axis]]
    return change(axis, row.difference, row.sigma)


def _progress_in_words(
    row: AxisProgress, session: ProgressState, axis: str
) -> tuple[Tone, str]:
    """Return tone and progress in words for an axis with a standard deviation."""
    if row.seconds_left == 0:
        return Tone.GOOD, "enough"
    will_fail = session.progress.will_not_get_there
    is_limiting = session.progress.limiting_axis == AXIS_KEYS[axis]
    word = "not enough yet"
    if math.isfinite(row.seconds_left):
        word = "takes longest" if is_limiting else word
    elif will_fail:
        word = "not with this motion"
    return Tone.ACT if is_limiting else Tone.BUSY, word


def pose_values(result: ResultState) -> Iterator[tuple[str, str]]:
    """Yield the axes of the printed pose with values and standard deviations."""
    for axis in AXES:
        value = result.pose.get(axis)
        sigma = result.pose_sigma.get(axis)
        if value is None or sigma is None:
            yield axis, "unknown"
        elif axis in ROTATIONS:
            yield (
                axis,
                f"{fixed(math.degrees(value), 2)} ± {two_digits(math.degrees(sigma))} deg",
            )
        else:
            yield axis, f"{value:.3f} m ± {amount(axis, sigma)}"


def mount_line(axis: str, mount: MountState) -> Line:
    """Return the line of one axis of a monitored mount.

    The text has the shift along or about the axis, or the smallest shift that ten minutes of motion
    would detect.
    """
    key = AXIS_KEYS[axis]
    shift = mount.shift.get(key) or 0.0
    sigma = mount.shift_sigma.get(key) or math.inf
    visible = mount.visible_10min.get(key)
    tone = Tone.UNKNOWN
    text = "cannot be watched with this motion"
    # An axis has moved if noise seldom causes a shift of this size in the largest of six axes.
    if abs(shift) > LARGEST_OF_SIX * sigma:
        tone = Tone.BAD
        text = f"moved by {amount(axis, shift)} ± {amount(axis, sigma)}"
    elif visible is not None and visible < sigma < math.inf:
        # The alarm is about other axes, and a large shift makes the noise of all axes larger.
        text = f"cannot tell (± {amount(axis, sigma)})"
    elif visible is not None:
        tone = Tone.GOOD
        text = f"not moved (detects {amount(axis, visible)})"
    elif mount.is_learning or not mount.visible_10min:
        text = "not known yet"
    return Line(tone, _NAMES[axis], text)
