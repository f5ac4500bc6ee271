"""Findings: what the stream checks tell a person, and the wording of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hand_eye_calib.methods import METHODS
from hand_eye_calib.text import angle, length, listing

if TYPE_CHECKING:
    from hand_eye_calib.alignment.angular_rates import Correlation
    from hand_eye_calib.alignment.scale import Scale
    from hand_eye_calib.alignment.time_offset import TimeOffset
    from hand_eye_calib.arrays import FloatArray
    from hand_eye_calib.assessment.mount_change import MountChange
    from hand_eye_calib.checks.response import Quantity
    from hand_eye_calib.config import CalibratorConfig
    from hand_eye_calib.gls.part_delays import PartDelay
    from hand_eye_calib.gls.world_drift import WorldDrift
    from hand_eye_calib.pairing.leaps import Leap


class Severity(str, Enum):
    """How much a finding matters.

    With an error, a result from these streams as they are is unusable. With a warning it may be
    used with care. A note is good to know.
    """

    NOTE = "note"
    WARNING = "warning"
    ERROR = "error"


class Confidence(str, Enum):
    """How sure a finding is."""

    CERTAIN = "certain"
    LIKELY = "likely"
    POSSIBLE = "possible"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something about the streams that a person should know.

    Attributes
    ----------
    code : str
        Short name, stable over versions.
    stream : str
        "parent", "child" or "both".
    severity : Severity
    confidence : Confidence
    what : str
        What was found, with its values.
    advice : str
        What to do.
    cause : str
        Usual cause, if ``what`` does not name it.
    evidence : tuple of (str, float)
        Measured values by name, in SI units, each name with its unit.
    options : tuple of (str, value)
        Options that do it, by their names in :mod:`hand_eye_calib.config`; empty if none can.
    """

    code: str
    stream: str
    severity: Severity
    confidence: Confidence
    what: str
    advice: str
    cause: str = ""
    evidence: tuple[tuple[str, float], ...] = ()
    options: tuple[tuple[str, Any], ...] = ()

    @property
    def makes_unusable(self) -> bool:
        """Whether a result from these streams as they are is unusable."""
        return self.severity is Severity.ERROR

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values."""
        return {
            "code": self.code,
            "stream": self.stream,
            "severity": self.severity.value,
            "confidence": self.confidence.value,
            "what": self.what,
            "advice": self.advice,
            "cause": self.cause,
            "evidence": dict(self.evidence),
            "options": dict(self.options),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Build from the mapping that :meth:`to_dict` gave."""
        return cls(
            code=data["code"],
            stream=data["stream"],
            severity=Severity(data["severity"]),
            confidence=Confidence(data["confidence"]),
            what=data["what"],
            advice=data["advice"],
            cause=data["cause"],
            evidence=tuple(data["evidence"].items()),
            options=tuple(data["options"].items()),
        )

    def __str__(self) -> str:
        cause = f" ({self.cause})" if self.cause else ""
        return f"{self.what.rstrip('.')}{cause}; {self.advice}"


# Jumps up to this share hardly matter to the methods that leave them out.
_FEW_JUMPS = 0.02


def answered(findings: Sequence[Finding], config: CalibratorConfig) -> list[Finding]:
    """The same findings; those that the options answer already are notes, and so are a few jumps if
    the method leaves outliers out.
    """
    given = config.to_options()
    rejects_outliers = METHODS[config.method].rejects_outliers

    def is_answered(finding: Finding) -> bool:
        few = finding.code == "jumps" and dict(finding.evidence)["share"] < _FEW_JUMPS
        if few and rejects_outliers:
            return True
        set_so = [given.get(name) == value for name, value in finding.options]
        return bool(set_so) and all(set_so)

    return [
        replace(finding, severity=Severity.NOTE) if is_answered(finding) else finding
        for finding in findings
    ]


