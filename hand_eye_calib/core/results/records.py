"""Records of a calibration: status, observability, residuals, findings, noise, clock, cross-check.

All records hold plain values. :mod:`hand_eye_calib.core.base.plain` reads and writes the records.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from typing import Any, Self, TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.plain import Document, from_plain, plain
from hand_eye_calib.core.base.registry import FINDING_WORDS
from hand_eye_calib.core.base.spelling import Interface, with_options
from hand_eye_calib.core.geometry.trajectory import Columns

# Motion pairs with a larger weight than this are inliers.
INLIER_WEIGHT = 0.5


TRANSLATIONS = ("x", "y", "z")
ROTATIONS = ("roll", "pitch", "yaw")
AXES = (*TRANSLATIONS, *ROTATIONS)


class SolveStatus(str, Enum):
    """How a solve ended.

    A result that is OK may be used. The observable directions of an UNOBSERVABLE result may be
    used. NOT_CONVERGED and CONTRADICTED (a prior contradicts the motion) are failures.

    Examples
    --------
    >>> result.status is hec.SolveStatus.OK
    True
    """

    OK = "ok"
    UNOBSERVABLE = "unobservable"
    NOT_CONVERGED = "not_converged"
    CONTRADICTED = "contradicted"

    @property
    def failure(self) -> str:
        """Reason why the solve failed; empty if it did not."""
        if self is SolveStatus.NOT_CONVERGED:
            return "the solver did not converge"
        if self is SolveStatus.CONTRADICTED:
            return "a prior contradicts the motion"
        return ""


class DofVerdict(str, Enum):
    """Knowledge about a degree of freedom; PRIOR if mostly or only a prior determines it."""

    OBSERVED = "observed"
    WEAK = "weak"
    UNOBSERVABLE = "unobservable"
    PRIOR = "prior"


@dataclass(frozen=True)
class DofObservability:
    """Observability of the child sensor's pose along or about an axis of the parent sensor.

    Attributes
    ----------
    name : str
        x, y, z (translation) or roll, pitch, yaw (rotation about x, y, z).
    verdict : DofVerdict
    sigma : float
        One standard deviation, m or rad; ``inf`` if unobservable. In ``observability`` it contains
        the allowance for constant errors; in ``observability_measured`` it does not.
    """

    name: str
    verdict: DofVerdict
    sigma: float


def by_hand(axis: str) -> str:
    """Return the text for an unknown axis in files and commands; every parser refuses it."""
    return f"MEASURE_{axis.upper()}_BY_HAND"


@dataclass(frozen=True, eq=False)
class Residuals(Columns):
    """Residuals of K motion pairs at the result.

    A pair of the adaptive estimator is the motion from one pose to the next.

    Attributes
    ----------
    translation : (K, 3) array
        Residuals of eq. (6) of Välimäki et al. 2023, m, in the axes of the parent sensor at the
        start of each pair.
    rotation : (K, 3) array
        Rotation vectors of the residual rotations, whose angles are those of eq. (7), rad, in the
        axes of the child sensor at the end of each pair.
    weights : (K,) array
        Weights of the pairs in the solution, 0 to 1.
    start_ns, end_ns : (K,) int64 arrays
        Stamps of both ends of each pair, parent clock.

    Examples
    --------
    >>> residuals = result.residuals()
    >>> residuals.translation.shape == (len(residuals), 3)
    True
    """

    translation: FloatArray
    rotation: FloatArray
    weights: FloatArray
    start_ns: IntArray
    end_ns: IntArray

    @property
    def translation_m(self) -> FloatArray:
        """Lengths (K,) of the translation residuals, m."""
        return np.linalg.norm(self.translation, axis=1)

    @property
    def rotation_rad(self) -> FloatArray:
        """Angles (K,) of the rotation residuals, rad."""
        return np.linalg.norm(self.rotation, axis=1)

    @property
    def is_inlier(self) -> BoolArray:
        """Mask (K,) of the pairs that are inliers."""
        return self.weights > INLIER_WEIGHT


class Severity(str, Enum):
    """Severity of a finding.

    An error makes results from these streams unusable. A result with a warning may be used with
    care. A note does not restrict the use.
    """

    NOTE = "note"
    WARNING = "warning"
    ERROR = "error"


# Codes of notes that the user can act on. All other notes have no advice.
_NOTES_WITH_ADVICE = ("one_axis",)
#: Advice for all other notes.
NO_ACTION = "no action is needed"

#: Key of the templates for a finding whose values include its sentences.
AS_WRITTEN = "as_written"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A problem of the streams that a check found.

    A finding stores values, not sentences. The templates of ``key`` in
    :data:`hand_eye_calib.core.base.registry.FINDING_WORDS` make sentences from the values.

    Attributes
    ----------
    code : str
        Short name, stable over versions.
    key : str
        Key of the templates. Findings with the same code may have different sentences.
    stream : str
        "parent", "child" or "both".
    severity : Severity
    values : mapping of str to number or str
        Values in the sentences, and other measured numbers.
    options : mapping
        Options that repair the problem, by their names in :mod:`hand_eye_calib.core.base.config`;
        empty if no option repairs it.
    """

    code: str
    key: str
    severity: Severity
    stream: str = "both"
    values: Mapping[str, float | int | str] = field(default_factory=dict)
    options: Mapping[str, float | str] = field(default_factory=dict)

    @property
    def what(self) -> str:
        """The problem, with its values."""
        return self._filled(words_of(self.key).what)

    @property
    def advice(self) -> str:
        """What the user should do, with options by their public names."""
        return self._filled(words_of(self.key).advice)

    @property
    def what_to_do(self) -> str:
        """Advice with options in the spelling of Python."""
        return self.advice_on(Interface.PYTHON)

    def advice_on(self, interface: Interface) -> str:
        """Return the advice with its options, in the spelling of an interface."""
        if (
            self.severity is Severity.NOTE
            and self.code not in _NOTES_WITH_ADVICE
        ):
            return NO_ACTION
        return with_options(self.advice, self.options, interface)

    @property
    def cause(self) -> str:
        """Usual cause; empty if :attr:`what` names the cause."""
        return self._filled(words_of(self.key).cause)

    @property
    def evidence(self) -> dict[str, float]:
        """Numbers among the values, by name."""
        return {
            name: float(value)
            for name, value in self.values.items()
            if not isinstance(value, str)
        }

    @property
    def makes_unusable(self) -> bool:
        """Whether a result is unusable as long as this fault is not repaired."""
        return self.severity is Severity.ERROR

    def to_dict(self) -> Document:
        """Return the finding with its sentences as a plain mapping."""
        document: Document = plain(self)
        for name in ("what", "advice", "cause", "evidence"):
            document[name] = plain(getattr(self, name))
        return document

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Build a finding from the mapping that :meth:`to_dict` returned.

        If this installation has no templates for the values, the sentences of the mapping are kept.
        The mapping is then from another version, or from an extra that is not installed.

        Raises
        ------
        KeyError, TypeError, ValueError
            If a field is missing or was changed.
        """
        if "values" in data:
            finding: Self = from_plain(cls, data)
            if finding._has_templates():
                return finding
        # Store the sentences among the values, with templates that only insert them.
        values: Document = from_plain(
            dict[str, float], data.get("evidence", {})
        )
        sentences = {"cause": "", **data}
        for name in ("what", "advice", "cause"):
            values[name] = from_plain(str, sentences[name])
        as_written: Self = from_plain(
            cls, {**data, "key": AS_WRITTEN, "values": values}
        )
        return as_written

    def _has_templates(self) -> bool:
        """Whether this installation has templates for the values of the finding."""
        try:
            str(self)
        except (KeyError, TypeError, ValueError):
            return False
        return True

    def _filled(self, template: str) -> str:
        """Fill a template with the values of the finding."""
        whose = (
            "both streams'"
            if self.stream == "both"
            else f"the {self.stream} stream's"
        )
        return template.format(stream=self.stream, whose=whose, **self.values)

    def __str__(self) -> str:
        cause = f" ({self.cause})" if self.cause else ""
        return f"{self.what.rstrip('.')}{cause}; {self.advice}"


@cache
def words_of(key: str) -> Any:
    """Return the templates of a finding, ``FindingWords``, by the key of the finding.

    Raises
    ------
    KeyError
        If no layer has registered the key.
    """
    words: dict[str, Any] = {}
    for load in FINDING_WORDS.values():
        words |= load()
    return words[key]


def has_error(findings: Iterable[Finding]) -> bool:
    """Return whether a finding forbids the use of results from these streams."""
    return any(finding.makes_unusable for finding in findings)


def gravest_first(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Sort findings by severity, errors first; findings of one severity keep their order."""
    order = list(Severity)
    return tuple(
        sorted(findings, key=lambda finding: -order.index(finding.severity))
    )


