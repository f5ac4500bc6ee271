"""Cross-check of a result with other methods and references, and with halves of its recording."""

from dataclasses import replace

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.answers import OtherAnswers
from hand_eye_calib.engine.offline import offline_config, whole_snapshot
from hand_eye_calib.engine.scatter import compare_answers
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import CrossCheck


def cross_check(
    calibration: Calibration,
    parent: Trajectory,
    child: Trajectory,
    config: CalibratorConfig | None = None,
) -> CrossCheck:
    """Cross-check a result with other methods and references and with both halves of its recording.

    This solves some fifteen times.

    Parameters
    ----------
    calibration : Calibration
        The result.
    parent, child : Trajectory
        The trajectories that gave it.
    config : CalibratorConfig, optional
        The options that gave it; the defaults, with the result's method, if left out.

    Returns
    -------
    CrossCheck

    Raises
    ------
    ConfigError
        If a stream is not one of poses.
    NotEnoughDataError
        If too few poses can be paired.
    """
    config = config or offline_config(parent, child, {"method": calibration.method})
    config.require_poses("a cross-check")
    settled = replace(config, time_offset=calibration.time_offset_s)
    pose_pairs = whole_snapshot(settled, parent, child).pose_pairs()
    answers = OtherAnswers(calibration, config, pose_pairs)
    return compare_answers(
        calibration,
        [other.calibration for other in answers.other_methods()],
        [half.calibration for half in answers.halves()],
    )
