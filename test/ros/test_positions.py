"""A child that is a GNSS antenna: the node makes metres of its fixes and finds the lever arm, also
in a session that is resumed.
"""

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from motions import geodetic
from nav_msgs.msg import Odometry
from ros_harness import RELIABLE_INPUTS, T_PARENT_CHILD, drive, matrix, message
from sensor_msgs.msg import NavSatFix

from hand_eye_calib.io.journal import count_poses, has_session, read_journal
from hand_eye_calib.ros import conversions

ORIGIN = (60.0, 25.0, 40.0)


def fixes(stamps_ns, positions):
    """Messages of an antenna; one in twenty without a fix."""
    rows = zip(stamps_ns.tolist(), *geodetic(positions, ORIGIN), strict=True)
    for index, (stamp_ns, *place) in enumerate(rows):
        fix = NavSatFix()
        fix.header.stamp, fix.header.frame_id = conversions.to_time(stamp_ns), "antenna"
        fix.latitude, fix.longitude, fix.altitude = place
        fix.status.status = -1 if index % 20 == 19 else 0
        yield fix


def test_an_antenna_as_child_and_its_origin_after_a_restart(start_node, peer, tmp_path):
    stamps_ns, Ts_pw_p, Ts_cw_c = drive(160)
    rows = [*zip(stamps_ns, Ts_pw_p, fixes(stamps_ns, Ts_cw_c[:, :3, 3]), strict=True)]
    publishers = peer.publishers(Odometry, NavSatFix)

    def feed(part):
        peer.wait_matched(*publishers)
        for stamp_ns, T, fix in part:
            publishers[0].publish(message(Odometry, stamp_ns, T, "lidar"))
            publishers[1].publish(fix)

    options = *RELIABLE_INPUTS, "-p solve_period:=1000.0", f"-p output_directory:={tmp_path}"
    node = start_node(*options)
    feed(rows[:80])
    journal = tmp_path / "journal"
    peer.spin_until(lambda: has_session(journal) and count_poses(journal) == 156, "the journal")
    peer.spin_until(lambda: "origin" in read_journal(journal).about["child"], "the origin")
    origin = read_journal(journal).about["child"]["origin"]
    np.testing.assert_allclose(np.degrees(origin[:2]), [rows[0][2].latitude, rows[0][2].longitude])
    node.process.kill()
    node.wait()
    peer.wait_left(*publishers)

    node = start_node(*options, "-p journal:=resume")
    node.wait_for_log("session resumed")
    feed(rows[80:])
    peer.spin_until(lambda: count_poses(journal) == 312, "all poses in the journal")
    found = peer.listen(TransformStamped, "extrinsic")
    assert peer.trigger("solve").success
    peer.spin_until(lambda: found, "the lever arm")
    assert found[-1].child_frame_id == "antenna"
    assert matrix(found[-1])[:3, 3] == pytest.approx(T_PARENT_CHILD[:3, 3], abs=0.01)
    assert read_journal(journal).about["child"]["origin"] == origin
    assert "Traceback" not in node.log
