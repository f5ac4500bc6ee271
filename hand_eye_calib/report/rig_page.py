"""``report.html`` of a rig: where its sensors are, drawn and in numbers, and whether results for
two sensors at a time close.
"""

from collections.abc import Sequence

from hand_eye_calib.report.figures import figure_of_views
from hand_eye_calib.report.report import TONES, page
from hand_eye_calib.rig.result import RigCalibration


def render_rig(rig: RigCalibration, inputs: Sequence[str]) -> str:
    """The page as HTML; ``inputs`` are where the trajectories came from."""
    return page(
        "rig.html",
        TONES[rig.verdict.value],
        rig.verdict.value,
        "",
        rig=rig,
        inputs=inputs,
        poses=[each.to_dict()["T_parent_child"] for each in rig.calibrations],
        figures=[figure_of_views(rig.calibrations)],
    )
