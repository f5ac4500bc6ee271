"""Sentences of the findings about streams of positions, rotations or angular rates."""

from hand_eye_calib.core.checks.words import UNRELATED_ADVICE, FindingWords
from hand_eye_calib.core.results.records import Severity

WORDS = {
    "unrelated_positions": FindingWords(
        "{share:.0%} of the motion of the positions is not that of the odometry",
        UNRELATED_ADVICE,
        code="unrelated",
    ),
    "unrelated_rotations": FindingWords(
        "{share:.0%} of the rotation of one sensor is not that of the other",
        UNRELATED_ADVICE,
        code="unrelated",
    ),
    "rate_unit": FindingWords(
        "the {stream} rotates {ratio:.3g} times as far as the other sensor: its rates are {unit} "
        "and were read as {read_as}",
        "name the unit in the header, such as wx_deg_s or wx_rad_s; a message has rad/s",
    ),
    "no_lever_arm": FindingWords(
        "the positions are those of the other sensor: the lever arm is zero ({size})",
        "give the positions of the antenna or prism itself; if it is at the origin of the other "
        "sensor, give priors, such as prior.x 0+/-0.01",
        "such as positions of a fused pose, or of the other topic of one receiver",
        code="same_position",
    ),
    "parallel_axes": FindingWords(
        "the rotation between the sensors is zero ({size}): both streams seem to be of one sensor",
        "give the rates of the child sensor itself; if the axes are parallel, say so by priors, "
        "such as prior.yaw 0+/-1deg",
        "such as the rates of the parent's own gyroscope",
        code="same_frame",
    ),
    "unchecked": FindingWords(
        "{whose} positions are too few to detect delays and smoothing",
        "record longer, or at a higher rate",
        severity=Severity.WARNING,
    ),
    "mirrored_positions": FindingWords(
        "{whose} positions are in left-handed axes",
        "correct the sign of one coordinate, or the order of two (REP 103: x east, y north, z up)",
        code="left_handed",
    ),
    "mirrored_rates": FindingWords(
        "{whose} rates are about left-handed axes",
        "correct the sign of one axis, or the order of two",
        code="left_handed",
    ),
    "misaligned": FindingWords(
        "the {axes} axes of {whose} rates are not perpendicular, by {degrees:.2f} deg",
        "calibrate the axes of the gyroscope first",
        "a misaligned axis of a gyroscope",
    ),
    "gain_of_axis": FindingWords(
        "{whose} rotations about its {axis} axis are {gain:.4f} +/- {sigma:.4f} times the true "
        "ones",
        "calibrate the scale of this axis of the gyroscope first",
        "a gyroscope with a wrong scale",
        code="rotation_gain",
    ),
    "smoothed_rotations": FindingWords(
        "{whose} {part} are smoothed over about {smoothing_s:.2f} s, the other's are not",
        "use the {part} before the smoothing filter",
        "a low-pass or smoothing filter",
        severity=Severity.WARNING,
        code="smoothed_{part}",
    ),
    "coarse_rates": FindingWords(
        "{whose} rates are multiples of {step_rad_s:.3g} rad/s",
        "write rates with all digits",
        "rounding in a file",
        severity=Severity.WARNING,
    ),
    "clipped_rates": FindingWords(
        "{whose} rates about {axis} are clipped at {limit_deg_s:.0f} deg/s ({share:.1%} of the "
        "time)",
        "set a larger range of the gyroscope, or turn more slowly",
        severity=Severity.WARNING,
    ),
    "bias_drift": FindingWords(
        "the bias of {whose} rates drifts by about {deg_s:.2f} deg/s",
        "let the gyroscope warm up, or use a better one",
        severity=Severity.WARNING,
    ),
    "coarse_orientations": FindingWords(
        "{whose} orientations are in steps of {step_deg:.2g} deg",
        "write orientations with all digits",
        "rounding in a file",
        severity=Severity.WARNING,
    ),
    "inverse_rotations": FindingWords(
        "the orientations of {name} are inverted, or their quaternions are in the order w x y z",
        "correct the stream by an option (such as child_invert orientations, or child_quaternion "
        "wxyz)",
        code="inverse_orientation",
    ),
    "unchecked_rotations": FindingWords(
        "{whose} rotations are too few to detect misaligned axes, gains and smoothing",
        "record longer, or at a higher rate",
        severity=Severity.WARNING,
        code="unchecked",
    ),
}
