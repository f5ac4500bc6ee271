"""Calibration on a flat floor, from the motion and from the ground or gravity."""

from dataclasses import replace
from typing import Any

from hand_eye_calib.core.base.errors import require_type
from hand_eye_calib.core.engine.run import run
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.ground.joining import VerticalPair
from hand_eye_calib.extras.ground.tracks import VerticalTrack


def calibrate_on_ground(
    parent: Trajectory,
    child: Trajectory,
    parent_ground: VerticalTrack,
    child_ground: VerticalTrack,
    **options: Any,
) -> Calibration:
    """Estimate the pose of the child sensor from the motion and from the ground or gravity.

    On a flat floor, motion alone does not determine z, roll and pitch. Two lidars that measure the
    ground determine them. Gravity determines roll and pitch.

    Parameters
    ----------
    parent, child : Trajectory
    parent_ground, child_ground : VerticalTrack
        Results of :func:`hand_eye_calib.ground_from_clouds`,
        :func:`hand_eye_calib.gravity_from_accelerations` or
        :func:`hand_eye_calib.gravity_from_attitude`.
    **options
        Options of :func:`hand_eye_calib.calibrate` by their public names.

    Returns
    -------
    Calibration
        ``result.ground`` has the measurements from the ground or gravity. If they disagree with the
        motion, the result is from the motion alone.

    Raises
    ------
    ConfigError, InputError, NotEnoughDataError
        As :func:`hand_eye_calib.calibrate`.

    Examples
    --------
    >>> attitudes = [hec.gravity_from_attitude(stream) for stream in (parent, child)]
    >>> hec.calibrate_on_ground(parent, child, *attitudes).ground.is_joined  # doctest: +SKIP
    True
    """
    require_type("parent", parent, Trajectory)
    require_type("child", child, Trajectory)
    require_type("parent_ground", parent_ground, VerticalTrack)
    require_type("child_ground", child_ground, VerticalTrack)
    snapshot = whole_snapshot(parent, child, options)
    pair = VerticalPair(parent_ground, child_ground)
    result = run(replace(snapshot, beside_motion=(pair,)))
    return replace(result.calibration, recording=result.snapshot)
