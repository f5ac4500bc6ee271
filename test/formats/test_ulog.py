"""Logs of PX4."""

import importlib.util
import struct

import numpy as np
import pytest
from motions import as_trajectory, read_trajectory_file, wandering_poses
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.errors import InputError, MissingDependencyError
from hand_eye_calib.formats.trajectory_files.file_options import AUTO

TRUTH = as_trajectory(
    wandering_poses(40), rate_hz=10.0, start_ns=1_700_000_000_000_000_000
)

# Fields of the topics of a log of PX4, as its own definitions of messages have them.
PX4 = {
    "vehicle_odometry": "uint64_t timestamp;uint64_t timestamp_sample;uint8_t pose_frame;"
    "float[3] position;float[4] q;",
    "vehicle_local_position": "uint64_t timestamp;uint64_t timestamp_sample;bool xy_valid;"
    "bool z_valid;float x;float y;float z;",
    "vehicle_attitude": "uint64_t timestamp;uint64_t timestamp_sample;float[4] q;",
}


def of_ulog(*topics):
    """A log by the published format of ULog files, in axes north, east, down."""

    def message(kind, data):
        return struct.pack("<HB", len(data), ord(kind)) + data

    flip = np.diag([1.0, -1, -1])
    places = TRUTH.poses[:, :3, 3] @ flip
    turns = Rotation.from_matrix(flip @ TRUTH.poses[:, :3, :3] @ flip).as_quat()
    log = (
        b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40))
    )
    log += b"".join(
        message("F", f"{name}:{PX4[name]}".encode()) for name in topics
    )
    for number, name in enumerate(topics):
        log += message("A", struct.pack("<BH", 0, number) + name.encode())
    for k, stamp in enumerate((TRUTH.stamps_ns // 1000).tolist()):
        for number, name in enumerate(topics):
            place = tuple(places[k])
            turn = tuple(np.roll(turns[k], 1))
            form, values = {
                "vehicle_odometry": ("B7f", (1, *place, *turn)),
                "vehicle_local_position": ("??3f", (k > 0, True, *place)),
                "vehicle_attitude": ("4f", turn),
            }[name]
            log += message(
                "D",
                struct.pack(f"<HQQ{form}", number, stamp + 900, stamp, *values),
            )
    return log


@pytest.mark.parametrize("topics", [[*PX4][:1], [*PX4][1:], [*PX4], [*PX4][2:]])
def test_a_log_of_px4(tmp_path, topics):
    """Odometry before positions and attitudes; without pyulog one sentence."""
    (tmp_path / "log.ulg").write_bytes(of_ulog(*topics))
    message = (
        r"'\.\[px4\]'|not contain vehicle_odometry or vehicle_local_position$"
    )
    if not importlib.util.find_spec("pyulog") or topics == ["vehicle_attitude"]:
        with pytest.raises((MissingDependencyError, InputError), match=message):
            read_trajectory_file(tmp_path / "log.ulg", AUTO)
        return
    trajectory = read_trajectory_file(tmp_path / "log.ulg", AUTO).trajectory
    expected = TRUTH if "vehicle_odometry" in topics else TRUTH[1:]
    assert_allclose(trajectory.poses, expected.poses, atol=1e-5)
    assert (trajectory.stamps_ns == expected.stamps_ns).all()
