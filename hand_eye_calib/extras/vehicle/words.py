"""Sentences of the findings about vehicles."""

from hand_eye_calib.core.checks.words import UNRELATED_ADVICE, FindingWords
from hand_eye_calib.core.results.records import Severity

WORDS = {
    "one_motion": FindingWords(
        "this drive does not determine {axes}: the vehicle drives straight on, or always the same "
        "curve",
        "drive figures of eight for some minutes, with tight curves to both sides",
    ),
    "unrelated_wheels": FindingWords(
        "the motion of the wheels, or of any vehicle, is not that of the sensor",
        UNRELATED_ADVICE,
        "another recording, a wheel that turns backwards, or a machine that moves sideways",
        code="unrelated",
    ),
    "vehicle_halves": FindingWords(
        "both halves of the drive give another {axes}",
        "check that the sensor is fixed, and the pressure of the tyres; record again",
        "a mount that moved, or a load that changed",
        severity=Severity.WARNING,
    ),
}
