"""How far the session is from its goal: on ``/diagnostics``, and in the log when that changes."""

import numpy as np

from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import Comparison
from hand_eye_calib.ros.log import NodeLog
from hand_eye_calib.ros.status import OK, WARN, Report
from hand_eye_calib.session.goal import Progress

UNOBSERVABLE = "unobservable"


class ProgressLog:
    """Writes the sentence of a progress when it says something new.

    Parameters
    ----------
    log : NodeLog
    """

    def __init__(self, log: NodeLog) -> None:
        self._log = log
        self._told: tuple[object, ...] = ()

    def tell(self, progress: Progress) -> None:
        """Write it unless only its figures differ from what was written last."""
        told = progress.limiting_axis, progress.is_done, progress.will_not_get_there
        if told == self._told or progress.sentence == "":
            return
        self._told = told
        if progress.will_not_get_there:
            self._log.warning(progress.sentence)
        else:
            self._log.info(progress.sentence)


def progress_report(
    progress: Progress, result: Calibration | None, why_not_compared: str = ""
) -> Report:
    """Each axis against its target, the seconds left, and what to do now.

    WARN before the first result, and while the motion is of no use for an axis that lacks.
    """
    level = WARN if result is None or progress.will_not_get_there else OK
    values: dict[str, object] = {
        "sentence": progress.sentence,
        "done": "true" if progress.is_done else "false",
        "limiting_axis": progress.limiting_axis,
        "verdict": result.verdict.value if result else "no result",
    }
    columns = zip(AXES, progress.sigmas, progress.targets, progress.seconds_left, strict=True)
    for axis, sigma, target, left_s in columns:
        known = np.isfinite(sigma)
        values[f"sigma.{axis}"] = f"{sigma:.6g}" if known else UNOBSERVABLE
        values[f"target.{axis}"] = f"{target:.6g}"
        values[f"seconds_left.{axis}"] = f"{left_s:.0f}" if np.isfinite(left_s) else UNOBSERVABLE
    for number, reason in enumerate(result.reasons if result else (), start=1):
        values[f"reason.{number}"] = f"{reason.sentence}: {reason.what_to_do}"
    if result is not None and result.comparison:
        values |= _comparison_values(result.comparison)
    elif why_not_compared:
        values |= {
            "comparison": "not yet",
            "comparison_sentence": f"not compared yet: {why_not_compared}",
        }
    return Report(level, progress.sentence, values)


def _comparison_values(comparison: Comparison) -> dict[str, object]:
    """What is installed, and how the result differs from it, per axis."""
    values: dict[str, object] = {
        "comparison": comparison.verdict,
        "comparison_sentence": comparison.sentence,
        "installed_from": comparison.installed,
    }
    for axis, row in comparison.differences[0].axes.items():
        sigma = row.sigma
        values[f"installed.{axis}"] = f"{comparison.values[axis]:.6g}"
        values[f"difference.{axis}"] = f"{row.difference:.6g}"
        values[f"difference_sigma.{axis}"] = (
            UNOBSERVABLE if not np.isfinite(sigma) else f"{sigma:.6g}"
        )
    return values
