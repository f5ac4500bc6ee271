"""What the stream checks tell a person: one row per finding, and one function that fills it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from hand_eye_calib.core.base.config import METHODS, CalibratorConfig, defaults_of
from hand_eye_calib.core.base.option import Options, options_in_words
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


@dataclass(frozen=True)
class _Row:
    """A finding before its values are filled in: ``{stream}`` is "parent", "child" or "both",
    ``{whose}`` "the child stream's". ``code`` is the row's own key unless several rows share it.
    """

    what: str
    advice: str
    cause: str = ""
    severity: Severity = Severity.ERROR
    code: str = ""


_ROWS = {
    # ------------------------------------------------------------------ of one stream
    "disorder": _Row("{text}", "repair the source of the stamps", severity=_NOTE),
    "leap": _Row("{whose} {text}", "{remedy}"),
    "gaps": _Row(
        "the {stream} stream has {gaps} gaps of up to {longest_s:.2f} s ({share:.0%} of the time)",
        "nothing is paired across a gap; raise max_gap if the motion there is smooth",
        severity=_NOTE,
    ),
    "jumps": _Row(
        "{share:.1%} of {whose} steps are jumps: far from the motion before and after",
        "keep a method that rejects outliers; better, repair the source",
        "relocalisations, loop closures or wrong detections",
        severity=_WARNING,
    ),
    "frozen": _Row(
        "the {stream} stream repeats the same pose for {frozen_s:.1f} s ({share:.1%} of the time) "
        "while the other sensor moves",
        "find out why its source stopped, and cut that part out",
    ),
    "interleaved": _Row(
        "{whose} poses alternate between two levels {distance_m:.2g} m apart",
        "give each its own topic, and calibrate one",
        "two sensors, or two programs, publish on one topic",
    ),
    "coarse_positions": _Row(
        "{whose} positions are multiples of {step_m:.3g} m",
        "write positions with 64 bits and all digits, or relative to a near origin",
        "rounding, or numbers of 32 bits far from the origin, such as map coordinates",
        severity=_NOTE,
    ),
    "flat": _Row(
        "the {stream} stream has only x, y and yaw, while the {other} tilts by {tilt_deg:.1f} deg "
        "(root mean square)",
        "give poses with all six degrees of freedom, or record on level ground and measure height, "
        "roll and pitch by hand",
        "odometry in 2D, such as that of wheels",
    ),
    "lengths": _Row(
        "{whose} lengths seem to be in {unit}: in metres the parent would move at "
        "{speed_m_s:.0f} m/s and change its velocity by {acceleration_m_s2:.0f} m/s within a "
        "second{beside}, which no vehicle does",
        "give all lengths in metres, those of a file also by the unit in its header, such as "
        "x_mm; {condition}solve with",
    ),
    # ------------------------------------------------------------------ of both together
    "unrelated": _Row(
        "{text}",
        "check that both sensors are on one rigid body, and that both streams are of one recording "
        "and in known units; if the clocks differ, have the offset estimated (time_offset "
        "estimate); in a file, call angles that are clockwise from north heading, not yaw",
    ),
    "no_turning": _Row(
        "the streams hardly rotate, or at a constant rate, so that neither clock nor extrinsic can "
        "be checked",
        "rotate about several axes (a vehicle: curves, and slopes if there are any)",
    ),
    "too_short": _Row("{text}", "record longer"),
    "not_independent": _Row(
        "{evidence}. Was one computed from the other (TF, fusion)? Then this result only returns "
        "the old transform",
        "give the poses that each sensor measured by itself; if both are exact (motion capture, "
        "surveyed, simulated), give parent_kind exact and child_kind exact",
        severity=_WARNING,
    ),
    "rate_unit": _Row(
        "the {stream} rotates {ratio:.3g} times as far as the other sensor: its rates are {unit} "
        "and were read as {read_as}",
        "name the unit in the header, such as wx_deg_s or wx_rad_s; a message has rad/s",
    ),
    "noisy": _Row(
        "the streams rotate together, but {share:.0%} of the motion stays unexplained: noise or "
        "jumps are strong",
        "expect large standard deviations; record longer and with more motion, or repair the "
        "source",
        severity=_NOTE,
    ),
    "quaternion_order": _Row(
        "{whose} quaternions seem to be written w x y z and read as x y z w",
        "write them as x y z w",
    ),
    "quaternion_names": _Row(
        "{whose} quaternions seem to be written x y z w, under names that say w x y z",
        "put the names of the columns in the order of their values",
        code="quaternion_order",
    ),
    "inverse_orientation": _Row(
        "{whose} orientations seem to be inverted (of the world in the sensor), while the "
        "positions are those of the sensor in its world",
        "invert the orientations alone: negate x, y and z of every quaternion",
    ),
    "left_handed": _Row(
        "{whose} axes are left-handed: with all positions mirrored the streams agree",
        "convert the stream to right-handed axes (REP 103)",
    ),
    "axes": _Row(
        "{whose} positions are in other axes than its orientations: (x, y, z) should be ({detail})",
        "write positions and orientations in the same right-handed axes; of angles in a file name "
        "the column heading if they are clockwise from north, otherwise yaw",
    ),
    "euler_order": _Row(
        "{whose} orientations seem to be angles in the other order: roll about x first, in turning "
        "axes, and read as about fixed axes",
        "write quaternions, or roll, pitch and yaw about the fixed axes x, y and z (REP 103)",
    ),
    "motions": _Row(
        "the {stream} stream holds motions since the pose before, not poses: chained, they agree "
        "with the other stream",
        "write the poses in one world; of motions, the product of all up to each",
        "such as odometry or scan matching that writes increments",
    ),
    "positions_turned": _Row(
        "{whose} positions are in other axes than its orientations, turned by {turned_deg:.0f} deg",
        "write positions and orientations in one and the same world",
    ),
    "earth_centred": _Row(
        "{whose} positions count from the centre of the earth (ECEF), its orientations do not: "
        "they are relative to local axes such as east, north, up",
        "write both in local axes, such as east, north, up (ENU), or both earth-centred; or give "
        "latitude, longitude and height in place of the positions",
    ),
    "ambiguous": _Row(
        "this motion fits another explanation as well: {whose} positions are in other axes, "
        "(x, y, z) for ({detail}). That gives another rotation",
        "look at the result, or rotate about other axes, too (a vehicle: over slopes or kerbs)",
        severity=_WARNING,
    ),
    "inverse": _Row(
        "the {stream} stream seems to hold inverse poses (of the world in the sensor, not of the "
        "sensor in its world)",
        "invert every pose of the {stream} stream",
    ),
    "inverse_both": _Row(
        "both streams seem to hold inverse poses (of the world in the sensor): inverted, their "
        "paths and the lever arm between them are shorter",
        "invert every pose of both streams, or the result is the pose of one world in the other "
        "(which is what a fixed camera beside an arm needs)",
    ),
    "inverse_unclear": _Row(
        "two readings fit alike: {first}, or {second}. Neither noise nor shape of the motion tells "
        "which is right",
        "give parent_invert and child_invert: none for poses of the sensor in its world, poses for "
        "poses of the world in the sensor",
        "small or short motion, or a fixed camera beside an arm",
        code="{code}",
    ),
    "inverse_small": _Row(
        "both streams were inverted, as their noise and shape ask for; poses of a fixed camera "
        "beside an arm look like that, too",
        "give parent_invert none and child_invert none for a fixed camera beside an arm",
        severity=_WARNING,
        code="inverse_both",
    ),
    "time_offset": _Row(
        "the child's clock is {size_s:.4f} +/- {sigma_s:.4f} s {direction} the parent's{beyond}",
        "add {total_s} s in all to the child's stamps, or have it estimated",
    ),
    "large_time_offset": _Row(
        "the child's clock is {size_s:.2f} s {direction} the parent's, and no offset was given",
        "check that both streams are of one vehicle; if the clocks differ so much, give "
        "time_offset {total_s} or estimate",
        "a clock of another epoch (start of the computer or of the recording, GPS week) or time "
        "scale (TAI is 37 s ahead of UTC, GPS 18 s), or a sensor on a vehicle that follows",
        severity=_WARNING,
        code="time_offset",
    ),
    "units": _Row(
        "{whose} lengths are {unit} while the {other}'s are metres (factor {scale:.5g} +/- "
        "{sigma:.2g})",
        "convert them to metres; if the child has no unit, such as a single camera, have the scale "
        "estimated",
    ),
    "unit_or_scale": _Row(
        "the child's lengths must be multiplied by {scale:.5g} +/- {sigma:.2g}: the parent's are "
        "{unit}, or the child has a scale of its own",
        "give parent_scale {factor:g} if the parent's lengths are {unit}, or scale estimate if not",
    ),
    "scale": _Row(
        "the child's lengths must be multiplied by {scale:.4f} +/- {sigma:.4f} to agree with the "
        "parent's",
        "have the scale estimated, or find out which of the two measures wrongly",
    ),
    "one_axis": _Row(
        "{axes} cannot be determined from this motion, and will be unobservable",
        "rotate about other axes, too (a vehicle: over slopes or kerbs), or measure {it} and give "
        "a prior",
        severity=_NOTE,
    ),
    "same_frame": _Row(
        "both streams are of the same frame: the extrinsic is the identity within {size}",
        "give the stream of the child sensor itself",
        "such as two topics of one odometry, or odometry of the robot's base that was derived from "
        "the other sensor",
    ),
    "same_position": _Row(
        "both streams have the same positions and other orientations: the translation between the "
        "sensors is zero ({size})",
        "give positions of the child sensor itself",
        "such as positions that were fused from the other sensor, or computed for another point of "
        "the robot than the sensor",
    ),
    "no_lever_arm": _Row(
        "the positions are those of the other sensor: the lever arm is zero ({size})",
        "give the positions of the antenna or prism itself; if it is there, say so by priors, such "
        "as prior.x 0+/-0.01",
        "such as positions of a fused pose, or of the other topic of one receiver",
        code="same_position",
    ),
    "parallel_axes": _Row(
        "the rotation between the sensors is zero ({size}): both streams seem to be of one sensor",
        "give the rates of the child sensor itself; if the axes are parallel, say so by priors, "
        "such as prior.yaw 0+/-1deg",
        "such as the rates of the parent's own gyroscope",
        code="same_frame",
    ),
    "interpolated": _Row(
        "{share:.0%} of {whose} positions lie on straight lines between their neighbours: they are "
        "interpolated between few measured ones",
        "give the positions as they were measured",
    ),
    "mirrored_positions": _Row(
        "{whose} positions are in left-handed axes",
        "correct the sign of one coordinate, or the order of two (REP 103: x east, y north, z up)",
        code="left_handed",
    ),
    "mirrored_rates": _Row(
        "{whose} rates are about left-handed axes",
        "correct the sign of one axis, or the order of two",
        code="left_handed",
    ),
    "misaligned": _Row(
        "two axes of {whose} rates are not perpendicular, by {degrees:.2f} deg",
        "calibrate the axes of the gyroscope first",
        "a misaligned axis of a gyroscope",
    ),
    "rotation_gain": _Row(
        "the child rotates {gain:.4f} +/- {sigma:.4f} times as far as the parent about ({axis}) in "
        "the parent sensor's frame",
        "calibrate that scale first",
        "a gyroscope or wheel base with a wrong scale, in either stream",
    ),
    "turns": _Row(
        "every rotation of the child is {times:.2g} times that of the parent",
        "correct its orientations: x, y, z of a quaternion are for half the angle; angles in a "
        "file need their unit in the header, such as yaw_deg",
        "radians read as degrees, or half or twice the angles",
        code="rotation_gain",
    ),
    "late": _Row(
        "{whose} {part} are {delay_s:.3f} +/- {sigma_s:.3f} s later than its {others}: at this "
        "speed they are off by {shift_m:.2g} m",
        "use poses from one source, before any filter",
        "positions, or heights of a barometer, from another source or filter than the rest, or "
        "another stream of another body, such as a trailer",
        code="{code}",
    ),
    "worlds_turned": _Row(
        "{whose} positions are turned against its orientations by {turned_deg:.2f} deg, mainly "
        "about {axis} of its world",
        "give positions and orientations in one and the same world",
        "magnetic declination or grid convergence in one of them, or poses that were fused with "
        "the other sensor's through a wrong transform",
    ),
    "model_scale": _Row(
        "the child's lengths are {size} % {than} than the parent's; the result allows for it",
        "find out which of the two measures wrongly; have the scale estimated if neither is to be "
        "trusted",
        "a wheel radius, a camera's baseline or a map that is stretched",
    ),
    "axis_scale": _Row(
        "{whose} {axis} coordinates are {factor:.4f} +/- {sigma:.4f} times as long as its others",
        "write all coordinates in metres, from one source",
        "heights in feet, of a barometer or constant (2D), or map coordinates whose scale depends "
        "on the latitude",
    ),
    "smoothed": _Row(
        "{whose} {part} are smoothed over about {smoothing_s:.2f} s, the other's are not: this "
        "displaces poses by about {shift_m:.2g} m, and the translation by as much or more",
        "use the poses before that filter",
        "a low-pass or smoothing filter",
        code="smoothed_{part}",
    ),
    "world_drift": _Row(
        "the child's world rotates by {deg_per_minute:.2g} deg and moves by {m_per_minute:.2g} m a "
        "minute against the parent's: at {percent:.2g} % of the sensor's speed",
        "use the poses before that correction, in the frame of the odometry",
        "a map that is corrected bit by bit, a heading that drifts, or poses published in a frame "
        "that moves",
        severity=_WARNING,
    ),
    # ------------------------------------------------------------------ of stops
    "frozen_stops": _Row(
        "the {stream}'s pose is the same as before at {share:.0%} of the stops, while the other "
        "side moves",
        "read the pose anew at every stop, once it stands still; leave these stops out",
        "a pose that was stored before it was updated",
        code="frozen",
    ),
    "rows": _Row(
        "the rows of both sides do not belong together: they agree {text}",
        "pair each pose with the one of the same stop",
        "a row that is missing on one side, or files sorted by name",
    ),
    "angles": _Row(
        "{whose} rotations agree with the other's if their numbers are {detail}",
        "convert them, or name the columns of the file by what they are: roll_deg, pitch_deg, "
        "yaw_deg or rotvec_x, rotvec_y, rotvec_z",
    ),
    "unrelated_stops": _Row(
        "both sides rotate by different angles between the stops ({off_deg:.0f} deg in the median)",
        "check that both are of one session and row by row of the same stops, and what the numbers "
        "of the rotations are: angles or rotation vectors, degrees or radians",
        code="unrelated",
    ),
    "disagreeing_stops": _Row(
        "no camera and target explain {share:.0%} of the {part} of these stops",
        "check axes and conventions of both sides, that the camera and the target are fixed, and "
        "that rows belong together",
        "positions of another frame than the rotations, a target or a camera that moved, wrong "
        "parameters of the arm",
        code="unrelated",
    ),
    "inverse_stops": _Row(
        "one of the two files has inverse poses (of the world in the sensor, such as a target in "
        "the camera)",
        "give parent_invert poses if it is the parent's; if it is the child's",
        code="inverse",
    ),
    "ambiguous_stops": _Row(
        "two conventions explain these stops alike: {given}, or {other}",
        "look up the convention of both sources and give the options of the first, or",
        code="ambiguous",
    ),
    "both_readings": _Row(
        "a camera on the hand and one beside the robot fit these stops equally well",
        "record more stops, with rotations about two axes: 15 or more are good",
        code="ambiguous",
    ),
    "setup": _Row(
        "the stops fit a camera {other}, not one {place}",
        "leave setup out; or, if one side or both hold inverse poses, give parent_invert poses "
        "(robot), child_invert poses (target), or both",
    ),
    "copied_stops": _Row(
        "the poses of the target are those of the robot: the camera and the target would be at the "
        "origins of hand and base",
        "give the poses of the target as the camera measured them",
        code="same_frame",
    ),
    "outlier_stops": _Row(
        "{count} of {n_stops} stops do not fit the others and were left out: {numbers}",
        "look at these stops: is the target detected well, and does the arm rest?",
        "a target that was detected mirrored, or a stop during a motion",
        severity=_WARNING,
        code="outliers",
    ),
    "stop_units": _Row(
        "{whose} lengths are {unit}",
        "convert them to metres, or solve with",
        code="units",
    ),
    "target_scale": _Row(
        "the child's lengths must be multiplied by {scale:.4f} +/- {sigma:.4f}: they are "
        "{times:.4g} times as long as the parent's",
        "measure the target and give its size, or have the scale estimated",
        "a target of another size, or a wrong focal length",
        code="scale",
    ),
    "reading": _Row(
        "{what}: probably the poses of one or both sides are inverse, or both are exchanged",
        "give parent_invert poses if the robot's are, child_invert poses if the target's are, both "
        "if both are, and parent_invert none with child_invert none if all is right",
        code="inverse",
    ),
    "turning_about_one_axis": _Row(
        "the stops do not turn about two axes",
        "turn the hand about at least two axes between them",
        severity=_NOTE,
        code="one_axis",
    ),
    "parts_turned": _Row(
        "two parts of the recording are sound by themselves, and their rotations differ by {size}",
        "calibrate the parts before and after on their own",
        "a source that started anew with other axes, or streams that were swapped",
        code="mount_moved",
    ),
    "mount_moved": _Row(
        "the extrinsic changes {at_s:.0f} s after the start by {size}",
        "tighten it and record again, or calibrate the parts before and after on their own",
        "a mount that came loose or was knocked, or an estimator that started anew",
    ),
}


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
    row = _ROWS[key]
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
