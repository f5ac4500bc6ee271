"""``check.html``: the findings of the stream checks, and a figure of both streams."""

from collections.abc import Sequence
from dataclasses import replace

from hand_eye_calib.checks.check import CheckResult
from hand_eye_calib.checks.findings import Finding
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.evidence import view_streams
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.report.figures import figure_of_streams
from hand_eye_calib.report.report import TONES, page

# A smaller time offset (s) is not mentioned.
_SHOWN_S = 5e-4


def render_check(
    parent: Trajectory,
    child: Trajectory,
    checked: CheckResult,
    findings: Sequence[Finding],
    inputs: Sequence[str],
    verdict: str,
    max_gap_s: float = CalibratorConfig.max_gap,
) -> str:
    """The page as HTML, of streams with the time offset and the scale that are known already.

    ``findings`` are those of the check, and what else there is to say of the files; ``inputs`` say
    where the streams came from; ``verdict`` is a sentence that begins with USE, USE WITH CARE or DO
    NOT USE.
    """
    figures = []
    # Without any correlation the streams were not looked at: they are too short, or their stamps
    # are in doubt.
    if checked.correlation.overlap_s:
        offset_s = checked.correlation.offset_s if checked.correlation.is_clear else 0.0
        seen = view_streams(parent, child.shifted(offset_s), max_gap_s)
        drawn = figure_of_streams(seen, ("parent", "child"))
        if abs(offset_s) >= _SHOWN_S:
            more_said = (
                f" In the figure {offset_s:.3f} s are added to the child's stamps: with that "
                f"offset both have the same {seen.quantity}."
            )
            drawn = replace(drawn, said=drawn.said + more_said)
        figures = [drawn]
    word, _, said = verdict.partition(": ")
    more = {"inputs": inputs, "findings": findings, "figures": figures}
    return page("check.html", TONES[word], word, said, **more)
