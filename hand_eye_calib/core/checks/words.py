"""Texts of the findings of the stream checks, filled with the values of the finding."""

from dataclasses import dataclass

from hand_eye_calib.core.results.records import AS_WRITTEN, Severity


@dataclass(frozen=True)
class FindingWords:
    """Texts of a finding, with the values of the finding in braces.

    Every finding also has ``{stream}`` (parent, child or both) and ``{whose}`` ("the child
    stream's").

    Attributes
    ----------
    what : str
        Description of the fault.
    advice : str
        Advice to the user.
    cause : str
        Usual cause, if the description does not name it.
    severity : Severity
        Severity, unless the check returns another one.
    code : str
        Public code of the finding; empty if the key of the row is the code.
    """

    what: str
    advice: str
    cause: str = ""
    severity: Severity = Severity.ERROR
    code: str = ""


#: Advice for streams that do not agree.
UNRELATED_ADVICE = (
    "check that both sensors are on one rigid body, and that both streams are of one recording and "
    "in known units; if the clocks differ, have the offset estimated (time_offset estimate); if a "
    "file has angles clockwise from north, name them heading, not yaw"
)

#: Texts of the findings of the core, by the key of the finding.
WORDS = {
    # Findings whose complete texts come from a document.
    AS_WRITTEN: FindingWords("{what}", "{advice}", "{cause}"),
    # Findings about one stream.
    "disorder": FindingWords(
        "{text}", "repair the source of the stamps", severity=Severity.NOTE
    ),
    "leap": FindingWords("{whose} {leap}", "{remedy}"),
    "gaps": FindingWords(
        "the {stream} stream has gaps: {gaps}, of up to {longest_s:.2f} s ({share:.0%} of the "
        "time)",
        "no poses are paired across a gap; raise max_gap if gaps have smooth motion",
        severity=Severity.NOTE,
    ),
    "jumps": FindingWords(
        "{share:.1%} of {whose} steps are jumps: far from the motion before and after",
        "keep a method that rejects outliers; better, repair the source",
        "relocalisations, loop closures or wrong detections",
        severity=Severity.WARNING,
    ),
    "frozen": FindingWords(
        "the {stream} stream repeats the same pose for {frozen_s:.1f} s ({share:.1%} of the time) "
        "while the other sensor moves",
        "find out why the source stopped; {longest} without this fault",
    ),
    "interleaved": FindingWords(
        "{whose} poses alternate between two paths {distance_m:.2g} m apart",
        "give each publisher its own topic, and calibrate with one of these topics",
        "two sensors, or two programs, publish on one topic",
    ),
    "interpolated": FindingWords(
        "{share:.0%} of {whose} positions lie on straight lines between their neighbours: they are "
        "interpolated between few measured positions",
        "use the measured positions, without interpolation",
    ),
    "propagated": FindingWords(
        "{whose} poses jump every {interval_s:.2g} s by {size_m:.2g} m or rad: they are predicted, "
        "and each jump is a correction by a measurement",
        "use only the poses at the corrections, or the poses of a smoother",
        "propagation by an IMU or at constant velocity between fixes",
        severity=Severity.WARNING,
    ),
    "arrival": FindingWords(
        "{whose} stamps scatter by {scatter_ms:.0f} ms, and {share:.0%} of them come right after "
        "the previous stamp: at this speed poses are off by {shift_m:.2g} m",
        "use the stamps of the measurements (header stamps), or smooth the stamps",
        "stamps of the arrival of messages that waited in a queue",
        severity=Severity.WARNING,
    ),
    "coarse_positions": FindingWords(
        "{whose} positions are multiples of {step_m:.3g} m",
        "write positions with 64 bits and all digits, or relative to a near origin",
        "rounding, or numbers of 32 bits far from the origin, such as map coordinates",
        severity=Severity.NOTE,
    ),
    "flat": FindingWords(
        "the {stream} stream has only x, y and yaw, while the {other} tilts by {tilt_deg:.1f} deg "
        "(root mean square)",
        "give poses with all six degrees of freedom, or record on level ground and measure height, "
        "roll and pitch by hand",
        "odometry in 2D, such as that of wheels",
    ),
    "lengths": FindingWords(
        "{whose} lengths seem to be in {unit}: in metres the parent would move at "
        "{speed_m_s:.0f} m/s and change its velocity by {acceleration_m_s2:.0f} m/s within a "
        "second{beside}, which no vehicle does",
        "convert all lengths to metres, or name the unit in the header of the file, such as x_mm; "
        "{condition}solve with",
    ),
    # Findings about both streams.
    "unrelated": FindingWords(
        "the streams agree at no clock offset: {doubt}",
        UNRELATED_ADVICE,
    ),
    "unexplained": FindingWords(
        "no extrinsic, scale or usual mistake explains {share:.0%} of the motion",
        UNRELATED_ADVICE,
        code="unrelated",
    ),
    "no_turning": FindingWords(
        "the streams hardly rotate, or at a constant rate, so that neither clock nor extrinsic can "
        "be checked",
        "rotate about several axes (a vehicle: curves, and slopes if there are any)",
    ),
    "only_one_turns": FindingWords(
        "the {stream}'s orientation is the same in all poses, while the {other} turns by "
        "{degrees:.0f} deg",
        "export the orientations, too; for a sensor without them, give {stream}_measures positions",
        code="no_turning",
    ),
    "too_few_poses": FindingWords(
        "the {stream} stream has {poses} poses",
        "record longer",
        code="too_short",
    ),
    "too_short": FindingWords("{reason}", "record longer"),
    "not_independent": FindingWords(
        "{evidence}. Was one computed from the other (TF, fusion)? Then this result only returns "
        "the old transform",
        "give the poses that each sensor measured by itself; if both are exact (motion capture, "
        "surveyed, simulated), give parent_kind exact and child_kind exact",
        severity=Severity.WARNING,
    ),
    "noisy": FindingWords(
        "the streams rotate together, but {share:.0%} of the motion stays unexplained: noise or "
        "jumps are strong",
        "expect large standard deviations; record longer and with more motion, or repair the "
        "source",
        severity=Severity.NOTE,
    ),
    "quaternion_order": FindingWords(
        "{whose} quaternions seem to be written w x y z and read as x y z w",
        "write the quaternions as x y z w",
    ),
    "quaternion_names": FindingWords(
        "{whose} quaternions seem to be written x y z w, under names that say w x y z",
        "put the names of the columns in the order of their values",
        code="quaternion_order",
    ),
    "inverse_orientation": FindingWords(
        "{whose} orientations seem to be inverted (of the world in the sensor), while the "
        "positions are those of the sensor in its world",
        "invert the orientations alone: negate x, y and z of every quaternion",
    ),
    "left_handed": FindingWords(
        "{whose} axes are left-handed: with all positions mirrored the streams agree",
        "convert the stream to right-handed axes (REP 103)",
    ),
    "axes": FindingWords(
        "{whose} positions are in other axes than its orientations: (x, y, z) should be ({detail})",
        "write positions and orientations in the same right-handed axes; in a file, name an angle "
        "clockwise from north 'heading', and any other angle about z 'yaw'",
    ),
    "euler_order": FindingWords(
        "{whose} orientations seem to be intrinsic angles (about the turned axes, roll first) that "
        "were read as angles about fixed axes",
        "write quaternions, or roll, pitch and yaw about the fixed axes x, y and z (REP 103)",
    ),
    "motions": FindingWords(
        "the {stream} stream contains motions from pose to pose, not poses: chained, they agree "
        "with the other stream",
        "write poses in one world: the product of all motions so far",
        "odometry or scan matching that writes increments",
    ),
    "positions_turned": FindingWords(
        "{whose} positions are in other axes than its orientations, turned by {turned_deg:.0f} deg",
        "write positions and orientations in one and the same world",
    ),
    "earth_centred": FindingWords(
        "{whose} positions count from the centre of the earth (ECEF), its orientations do not: "
        "they are relative to local axes such as east, north, up",
        "write both in local axes, such as east, north, up (ENU), or both earth-centred; or give "
        "latitude, longitude and height in place of the positions",
    ),
    "ambiguous": FindingWords(
        "a second explanation fits this motion, and has another rotation: {whose} positions are in "
        "other axes, and (x, y, z) should be ({detail})",
        "compare the rotation of the result with the mount, or rotate about other axes, too (a "
        "vehicle: over slopes or kerbs)",
        severity=Severity.WARNING,
    ),
    "inverse": FindingWords(
        "the {stream} stream seems to contain inverse poses (of the world in the sensor, not of "
        "the sensor in its world)",
        "invert every pose of the {stream} stream",
    ),
    "inverse_both": FindingWords(
        "both streams seem to contain inverse poses (of the world in the sensor): inverted, their "
        "paths and the lever arm between them are shorter",
        "invert every pose of both streams, or the result is the pose of one world in the other "
        "(which is what a fixed camera beside an arm needs)",
    ),
    "inverse_unclear": FindingWords(
        "two explanations fit alike: {first}, or {second}. Neither noise nor shape of the motion "
        "decides between them",
        "give parent_invert and child_invert: the value 'none' if the poses are of the sensor in "
        "its world, the value 'poses' if they are of the world in the sensor",
        "small or short motion, or a fixed camera beside an arm",
        code="{code}",
    ),
    "inverse_small": FindingWords(
        "both streams were inverted, because noise and shape of the motion are those of inverse "
        "poses; correct poses of a fixed camera beside an arm look the same",
        "give parent_invert none and child_invert none for a fixed camera beside an arm",
        severity=Severity.WARNING,
        code="inverse_both",
    ),
    "time_offset": FindingWords(
        "the child's clock is {size} s {direction} the parent's{beyond}",
        "have the offset estimated (time_offset estimate), or set it",
    ),
    "needless_time_offset": FindingWords(
        "the child's clock is {size} s {direction} the parent's{beyond}",
        "omit the offset, because the clocks agree without it",
        code="time_offset",
    ),
    "large_time_offset": FindingWords(
        "the child's clock is {size_s:.2f} s {direction} the parent's, and no offset was given",
        "check that both streams are of one vehicle; if the clocks differ so much, give "
        "time_offset estimate",
        "a clock of another epoch (start of the computer or of the recording, GPS week) or time "
        "scale (TAI is 37 s ahead of UTC, GPS 18 s), or a sensor on a vehicle that follows",
        severity=Severity.WARNING,
        code="time_offset",
    ),
    "units": FindingWords(
        "{whose} lengths are {unit} while the {other}'s are metres (factor {scale:.5g} +/- "
        "{sigma:.2g})",
        "convert these lengths to metres; if the child has no unit, like a single camera, have the "
        "scale estimated (scale estimate)",
    ),
    "unit_or_scale": FindingWords(
        "the child's lengths must be multiplied by {scale:.5g} +/- {sigma:.2g}: the child "
        "has a scale of its own, like a single camera, or the parent's lengths are {unit}",
        "give scale estimate, or parent_scale {factor:g} if the parent's lengths are {unit}",
    ),
    "scale": FindingWords(
        "the child's lengths must be multiplied by {scale:.5g} +/- {sigma:.2g} to agree with the "
        "parent's",
        "find out which sensor has wrong lengths; have the scale estimated (scale estimate), or "
        "set it",
    ),
    "scale_contradicted": FindingWords(
        "the check multiplies the child's lengths by {scale:.5g} +/- {sigma:.2g}, the solution by "
        "{solved:.5g} +/- {solved_sigma:.2g}",
        "use a longer part of the recording; if the difference remains, the streams contradict "
        "each other: find out which of the two measures wrongly",
        "a part that is too short for a scale, or a scale that changes",
        code="scale",
    ),
    "one_axis": FindingWords(
        "{axes} cannot be determined from this motion, and will be unknown",
        "rotate about other axes, too (a vehicle: over slopes or kerbs), or measure {it} and give "
        "a prior",
        severity=Severity.NOTE,
    ),
    "one_axis_with_prior": FindingWords(
        "{axes} cannot be determined from this motion: the prior alone determines the value",
        "check the prior with a second measurement, or rotate about other axes, too",
        severity=Severity.NOTE,
        code="one_axis",
    ),
    "same_frame": FindingWords(
        "both streams are of the same frame: the extrinsic is the identity within {size}",
        "give the stream of the child sensor itself",
        "for example two topics of one odometry, or odometry of the robot's base derived from "
        "the other sensor",
    ),
    "same_position": FindingWords(
        "both streams have the same positions and other orientations: the translation between the "
        "sensors is zero ({size})",
        "give positions of the child sensor itself",
        "for example positions from the other sensor, or positions of another point of the robot "
        "than the sensor",
    ),
    "given_factor": FindingWords(
        "the parent's lengths were multiplied by {factor:g}, as given, but both streams agree in "
        "length without this factor; with it, the sensors are only {size} apart",
        "omit the factor if the parent's lengths are metres",
        code="same_position",
    ),
    "rotation_gain": FindingWords(
        "the child rotates {gain:.4f} +/- {sigma:.4f} times as far as the parent about ({axis}) in "
        "the parent sensor's frame",
        "calibrate the gyroscope or the wheel base first",
        "a gyroscope or wheel base with a wrong scale, in either stream",
    ),
    "turns": FindingWords(
        "every rotation of the child is {times:.2g} times that of the parent",
        "correct the child's orientations: a quaternion contains half the angle; angles in a file "
        "need their unit in the header, such as yaw_deg",
        "radians read as degrees, or half or twice the angles",
        code="rotation_gain",
    ),
    "maybe_late": FindingWords(
        "{whose} {part} may be {delay_s:.3f} +/- {sigma_s:.3f} s later than its {others}: the "
        "allowance contains {shift_m:.2g} m for this delay",
        "drive with more changes of speed, or use poses from one source",
        "positions from another source or filter than the orientations, or chance",
        code="position_clock",
    ),
    "late": FindingWords(
        "{whose} {part} are {delay_s:.3f} +/- {sigma_s:.3f} s later than its {others}: at this "
        "speed they are off by {shift_m:.2g} m",
        "use poses from one source, before any filter",
        "positions, or heights of a barometer, from another source or filter than the rest, or "
        "another stream of another body, such as a trailer",
        code="{code}",
    ),
    "worlds_turned": FindingWords(
        "{whose} positions are turned against its orientations by {turned_deg:.2f} deg, mainly "
        "about {axis} of its world",
        "give positions and orientations in one and the same world",
        "magnetic declination or grid convergence in one of them, or poses that were fused with "
        "those of the other sensor by a wrong transform",
    ),
    "model_scale": FindingWords(
        "the child's lengths are {size} % {than} than the parent's; this result corrects them",
        "find out which sensor has wrong lengths; if you trust neither, have the scale estimated "
        "(scale estimate)",
        "a wheel radius, a camera's baseline or a map that is stretched",
    ),
    "axis_scale": FindingWords(
        "{whose} {axis} coordinates are {factor:.4f} +/- {sigma:.4f} times as long as its other "
        "coordinates",
        "write all coordinates in metres, from one source; check that latitude and longitude are "
        "not exchanged",
        "heights in feet, of a barometer or constant (2D), or map coordinates whose scale depends "
        "on the latitude",
    ),
    "smoothed": FindingWords(
        "{whose} {part} are smoothed over about {smoothing_s:.2f} s, the other's are not: this "
        "displaces poses by about {shift_m:.2g} m, and the translation by as much or more",
        "use the poses before the smoothing filter",
        "a low-pass or smoothing filter",
        code="smoothed_{part}",
    ),
    "world_drift": FindingWords(
        "the child's world rotates by {deg_per_minute:.2g} deg and moves by {m_per_minute:.2g} m a "
        "minute against the parent's, which is {percent:.2g} % of the sensor's speed",
        "use the poses in the frame of the odometry, before any correction by a map",
        "a map that is corrected bit by bit, a heading that drifts, or poses published in a frame "
        "that moves",
        severity=Severity.WARNING,
    ),
    "exchanged": FindingWords(
        "the streams are exchanged about {at_s:.0f} s after the start: each has the motion of the "
        "other sensor from there on",
        "find out where their names or topics were mixed up, or calibrate each part on its own, "
        "with end {at_s:.0f} and with start {at_s:.0f}",
        "topics that were remapped, or files whose names were mixed up",
    ),
    "parts_turned": FindingWords(
        "two parts of the recording are consistent, but their extrinsic rotations differ by {size}",
        "calibrate each part on its own, with end {at_s:.0f} and with start {at_s:.0f}",
        "a source that started anew with other axes",
        code="mount_moved",
    ),
    "mount_moved": FindingWords(
        "the extrinsic changes {at_s:.0f} s after the start by {size}",
        "tighten the mount and record again, or calibrate each part on its own, with end "
        "{at_s:.0f} and with start {at_s:.0f}",
        "a mount that came loose or was knocked, or an estimator that started anew",
    ),
}
