"""Write the paths of both sensors and the transform between them into a bag for viewers.

The child's own path is moved into the parent's world by the mean of ``T_pw_p T_p_c T_c_cw`` over
the pose pairs. With the right extrinsic ``T_p_c``, this path and the child's frame on /tf agree.
"""

from pathlib import Path

import numpy as np

from hand_eye_calib.core.assessment.comparison import installed_transform
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.formats.bags.writer import write_bag
from hand_eye_calib.offline.report.evidence import rotation_between_worlds
from hand_eye_calib.offline.report.figures import evenly_spaced_rows

_TF = "tf2_msgs/msg/TFMessage"
_PATH = "nav_msgs/msg/Path"

# Name of the parent's world if its messages have none.
_WORLD = "world"


def write_viewer_bag(
    path: Path, calibration: Calibration, snapshot: Snapshot
) -> None:
    """Write a new bag (mcap) with transforms and paths.

    Topics: ``/tf`` has the parent's poses, ``/tf_static`` the result, ``/paths/parent`` the
    parent's path, ``/paths/child_after`` the child's own path through the result, and
    ``/paths/child_before`` the same through the installed transform, or else through the identity.
    All paths are in the parent's world.

    Raises
    ------
    InputError
        If the streams do not measure poses, if there is no transform, or if the bag cannot be
        written.
    """
    if calibration.measured != "poses" or calibration.has_failed:
        raise InputError(
            f"{path} is not written: it needs a result from positions and orientations of both "
            "sensors; omit --viewer"
        )
    parent, child = snapshot.streams
    child = child.shifted(calibration.time_offset_s).scaled(calibration.scale)
    pose_pairs = snapshot.pose_pairs_of(calibration)
    world = parent.world_frame or _WORLD
    installed = installed_transform(calibration)
    T_before = np.eye(4) if installed is None else installed
    extrinsic = Trajectory(
        parent.stamps_ns[:1],
        calibration.T_parent_child[None],
        world_frame=calibration.parent_frame,
        sensor_frame=calibration.child_frame,
    )
    moving = Trajectory(
        parent.stamps_ns,
        parent.poses,
        world_frame=world,
        sensor_frame=calibration.parent_frame,
    )
    streams = {
        "/tf": (moving, _TF),
        "/tf_static": (extrinsic, _TF),
        "/paths/parent": (_thinned(moving), _PATH),
    }
    for name, T_parent_child in (
        ("before", T_before),
        ("after", calibration.T_parent_child),
    ):
        T_pw_cw = _between_worlds(pose_pairs, T_parent_child)
        own = Trajectory(
            child.stamps_ns, T_pw_cw @ child.poses, world_frame=world
        )
        streams[f"/paths/child_{name}"] = (_thinned(own), _PATH)
    write_bag(path, streams)


def _between_worlds(
    pose_pairs: PosePairs, T_parent_child: FloatArray
) -> FloatArray:
    """Return the mean pose (4, 4) of the child's world in the parent's world.

    The rotation is the mean over the pose pairs. The translation is then the median.
    """
    Ts_cw_p = pose_pairs.Ts_cw_c @ se3.inverse(T_parent_child)
    rotation = rotation_between_worlds(pose_pairs, Ts_cw_p)
    Ts_pw_c = pose_pairs.Ts_pw_p @ T_parent_child
    positions = se3.translation_of(pose_pairs.Ts_cw_c) @ rotation.T
    differences = se3.translation_of(Ts_pw_c) - positions
    return se3.from_rotation_translation(
        rotation, np.median(differences, axis=0)
    )


def _thinned(trajectory: Trajectory) -> Trajectory:
    """Return as many poses as a figure has, evenly chosen, with the first and the last."""
    return trajectory[evenly_spaced_rows(len(trajectory))]
