"""Sentences of the findings about rigs."""

from hand_eye_calib.core.checks.words import FindingWords
from hand_eye_calib.core.results.records import Severity

WORDS = {
    "not_closed": FindingWords(
        "the three pairwise results of {first}, {second} and {third} do not close: around the loop "
        "they leave {distance_mm:.1f} mm and {rotation_deg:.2f} deg, more than their uncertainty "
        "allows",
        "tighten the mounts of these sensors and record again; compare their scales",
        "a sensor that moved on its mount, or a scale that changed during the recording",
        severity=Severity.WARNING,
    ),
    "copied_in_rig": FindingWords(
        "{first} and {second}: {evidence}. Was one computed from the other (TF, fusion, a copy of "
        "the file)? Then the rig has a sensor less",
        "give the poses that both sensors measured by themselves, or omit {first} or {second}; if "
        "they are exact (motion capture, surveyed, simulated), give child_kind exact, and "
        "parent_kind exact if the first sensor is, too",
        severity=Severity.WARNING,
        code="not_independent",
    ),
}
