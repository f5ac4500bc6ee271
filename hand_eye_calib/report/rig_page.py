"""``report.html`` of a rig: where its sensors are, drawn and in numbers, and whether results for
two sensors at a time close.
"""

from collections.abc import Sequence
from typing import Any

from hand_eye_calib.report.figures import figure_of_views
from hand_eye_calib.report.report import TONES, page
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.status import AXES, TRANSLATIONS
from hand_eye_calib.rig.result import RigCalibration
from hand_eye_calib.text import counted, printed_angle, with_sigma


def render_rig(rig: RigCalibration, inputs: Sequence[str]) -> str:
    """The page as HTML.

    Parameters
    ----------
    rig : RigCalibration
    inputs : sequence of str
        Where the trajectories came from.
    """
    verdict = rig.verdict.value
    return page(
        "rig.html",
        TONES[verdict],
        verdict,
        "",
        count=counted(len(rig.sensors), "sensor"),
        first=rig.sensors[0],
        inputs=inputs,
        axes=[(name, "m" if name in TRANSLATIONS else "°") for name in AXES],
        sensors=[_sensor(each) for each in rig.calibrations],
        figures=[figure_of_views(rig.calibrations)],
        closures=[each.sentence for each in rig.closures],
        closes=all(each.closes for each in rig.closures),
    )


def _sensor(calibration: Calibration) -> dict[str, Any]:
    pose = calibration.to_dict()["T_parent_child"]
    metres = zip(pose["translation"], pose["sigma_total_translation"], strict=True)
    degrees = zip(pose["rpy_deg"], pose["sigma_total_rpy_deg"], strict=True)
    values = [with_sigma(*one, 3) for one in metres] + [printed_angle(*one) for one in degrees]
    return {
        "name": calibration.child_frame,
        "headline": calibration.headline,
        "reasons": [f"{each.sentence}: {each.what_to_do}" for each in calibration.reasons],
        "values": dict(zip(AXES, values, strict=True)),
    }