@dataclass(frozen=True, kw_only=True)
class CorrelatedError:
    """Time-correlated error of the trajectories.

    Attributes
    ----------
    kind : str
        "body", "world" or "path": the frame in which the error is constant for about ``tau_s``.
    part : str
        Part of the poses or of the path that has the error.
    sigma : float
        Standard deviation per axis: m, rad, or a share of the path.
    tau_s : float
        Correlation time, s.
    """

    kind: str
    part: str
    sigma: float
    tau_s: float


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Noise of the trajectories, estimated by the adaptive estimator.

    Standard deviations are per axis, for both sensors together. ``white`` is the noise of a single
    pose; ``drift`` is the random walk from pose to pose.

    Attributes
    ----------
    in_words : tuple of str
        The noise in sentences for the user.
    misfit : float or None
        Weighted squared residual over its expected value. It is about 1 if the errors fit the noise
        model, and larger if they do not.
    lasting : tuple of CorrelatedError
    systematic : str
        Names of the significant systematic errors, joined by "+", or "none".
    """

    in_words: tuple[str, ...]
    misfit: float | None = None
    translation_white_m: float | None = None
    rotation_white_rad: float | None = None
    translation_drift_m_per_pose: float | None = None
    rotation_drift_rad_per_pose: float | None = None
    lasting: tuple[CorrelatedError, ...] = ()
    systematic: str = ""


@dataclass(frozen=True, kw_only=True)
class ClockRate:
    """Rate of change of the time offset, in parts per million.

    Attributes
    ----------
    ppm, sigma_ppm : float
        Microseconds to add to the child's stamps per second after ``at_ns``, and one standard
        deviation. Positive if the child's clock is slow.
    at_ns : int
        Stamp on the child's clock at which the time offset is valid.
    is_used : bool
        Whether the rate is significant, so that the child's stamps were corrected.
    """

    ppm: float
    sigma_ppm: float
    at_ns: int
    is_used: bool = False

    @property
    def used(self) -> float:
        """Correction of the child's stamps, seconds per second."""
        return 1e-6 * self.ppm if self.is_used else 0.0

    def __str__(self) -> str:
        direction = "slow" if self.ppm > 0 else "fast"
        return f"{abs(self.ppm):.1f} +/- {self.sigma_ppm:.2g} ppm {direction}"


