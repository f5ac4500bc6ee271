"""Attempts: snapshots that are solved with some options, checked, and compared."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from hand_eye_calib.core.base.config import defaults_of
from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import Finding, Severity, gravest_first
from hand_eye_calib.core.engine.kinds import kind_of
from hand_eye_calib.core.engine.snapshot import STREAMS, Snapshot
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration

#: Options that correct a stream before it is paired.
STREAM_REPAIRS = (
    "parent_scale",
    *(
        f"{stream}_{option}"
        for stream in STREAMS
        for option in ("invert", "quaternion")
    ),
)

# A noise model fits if its misfit (weighted squared residual per degree of freedom) is at most
# this. The misfit is 1 for the right model, and smaller without noise.
_MAX_MISFIT = 2.0

# A result is examined again if open faults increase a sigma by more than this factor.
_MUCH_WIDER = 1.05


class OptionMessage(NamedTuple):
    """Message about options that were set automatically.

    Attributes
    ----------
    text : str
        Message with the estimates of the result.
    lasting : str
        Message without estimates and verdict, for a live session: later results with the same
        options have other estimates.
    """

    text: str
    lasting: str


@dataclass(frozen=True)
class Attempt:
    """Result of a snapshot that was solved and checked.

    Attributes
    ----------
    calibration : Calibration
        Result with the findings of the check.
    snapshot : Snapshot
        Streams and options of the result.
    check : CheckResult
        Check of the streams with the result.
    options : mapping
        Options that were set automatically because a check is certain of them: name to value.
    messages : tuple of OptionMessage
        Messages about these options and the reason. They are the first warnings of the calibration.
    """

    calibration: Calibration
    snapshot: Snapshot
    check: CheckResult = field(default_factory=lambda: CheckResult(()))
    options: Options = field(default_factory=dict)
    messages: tuple[OptionMessage, ...] = ()

    @property
    def is_usable(self) -> bool:
        """Whether no finding forbids the use of the result."""
        return not any(
            finding.makes_unusable for finding in self.check.findings
        )

    @property
    def n_objections(self) -> int:
        """Number of findings that are graver than a note."""
        return sum(
            finding.severity is not Severity.NOTE
            for finding in self.check.findings
        )

    @property
    def noise_fits(self) -> bool:
        """Whether the residuals fit the noise model; False without a noise model."""
        noise = self.calibration.noise
        return noise is not None and (noise.misfit or 0.0) <= _MAX_MISFIT

    @property
    def is_sound(self) -> bool:
        """Whether the result is usable, without objections, and fits its noise model."""
        return self.is_usable and self.n_objections == 0 and self.noise_fits

    def is_better_than(self, other: "Attempt", n_fewer: int) -> bool:
        """Return whether this attempt is better than another one.

        It is better if it is usable and the other attempt is not. It is also better if it has fewer
        objections by at least ``n_fewer``, unless only the other attempt fits its noise model.
        """
        if self.is_usable and not other.is_usable:
            return True
        is_improved = self.n_objections <= other.n_objections - n_fewer
        return is_improved and self.noise_fits >= other.noise_fits

    def with_findings(self, findings: Collection[Finding]) -> "Attempt":
        """Return the attempt with other findings, after the choice of a reading.

        The check of the attempt no longer contains two readings (poses or inverse poses).
        """
        sorted_findings = gravest_first(tuple(findings))
        return replace(
            self,
            calibration=replace(self.calibration, findings=sorted_findings),
            check=replace(self.check, findings=sorted_findings, readings=None),
        )

    def with_doubts(self, doubts: Collection[Finding]) -> "Attempt":
        """Return the attempt with further findings about options that were set automatically."""
        if not doubts:
            return self
        return self.with_findings((*self.check.findings, *doubts))

    def with_messages(
        self, options: Options, messages: Collection[OptionMessage]
    ) -> "Attempt":
        """Return the attempt with options that were set automatically, and warnings about them."""
        texts = [message.text for message in messages]
        warnings = tuple(dict.fromkeys((*texts, *self.calibration.warnings)))
        calibration = replace(self.calibration, warnings=warnings)
        return replace(
            self,
            calibration=calibration,
            options=dict(options),
            messages=tuple(messages),
        )

    def for_session(self) -> Calibration:
        """Return the result with lasting messages instead of messages with estimates."""
        texts = [message.text for message in self.messages]
        lasting = [message.lasting for message in self.messages]
        others = [
            text for text in self.calibration.warnings if text not in texts
        ]
        return replace(self.calibration, warnings=(*lasting, *others))


def with_options(snapshot: Snapshot, options: Options) -> Snapshot:
    """Return the snapshot with some options changed.

    If the time offset changes, all poses are paired anew.
    """
    if not options:
        return snapshot
    config = replace(snapshot.config, **options)
    if "time_offset" not in options:
        return replace(snapshot, config=config)
    if not len(snapshot.kept):
        return replace(snapshot, config=config, time_offset=None)
    # The new snapshot applies the repairs itself, so its buffers must have the original streams.
    without_repairs = replace(snapshot.config, **defaults_of(STREAM_REPAIRS))
    parent, child = replace(snapshot, config=without_repairs).streams
    # Kept pairs have larger gaps than the streams, so max_gap is that of the first pairing.
    return replace(
        snapshot,
        config=replace(config, max_gap=snapshot.max_gap_s),
        kept=PosePairs.empty(),
        buffered_parent=parent,
        buffered_child=child,
        paired_at=None,
        time_offset=None,
    )


def check(
    snapshot: Snapshot, calibration: Calibration | None = None
) -> CheckResult:
    """Check the streams of a snapshot, together with their result if there is one."""
    return kind_of(snapshot.config).check(snapshot, calibration)


def with_open_errors(
    calibration: Calibration,
    result: CheckResult,
    snapshot: Snapshot | None = None,
) -> Calibration:
    """Return the calibration with an allowance that contains the open faults of a check.

    If sigmas grow much, the calibration is examined again.
    """
    allowance = calibration.covariance_allowance + result.open_covariance
    wider = replace(calibration, covariance_allowance=allowance)
    if snapshot and (wider.sigmas > _MUCH_WIDER * calibration.sigmas).any():
        return snapshot.examined(wider)
    return wider


def checked(calibration: Calibration, snapshot: Snapshot) -> Attempt:
    """Check the streams of a result, and return the attempt."""
    result = check(snapshot, calibration)
    wider = with_open_errors(calibration, result, snapshot)
    return Attempt(replace(wider, findings=result.findings), snapshot, result)


def solved_with(snapshot: Snapshot, options: Options) -> Attempt | None:
    """Solve and check with some options changed. Return None if the solve fails."""
    try:
        other = with_options(snapshot, options)
        return checked(other.estimate(), other)
    except HandEyeCalibError:
        return None
