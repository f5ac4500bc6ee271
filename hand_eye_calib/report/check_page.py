"""``check.html``: what the stream checks found, and what they saw."""

from hand_eye_calib.checks.findings import Severity
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.evidence import see_streams
from hand_eye_calib.report.report import environment, said_of_streams
from hand_eye_calib.report.report_figures import draw_streams


def render_check(parent, child, agreement, findings, inputs, max_gap_s=CalibratorConfig.max_gap):
    """The page as HTML.

    Parameters
    ----------
    parent, child : Trajectory
        With the time offset and the scale that are known already.
    agreement : Agreement
    findings : sequence of Finding
        Its findings, and what else there is to say of the files.
    inputs : sequence of str
        Where the streams came from.
    max_gap_s : float

    Returns
    -------
    str
    """
    svg = said = aligned = ""
    # Without any correlation the streams were not looked at: too short, or their stamps are in
    # doubt.
    if agreement.correlation.overlap_s:
        offset_s = agreement.correlation.offset_s if agreement.correlation.is_clear else 0.0
        if offset_s:
            aligned = f" For the picture {offset_s:.3f} s were added to the child's stamps: that is where both turn together."
        seen = see_streams(parent, child.shifted(offset_s), max_gap_s)
        svg, said = draw_streams(seen, ("parent", "child")), said_of_streams(seen)
    return (
        environment()
        .get_template("check.html")
        .render(
            inputs=inputs,
            findings=findings,
            tone="good"
            if all(finding.severity is Severity.NOTE for finding in findings)
            else "bad",
            svg=svg,
            said=said,
            aligned=aligned,
        )
    )