@dataclass(frozen=True, kw_only=True)
class AxisScatter:
    """Scatter of other estimates about a result on one axis, m or rad; None if unknown.

    Attributes
    ----------
    sigma : float or None
        Standard deviation of the result, with the allowance but without the scatter of other
        estimates; None if the axis is unobservable.
    of_methods : float or None
        Robust standard deviation of other estimates (robust least squares) about the result.
    of_halves : float or None
        Standard deviation computed from the difference between both halves of the recording.
    excess_of_methods, excess_of_halves : float or None
        ``of_methods`` and ``of_halves``, divided by the joint standard deviation. The joint
        standard deviation contains the allowance. For halves and a result of the noise model, it
        also contains the standard deviation of the result.
    excess_over_own : float or None
        Robust standard deviation of the other estimates that are about as certain as the result,
        divided by the standard deviation of the result.
    is_confirmed : bool
        False if the result determines the axis, but no other estimate does.
    """

    sigma: float | None
    of_methods: float | None
    of_halves: float | None
    excess_of_methods: float | None = None
    excess_of_halves: float | None = None
    excess_over_own: float | None = None
    is_confirmed: bool = True


#: Scatter of other estimates about a result, by axis (x, y, z, roll, pitch, yaw).
CrossCheck: TypeAlias = Mapping[str, AxisScatter]
