"""A folder with everything that commands and Python on the pages of the documentation name."""

import json
from pathlib import Path

import numpy as np
from bag_making import JAZZY, TF, fix, imu, tf_message
from motions import disturbed, geodetic, wandering_poses
from rosbags import rosbag2
from scipy.spatial.transform import Rotation

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import HILLY_DRIVE
from hand_eye_calib.formats.bags.writer import write_streams
from reproduction.machines import simulate_machine

# Lidar to camera on the pages: x 0.4 m, z 1.85 m, yaw -90 deg.
T_LIDAR_CAMERA = se3.from_quat_xyzw(
    np.array([0.4, 0.0, 1.85]), Rotation.from_euler("z", -90, degrees=True).as_quat()
)
_POSES = 250
_ODOMETRY = "nav_msgs/msg/Odometry"
_ROBOT = """\
<robot name="robot">
  <link name="lidar"/>
  <link name="camera"/>
  <joint name="mount" type="fixed">
    <parent link="lidar"/>
    <child link="camera"/>
    <origin xyz="0.4 0 1.85" rpy="0 0 -1.5707963"/>
  </joint>
</robot>
"""


def make(folder: Path) -> None:
    """Fill a folder: ``my_drive/``, ``lidar.tum``, ``camera.tum``, ``camera.csv``, ``ins.csv``,
    ``gnss.csv``, ``imu.csv``, ``flange.tum``, ``camera_on_arm.tum``,
    ``samples.yaml``, ``robot.urdf``, ``robot_lidar.tum``, ``wheels.csv``, and results.

    INS, antenna and IMU are where the camera is.
    """
    drive = simulate_drive(7, HILLY_DRIVE).parent[:_POSES]
    lidar = _noisy(drive.stamps_ns, drive.poses, 1, "lidar", "odom")
    camera = _noisy(drive.stamps_ns, drive.poses @ T_LIDAR_CAMERA, 2, "camera", "vo")
    hec.write_trajectory(folder / "lidar.tum", lidar)
    hec.write_trajectory(folder / "camera.tum", camera)
    np.savetxt(
        folder / "camera.csv", _rows(camera, scalar_first=True), "%.9f", delimiter=","
    )
    imu_ns, rates = _rates(camera)
    places = _geodetic(camera)
    _write_bag(folder / "my_drive", lidar, camera, places, (imu_ns, rates))
    _write_ins(folder / "ins.csv", camera, places)
    times = camera.stamps_ns[:, None] * 1e-9
    _write_csv(
        folder / "gnss.csv",
        "time,latitude,longitude,height",
        np.hstack([times, places]),
    )
    robot = simulate_machine(7, duration_s=60.0)
    hec.write_trajectory(folder / "robot_lidar.tum", robot.sensor)
    columns = np.column_stack([robot.stamps_ns * 1e-9, robot.values])
    _write_csv(folder / "wheels.csv", "time,left,right", columns)
    columns = np.column_stack([imu_ns * 1e-9, rates])
    _write_csv(folder / "imu.csv", "time,wx,wy,wz", columns)

    arm = wandering_poses(_POSES, seed=3)
    stamps_ns = drive.stamps_ns
    hec.write_trajectory(folder / "flange.tum", _noisy(stamps_ns, arm, 3))
    hec.write_trajectory(
        folder / "camera_on_arm.tum", _noisy(stamps_ns, arm @ T_LIDAR_CAMERA, 4)
    )

    camera_on_arm = disturbed(arm @ T_LIDAR_CAMERA, 5, 1e-3, 5e-4)
    stops = zip(
        arm[::10].tolist(), se3.inverse(camera_on_arm[::10]).tolist(), strict=True
    )
    (folder / "samples.yaml").write_text(json.dumps(list(stops)), encoding="utf-8")

    (folder / "robot.urdf").write_text(_ROBOT, encoding="utf-8")
    result = hec.calibrate(lidar, camera, method="dnlo", reference="B5")
    for name in ("result", "monday", "tuesday", "wednesday"):
        hec.save(result, folder / name)


def _noisy(stamps_ns, poses, seed, sensor="", world=""):
    return hec.Trajectory(stamps_ns, disturbed(poses, seed, 1e-3, 5e-4), sensor, world)


def _rows(trajectory, scalar_first):
    quats = se3.to_quat_xyzw(trajectory.poses)
    quats = np.roll(quats, 1, axis=1) if scalar_first else quats
    return np.column_stack(
        [trajectory.stamps_ns * 1e-9, trajectory.poses[:, :3, 3], quats]
    )


def _rates(trajectory):
    """Stamps between the poses, and the mean angular rates there."""
    rotations = Rotation.from_matrix(trajectory.poses[:, :3, :3])
    steps_ns = np.diff(trajectory.stamps_ns)
    turned = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
    return trajectory.stamps_ns[:-1] + steps_ns // 2, turned / (steps_ns * 1e-9)[
        :, None
    ]


def _geodetic(trajectory):
    """Latitude, longitude (deg) and height (m) of every position."""
    return np.transpose(geodetic(trajectory.poses[:, :3, 3], (60.17, 24.94, 20.0)))


def _write_bag(path, lidar, camera, places, rates):
    """Odometry of both sensors, the lidar's as /tf too, the antenna's fixes and the IMU's rates."""
    storage = rosbag2.StoragePlugin.MCAP
    with rosbag2.Writer(path, version=9, storage_plugin=storage) as writer:
        streams = {
            "/lidar/odometry": (lidar, _ODOMETRY),
            "/camera/odometry": (camera, _ODOMETRY),
        }
        write_streams(writer, streams, "mcap")
        connection = writer.add_connection("/tf", TF, typestore=JAZZY)
        for stamp_ns, pose in zip(lidar.stamps_ns.tolist(), lidar.poses, strict=True):
            message = tf_message([(stamp_ns, "odom", "lidar", pose)])(JAZZY)
            writer.write(connection, stamp_ns, JAZZY.serialize_cdr(message, TF))
        connection = writer.add_connection(
            "/gnss/fix", "sensor_msgs/msg/NavSatFix", typestore=JAZZY
        )
        for stamp_ns, place in zip(
            camera.stamps_ns.tolist(), places.tolist(), strict=True
        ):
            writer.write(connection, stamp_ns, fix(2, *place, stamp_ns=stamp_ns))
        connection = writer.add_connection(
            "/imu", "sensor_msgs/msg/Imu", typestore=JAZZY
        )
        for stamp_ns, rate in zip(rates[0].tolist(), rates[1].tolist(), strict=True):
            writer.write(connection, stamp_ns, imu(rate, stamp_ns=stamp_ns))


def _write_ins(path, trajectory, places):
    """Latitude, longitude, height, and angles as an INS has them."""
    yaw, pitch, roll = (
        Rotation.from_matrix(trajectory.poses[:, :3, :3])
        .as_euler("ZYX", degrees=True)
        .T
    )
    columns = [trajectory.stamps_ns * 1e-9, places, roll, -pitch, (90 - yaw) % 360]
    names = "time,latitude,longitude,height,roll_deg,pitch_deg,heading_deg"
    _write_csv(path, names, np.column_stack(columns))


def _write_csv(path, names, columns):
    np.savetxt(path, columns, "%.10f", delimiter=",", header=names, comments="")
