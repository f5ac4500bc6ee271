"""``check.html``: the findings of the stream checks, and a figure of both streams."""

from collections.abc import Sequence

from hand_eye_calib.checks.check import CheckResult
from hand_eye_calib.checks.findings import Finding, Severity
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.evidence import view_streams
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.report.captions import TITLES, of_streams
from hand_eye_calib.report.report import environment
from hand_eye_calib.report.report_figures import draw_streams

# A smaller time offset (s) is not mentioned.
_SHOWN_S = 5e-4

_MARKS = {"good": "✓", "warn": "!", "bad": "✗"}


def render_check(
    parent: Trajectory,
    child: Trajectory,
    checked: CheckResult,
    findings: Sequence[Finding],
    inputs: Sequence[str],
    verdict: str,
    max_gap_s: float = CalibratorConfig.max_gap,
) -> str:
    """The page as HTML.

    Parameters
    ----------
    parent, child : Trajectory
        With the time offset and the scale that are known already.
    checked : CheckResult
    findings : sequence of Finding
        Its findings, and what else there is to say of the files.
    inputs : sequence of str
        Where the streams came from.
    verdict : str
        What the findings mean, in a sentence that begins with USE, USE WITH CARE or DO NOT USE.
    max_gap_s : float

    Returns
    -------
    str
    """
    # Without any correlation the streams were not looked at: they are too short, or their stamps
    # are in doubt.
    is_seen = bool(checked.correlation.overlap_s)
    svg, said = _figure(parent, child, checked, max_gap_s) if is_seen else ("", "")
    tone = _tone(findings)
    return (
        environment()
        .get_template("check.html")
        .render(
            inputs=inputs,
            findings=findings,
            tone=tone,
            mark=_MARKS[tone],
            verdict=verdict.partition(": ")[0],
            meaning=verdict.partition(": ")[2],
            title=TITLES["streams"],
            svg=svg,
            said=said,
        )
    )


def _figure(
    parent: Trajectory, child: Trajectory, checked: CheckResult, max_gap_s: float
) -> tuple[str, str]:
    """SVG and caption of both streams, with the time offset that was found."""
    offset_s = checked.correlation.offset_s if checked.correlation.is_clear else 0.0
    seen = view_streams(parent, child.shifted(offset_s), max_gap_s)
    caption = of_streams(seen)
    if abs(offset_s) >= _SHOWN_S:
        caption += (
            f" In the figure {offset_s:.3f} s are added to the child's stamps: with that offset "
            f"both have the same {seen.quantity}."
        )
    return draw_streams(seen, ("parent", "child")), caption


def _tone(findings: Sequence[Finding]) -> str:
    if any(finding.makes_unusable for finding in findings):
        return "bad"
    return "warn" if any(each.severity is Severity.WARNING for each in findings) else "good"
