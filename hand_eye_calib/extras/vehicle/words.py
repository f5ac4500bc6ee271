"""Sentences of the findings about vehicles."""

from hand_eye_calib.core.checks.words import UNRELATED_ADVICE, FindingWords
from hand_eye_calib.core.results.records import Severity

WORDS = {
    "one_motion": FindingWords(
        "this drive does not determine {axes}: the vehicle drives straight on, always the same "
        "curve, turns only once, or turns on the spot",
        "drive figures of eight for some minutes, with tight curves to both sides",
    ),
    "unrelated_wheels": FindingWords(
        "the motion of the wheels, or of any vehicle, is not that of the sensor",
        UNRELATED_ADVICE,
        "another recording, a wheel that turns backwards, or a machine that moves sideways or that "
        "bends in its middle (articulated loaders have no model)",
        code="unrelated",
    ),
    "upside_down": FindingWords(
        "by its wheels, the vehicle turns left when an upright sensor turns right",
        "exchange the columns of the left and the right wheel, or change the sign of the steering "
        "angle or of the speed; if the sensor really is upside down, confirm it: "
        "prior.roll {roll}deg+/-10deg",
        "a steered wheel behind the axle, or z of the sensor that points down",
        severity=Severity.WARNING,
    ),
    "speed_of_tricycle": FindingWords(
        "the speed seems to be that of the steered wheel",
        "set parent_measures to tricycle",
        "a tyre that is much smaller under load in curves",
        severity=Severity.ERROR,
    ),
    "speed_of_steering": FindingWords(
        "the speed seems to be that of the fixed axle",
        "set parent_measures to steering",
        "a driver that already divides the speed by the cosine of the angle",
        severity=Severity.ERROR,
    ),
    "unusual_radius": FindingWords(
        "a wheel radius of {radius:.4f} m is unusual",
        "give the speeds of the wheels in rad/s or m/s, or name the columns with their unit "
        "(left_rpm); if the radius is right, confirm it: nominal_radius {radius:.4f}",
        "speeds in rpm, degrees or ticks, or lengths of the sensor that are not metres",
        severity=Severity.WARNING,
    ),
    "radius_not_nominal": FindingWords(
        "the wheel radius is {radius:.4f} m, {ratio:.3g} times the nominal {nominal:.4f} m",
        "correct nominal_radius; or give the speeds of the wheels in rad/s or m/s, or name the "
        "columns with their unit (left_rpm)",
        "{cause}",
        severity=Severity.WARNING,
    ),
    "unusual_multiplier": FindingWords(
        "the odometry of the wheels is {ratio:.3g} times too short",
        "give speeds in m/s, and poses in m; correct the radius in the configuration of the "
        "odometry, and record again",
        "{cause}",
        severity=Severity.WARNING,
    ),
    "vehicle_halves": FindingWords(
        "the two halves of the drive give different values of {axes}",
        "check that the sensor is fixed, and the pressure of the tyres; record again",
        "a mount that moved, or a load that changed",
        severity=Severity.WARNING,
    ),
}