def gravest_first(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """The findings by severity, errors first, otherwise in their order."""
    order = list(Severity)
    return tuple(sorted(findings, key=lambda finding: -order.index(finding.severity)))


# ------------------------------------------------------------- of one stream


def _note(code: str, stream: str, what: str, advice: str) -> Finding:
    return Finding(
        code=code,
        stream=stream,
        severity=Severity.NOTE,
        confidence=Confidence.CERTAIN,
        what=what,
        advice=advice,
    )


def _error(
    code: str,
    stream: str,
    what: str,
    advice: str,
    confidence: Confidence = Confidence.CERTAIN,
    cause: str = "",
    evidence: tuple[tuple[str, float], ...] = (),
) -> Finding:
    return Finding(
        code=code,
        stream=stream,
        severity=Severity.ERROR,
        confidence=confidence,
        what=what,
        advice=advice,
        cause=cause,
        evidence=evidence,
    )


def duplicates(stream: str, n_repeated: int, n_poses: int) -> Finding:
    """Poses repeat a stamp."""
    return _note(
        "duplicates",
        stream,
        f"{n_repeated} of {n_poses} {stream} poses repeat a stamp",
        "the first of each is used",
    )


def disorder(stream: str, n_backwards: int) -> Finding:
    """Stamps go back."""
    return _note(
        "disorder",
        stream,
        f"{n_backwards} {stream} stamps are earlier than the one before",
        "poses are sorted by stamp",
    )


def repaired_file(what: str) -> Finding:
    """A file had to be repaired while it was read."""
    return _note("disorder", "both", what, "repair the file's source")


def too_few_poses(stream: str, n_poses: int) -> Finding:
    """A stream is too short to check."""
    return _error(
        "too_short",
        stream,
        f"the {stream} stream has {n_poses} poses",
        "record longer, or check the topic",
    )


def leaping_stamps(stream: str, leap: Leap) -> Finding:
    """Stamps lie days apart."""
    return _error("leap", stream, f"the {stream} stream's {leap.what()}", leap.advice())


def gaps(stream: str, n_gaps: int, longest_s: float, share: float) -> Finding:
    """Poses are missing for a while."""
    return _note(
        "gaps",
        stream,
        f"the {stream} stream has {n_gaps} gaps of up to {longest_s:.2f} s ({share:.0%} of the "
        "time)",
        "nothing is paired across a gap; raise max_gap if the motion there is smooth",
    )


def jumps(stream: str, share: float) -> Finding:
    """Poses jump."""
    return Finding(
        code="jumps",
        stream=stream,
        severity=Severity.WARNING,
        confidence=Confidence.LIKELY,
        what=f"{share:.1%} of the {stream} stream's steps are jumps: far from the motion before "
        "and after",
        cause="relocalisations, loop closures or wrong detections",
        advice="keep a method that leaves them out; better, repair the source",
        evidence=(("share", share),),
        options=(("method", "dnlo"),),
    )


def frozen(stream: str, share: float) -> Finding:
    """A stream repeats its pose while the other sensor moves."""
    return _error(
        "frozen",
        stream,
        f"the {stream} stream repeats the same pose for {share:.0%} of the time while the other "
        "sensor moves",
        "find out why its source stopped, and cut that part out",
    )


def repeated(stream: str, times: int) -> Finding:
    """Positions are repeated as if they were new."""
    return _error(
        "repeated",
        stream,
        f"the {stream} stream has each position {times} times in a row under new stamps: its "
        "source is slower than the stream",
        "keep the first of each, with the stamp of its measurement",
    )


def stamp_unit(stream: str, other: str, unit: str, factor: float) -> Finding:
    """Stamps are in another unit than nanoseconds."""
    return _error(
        "stamp_unit",
        stream,
        f"the {stream} stream's stamps are {unit} instead of nanoseconds: they are {factor:g} "
        f"times nearer to 1970 than the {other}'s",
        f"multiply the {stream} stream's stamps by {factor:g}",
    )


# ---------------------------------------------------------- of both together


def unrelated_rates(correlation: Correlation, quantity: str = "angular rates") -> Finding:
    """The angular rates, or speeds, do not agree at any clock offset."""
    return _error(
        "unrelated",
        "both",
        f"the {quantity} of the two streams do not agree at any clock offset: "
        f"{correlation.doubt().replace('angular rates', quantity)}",
        "check that both sensors are on one rigid body, that the topics are of the same recording, "
        "and that neither is derived from another body",
        Confidence.LIKELY,
    )


def no_rotation() -> Finding:
    """The streams do not rotate enough to check anything."""
    return _error(
        "no_turning",
        "both",
        "the streams hardly rotate, or at a constant rate, so that neither clock nor extrinsic can "
        "be checked",
        "rotate about several axes (a vehicle: curves, and slopes if there are any)",
        Confidence.LIKELY,
    )


def too_short_to_compare(what: str) -> Finding:
    """The streams have too few motions in common."""
    return _error("too_short", "both", what, "record longer")


def not_one_body(unexplained: float, limit: float) -> Finding:
    """No hypothesis explains both streams."""
    return _error(
        "unrelated",
        "both",
        "no extrinsic, scale or usual mistake explains both streams: "
        f"{min(unexplained, 1):.0%} of the motion stays unexplained (at most {limit:.0%} would be "
        "good)",
        "check that both sensors are on one rigid body and that the poses are those of the sensors",
        Confidence.LIKELY,
    )


def unrelated_parts(unexplained: float, what: str, other: str, unit_of: str) -> Finding:
    """The parts that two streams measure are not of one body: ``what`` of one does not follow from
    ``other``; ``unit_of`` is what may have a wrong unit.
    """
    return _error(
        "unrelated",
        "both",
        f"{min(unexplained, 1.0):.0%} of the {what} is not that of the {other}",
        f"check that both are on one rigid body, {unit_of}, and the clocks (time_offset estimate)",
        Confidence.LIKELY,
    )


def swapped_coordinates(
    stream: str, factors: FloatArray, unexplained: float, unexplained_mended: float
) -> Finding:
    """Latitude and longitude are swapped: x and y need these factors (2,)."""
    lat = float(np.degrees(np.arccos(min(factors[1], 1.0))))
    lon = float(np.degrees(np.arccos(min(1.0 / factors[0], 1.0))))
    return _error(
        "swapped_coordinates",
        stream,
        f"latitude and longitude of the {stream} seem to be swapped: its distances along x (east) "
        f"must be multiplied by {factors[0]:.3g} and along y (north) by {factors[1]:.3g}, as if "
        f"the true latitude were {lat:.0f} deg and the true longitude {lon:.0f} deg, north or "
        f"south, east or west; then {unexplained_mended:.1%} of the motion stays unexplained "
        f"instead of {unexplained:.0%}",
        "swap latitude and longitude at their source, or the names of the columns",
        Confidence.LIKELY,
        evidence=_of_factors(factors, unexplained, unexplained_mended),
    )


def mirrored_positions(stream: str, unexplained: float, unexplained_mended: float) -> Finding:
    """Positions alone are mirrored."""
    return replace(
        left_handed(stream),
        what=f"the {stream}'s positions are mirrored: with x and y swapped "
        f"{unexplained_mended:.1%} of the motion stays unexplained instead of {unexplained:.0%}",
        cause="east and north (or latitude and longitude near the equator) swapped, or z downwards",
        evidence=(
            ("unexplained_share", unexplained),
            ("unexplained_share_mended", unexplained_mended),
        ),
    )


def longitude_scale(
    stream: str, factors: FloatArray, unexplained: float, unexplained_mended: float
) -> Finding:
    """Degrees of longitude were made metres as if they were as long as those of latitude."""
    return _error(
        "longitude_scale",
        stream,
        f"the {stream}'s distances along x (east) must be multiplied by {factors[0]:.3g}, those "
        f"along y (north) are right; then {unexplained_mended:.1%} of the motion stays "
        f"unexplained instead of {unexplained:.0%}",
        "multiply x by the cosine of the latitude, or give latitude and longitude themselves",
        Confidence.LIKELY,
        cause="longitudes that became metres without the cosine of the latitude",
        evidence=_of_factors(factors, unexplained, unexplained_mended),
    )


def _of_factors(
    factors: FloatArray, unexplained: float, unexplained_mended: float
) -> tuple[tuple[str, float], ...]:
    return (
        ("factor_x", float(factors[0])),
        ("factor_y", float(factors[1])),
        ("unexplained_share", unexplained),
        ("unexplained_share_mended", unexplained_mended),
    )


def rate_unit(stream: str, ratio: float) -> Finding:
    """Angular rates are in degrees and read as radians, or the other way round."""
    units = ("deg/s", "rad/s") if ratio > 1.0 else ("rad/s", "deg/s")
    return _error(
        "rate_unit",
        stream,
        f"the {stream} rotates {ratio:.3g} times as far as the other sensor: its rates are "
        f"{units[0]} and were read as {units[1]}",
        "name the unit in the header, such as wx_deg_s or wx_rad_s; a message has rad/s",
        Confidence.LIKELY,
        evidence=(("ratio", ratio),),
    )


def unsolved(what: str) -> Finding:
    """Nothing can be solved with the streams."""
    return _error(
        "unrelated",
        "both",
        what,
        "check that both are on one rigid body, the units, and the clocks (time_offset estimate)",
        Confidence.POSSIBLE,
    )


def noisy(unexplained: float) -> Finding:
    """The angular rates agree and the motion does not."""
    return Finding(
        code="noisy",
        stream="both",
        severity=Severity.NOTE,
        confidence=Confidence.LIKELY,
        what=f"the streams rotate together, but {unexplained:.0%} of the motion stays unexplained: "
        "noise or jumps are strong",
        advice="expect large standard deviations; record longer and with more motion, or repair "
        "the source",
    )


def _whose(stream: str) -> str:
    return "both streams'" if stream == "both" else f"the {stream} stream's"


def quaternion_order(stream: str) -> Finding:
    """Quaternions are scalar first."""
    return _error(
        "quaternion_order",
        stream,
        f"{_whose(stream)} quaternions seem to be written w x y z and read as x y z w",
        "write them as x y z w",
        Confidence.LIKELY,
    )


def inverse_orientation(stream: str) -> Finding:
    """Orientations are inverted, positions are not."""
    return _error(
        "inverse_orientation",
        stream,
        f"{_whose(stream)} orientations seem to be inverted (of the world in the sensor), while "
        "the positions are those of the sensor in its world",
        "invert the orientations alone: negate x, y and z of every quaternion",
        Confidence.LIKELY,
    )


def left_handed(stream: str) -> Finding:
    """Positions are mirrored."""
    return _error(
        "left_handed",
        stream,
        f"the {stream} stream's axes are left-handed: with all positions mirrored the streams "
        "agree",
        "convert the stream to right-handed axes (REP 103)",
        Confidence.LIKELY,
    )


def axes(stream: str, order: str) -> Finding:
    """Positions are in other axes than orientations; ``order`` is what (x, y, z) should be."""
    return _error(
        "axes",
        stream,
        f"the {stream} stream's positions are in other axes than its orientations: (x, y, z) "
        f"should be ({order})",
        "write positions and orientations in the same right-handed axes",
        Confidence.LIKELY,
    )


def inverse(stream: str, confidence: Confidence) -> Finding:
    """Poses are inverted."""
    return _error(
        "inverse",
        stream,
        f"the {stream} stream seems to hold inverse poses (of the world in the sensor, not of the "
        "sensor in its world)",
        f"invert every pose of the {stream} stream",
        confidence,
    )


def inverse_both(confidence: Confidence) -> Finding:
    """Poses of both streams are inverted: a warning if that is only possible."""
    found = _error(
        "inverse_both",
        "both",
        "both streams seem to hold inverse poses (of the world in the sensor): inverted, their "
        "paths and the lever arm between them are shorter",
        "invert every pose of both streams, or the result is the pose of one world in the other "
        "(which is what a fixed camera beside an arm needs)",
        confidence,
    )
    return replace(found, severity=Severity.WARNING) if confidence is Confidence.POSSIBLE else found


def time_offset(found: TimeOffset, total_s: float, severity: Severity) -> Finding:
    """The clocks differ; ``total_s`` is the offset to set."""
    direction = "behind" if found.seconds > 0 else "ahead of"
    return Finding(
        code="time_offset",
        stream="child",
        severity=severity,
        confidence=Confidence.CERTAIN,
        what=f"the child's clock is {abs(found.seconds):.4f} +/- {found.sigma_s:.4f} s {direction} "
        "the parent's",
        advice=f"add {total_s} s to the child's stamps, or have it estimated",
        evidence=(("offset_s", found.seconds), ("sigma_s", found.sigma_s)),
        options=(("time_offset", total_s),),
    )


def units(scale: float, sigma: float, unit: str, factor: float) -> Finding:
    """The child's lengths are in another unit, by the scale that was found."""
    found = _error(
        "units",
        "child",
        f"the child's lengths are {unit} while the parent's are metres (factor "
        f"{scale:.5g} +/- {sigma:.2g})",
        "convert them to metres",
        evidence=(("scale", scale), ("sigma", sigma)),
    )
    return replace(found, options=(("scale", factor),))


def scale_differs(scale: Scale, factor: float, severity: Severity) -> Finding:
    """The child's lengths are off by a factor."""
    return Finding(
        code="scale",
        stream="child",
        severity=severity,
        confidence=Confidence.CERTAIN,
        what=f"the child's lengths must be multiplied by {scale.value:.4f} +/- {scale.sigma:.4f} "
        "to agree with the parent's",
        advice="have the scale estimated, or find out which of the two measures wrongly",
        evidence=(("scale", scale.value), ("sigma", scale.sigma)),
        options=(("scale", factor),),
    )


def one_axis(direction: FloatArray, hidden: Sequence[str], main: str) -> Finding:
    """Nearly all rotation is about one axis, which hides the translation along it."""
    axis = ", ".join(f"{component:.2f}" for component in direction)
    return Finding(
        code="one_axis",
        stream="both",
        severity=Severity.NOTE,
        confidence=Confidence.LIKELY,
        what=f"nearly all rotation is about one axis, ({axis}) in the parent sensor's frame: the "
        f"translation along it, {' and '.join(hidden)}, will be unobservable",
        advice=f"rotate about other axes, too (a vehicle: over slopes or kerbs), or measure {main} "
        "and give it",
        options=((f"prior.{main}", "VALUE+/-SIGMA"),),
    )


def unseen_axes(axes: Sequence[str]) -> Finding:
    """The motion does not show these axes, of those that the streams can show."""
    return Finding(
        code="one_axis",
        stream="both",
        severity=Severity.NOTE,
        confidence=Confidence.LIKELY,
        what=f"this motion does not show {listing(tuple(axes))}, which will be unobservable",
        advice="rotate about other axes, too (a vehicle: over slopes or kerbs), or measure "
        f"{'it' if len(axes) == 1 else 'them'} and give a prior",
        options=tuple((f"prior.{axis}", "VALUE+/-SIGMA") for axis in axes),
    )


def same_frame(distance_m: float, angle_rad: float, severity: Severity) -> Finding:
    """The extrinsic is the identity."""
    return Finding(
        code="same_frame",
        stream="both",
        severity=severity,
        confidence=Confidence.LIKELY,
        what="both streams are of one and the same frame: the extrinsic is the identity, to "
        f"{length(distance_m)} and {angle(angle_rad)}",
        cause="such as two topics of one odometry, or odometry of the robot's base that was "
        "derived from the other sensor",
        advice="give the stream of the child sensor itself",
        evidence=(("translation_m", distance_m), ("rotation_rad", angle_rad)),
    )


def same_position(distance_m: float, sigma_m: float, severity: Severity) -> Finding:
    """The translation is zero."""
    return Finding(
        code="same_position",
        stream="both",
        severity=severity,
        confidence=Confidence.LIKELY,
        what="both streams have the same positions and other orientations: the translation "
        f"between the sensors is zero ({length(distance_m)} +/- {length(sigma_m)})",
        cause="such as positions that were fused from the other sensor, or given for another "
        "point of the robot than the sensor",
        advice="give positions of the child sensor itself",
        evidence=(("translation_m", distance_m), ("sigma_m", sigma_m)),
    )


def interleaved(stream: str, ratio: float, distance_m: float) -> Finding:
    """Poses of two sensors take turns."""
    return _error(
        "interleaved",
        stream,
        f"the {stream} stream's poses alternate between two levels {distance_m:.2g} m apart",
        "give each its own topic, and calibrate one",
        Confidence.LIKELY,
        cause="two sensors, or two programs, publish on one topic",
        evidence=(("roughness_ratio", ratio), ("distance_m", distance_m)),
    )


def coarse_positions(stream: str, step_m: float, is_float32: bool, severity: Severity) -> Finding:
    """Positions lie on a grid."""
    far = "numbers of 32 bits far from the origin, such as map coordinates"
    cause = far if is_float32 else "they were rounded"
    return Finding(
        code="coarse_positions",
        stream=stream,
        severity=severity,
        confidence=Confidence.CERTAIN,
        what=f"the {stream} stream's positions are multiples of {step_m:.3g} m",
        cause=cause,
        advice="write positions with 64 bits and all digits, or relative to a near origin",
        evidence=(("step_m", step_m),),
    )


def flat(stream: str, other: str, tilt_rad: float) -> Finding:
    """A stream has x, y and yaw only while the other one tilts."""
    return _error(
        "flat",
        stream,
        f"the {stream} stream has only x, y and yaw, while the {other} tilts by "
        f"{np.degrees(tilt_rad):.1f} deg (root mean square)",
        "give poses with all six degrees of freedom, or record on level ground and measure "
        "height, roll and pitch by hand",
        cause="odometry in 2D, such as that of wheels",
        evidence=(("tilt_rad", tilt_rad),),
    )


def rotation_gain(gain: Quantity, axis: FloatArray, severity: Severity) -> Finding:
    """Rotation angles differ by a factor."""
    direction = ", ".join(f"{component:.2f}" for component in axis)
    return Finding(
        code="rotation_gain",
        stream="child",
        severity=severity,
        confidence=Confidence.LIKELY,
        what=f"the child rotates {gain.value:.4f} +/- {gain.sigma:.4f} times as far as the parent "
        f"about ({direction}) in the parent sensor's frame",
        cause="a gyroscope or wheel base with a wrong scale, in either stream",
        advice="calibrate that scale first",
        evidence=(("gain", gain.value), ("sigma", gain.sigma)),
    )


def position_clock(stream: str, delay: PartDelay, shift_m: float, severity: Severity) -> Finding:
    """Positions and orientations of a stream have different delays."""
    late = "late" if delay.seconds > 0 else "early"
    return Finding(
        code="position_clock",
        stream=stream,
        severity=severity,
        confidence=Confidence.LIKELY,
        what=f"the {stream}'s positions are {abs(delay.seconds):.3f} +/- {delay.sigma_s:.3f} s "
        f"{late} against its orientations: at this speed a shift of {shift_m:.2g} m",
        cause="positions and orientations of one stream come from different sources or filters",
        advice="use the poses before that filter, or correct the delay of the positions",
        evidence=(("delay_s", delay.seconds), ("sigma_s", delay.sigma_s), ("shift_m", shift_m)),
    )


def smoothed(
    part: str, stream: str, smoothing: Quantity, severity: Severity, shift_m: float
) -> Finding:
    """Positions or orientations of one stream are smoother than those of the other."""
    seconds = float(np.sqrt(max(smoothing.value, 0.0)))
    return Finding(
        code=f"smoothed_{part}",
        stream=stream,
        severity=severity,
        confidence=Confidence.LIKELY,
        what=f"the {stream} stream's {part} are smoothed over about {seconds:.2f} s, which the "
        f"other's are not: the translation may be off by {shift_m:.2g} m",
        cause="a low-pass or smoothing filter",
        advice="use the poses before that filter",
        evidence=(
            ("smoothing_s", seconds),
            ("sigmas", smoothing.value / max(smoothing.sigma, 1e-12)),
            ("shift_m", shift_m),
        ),
    )


def world_drift(drift: WorldDrift, share: float) -> Finding:
    """One world moves against the other, at this share of the sensor's speed."""
    speed = float(np.linalg.norm(drift.twist[:3]))
    rate = float(np.linalg.norm(drift.twist[3:]))
    return Finding(
        code="world_drift",
        stream="both",
        severity=Severity.WARNING,
        confidence=Confidence.LIKELY,
        what=f"the child's world turns by {np.degrees(60 * rate):.2g} deg and moves by "
        f"{60 * speed:.2g} m a minute against the parent's: at {100 * share:.2g} % of the "
        "sensor's speed",
        cause="a map that is corrected bit by bit, a heading that drifts, or poses published in a "
        "frame that moves",
        advice="use the poses before that correction, in the frame of the odometry",
        evidence=(
            ("evidence", drift.evidence),
            ("rate_rad_s", rate),
            ("speed_m_s", speed),
            ("share_of_speed", share),
        ),
    )


def unit_unseen() -> Finding:
    """One sensor hardly moves, so that no motion shows the ratio of the units of length."""
    return Finding(
        code="unit_unseen",
        stream="both",
        severity=Severity.WARNING,
        confidence=Confidence.LIKELY,
        what="the body rotates about one of the sensors, and nothing shows whether both streams "
        "have one unit of length: the translation is as long as the other sensor's stream has it",
        cause="a pan-tilt unit, or a robot that rotates on the spot",
        advice="nothing, if both measure in metres; otherwise move the body as well",
    )


def mount_moved(
    change: MountChange,
    at_s: float,
    span_s: float,
    moved: tuple[float, float],
    severity: Severity,
) -> Finding:
    """The mount has moved within the recording, ``at_s`` seconds after its start, by so much (m,
    rad); or something drifts.
    """
    distance_m, angle_rad = moved
    sizes = [length(distance_m)] if distance_m else []
    sizes += [angle(angle_rad)] if angle_rad else []
    when = f"changes {at_s:.0f} s after the start (within {span_s:.0f} s)"
    cause = "a mount that came loose or was knocked, or an estimator that started anew"
    if not change.is_step:
        when = "seems to change in the course of the recording"
        cause = "a mount that gives way, or a sensor whose errors wander over minutes"
    return Finding(
        code="mount_moved",
        stream="both",
        severity=severity,
        confidence=Confidence.LIKELY if change.is_step else Confidence.POSSIBLE,
        what=f"the extrinsic {when} by {listing(sizes)}",
        cause=cause,
        advice="tighten it and record again, or calibrate the parts before and after on their own",
        evidence=(
            ("at_s", at_s),
            ("at_ns", float(change.at_ns)),
            ("translation_m", distance_m),
            ("rotation_rad", angle_rad),
            ("log_likelihood_ratio", change.log_ratio),
        ),
    )
