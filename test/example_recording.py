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
from hand_eye_calib.formats.bags.writer import write_bag, write_streams
from reproduction.machines import simulate_machine

# Lidar to camera on the pages: x 0.4 m, z 1.85 m, yaw -90 deg.
T_LIDAR_CAMERA = se3.from_quat_xyzw(
    np.array([0.4, 0.0, 1.85]),
    Rotation.from_euler("z", -90, degrees=True).as_quat(),
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
    """Fill a folder: ``my_drive/``, ``my_yard/``, ``lidar.tum``, ``camera.tum``,
    ``camera.csv``, ``ins.csv``, ``gnss.csv``, ``imu.csv``, ``flange.tum``, ``camera_on_arm.tum``,
    ``samples.yaml``, ``robot.urdf``, ``robot_lidar.tum``, ``wheels.csv``, and results.

    INS, antenna and IMU are where the camera is.
    """
    lidar, camera = _write_drive(folder)
    _write_machine(folder)
    _write_arm(folder, lidar.stamps_ns)
    (folder / "robot.urdf").write_text(_ROBOT, encoding="utf-8")

    result = hec.calibrate(lidar, camera, method="dnlo", reference="B5")
    for name in ("result", "monday", "tuesday", "wednesday"):
        hec.save(result, folder / name)


def _write_drive(folder):
    """Write the streams of a vehicle; return those of lidar and camera."""
    drive = simulate_drive(7, HILLY_DRIVE).parent[:_POSES]
    lidar = _noisy(drive.stamps_ns, drive.poses, 1, "lidar", "odom")
    camera = _noisy(
        drive.stamps_ns, drive.poses @ T_LIDAR_CAMERA, 2, "camera", "vo"
    )
    hec.write_trajectory(folder / "lidar.tum", lidar)
    hec.write_trajectory(folder / "camera.tum", camera)
    rows = _rows(camera, scalar_first=True)
    np.savetxt(folder / "camera.csv", rows, "%.9f", delimiter=",")

    imu_ns, rates = _rates(camera)
    places = _geodetic(camera)
    _write_bag(folder / "my_drive", lidar, camera, places, (imu_ns, rates))
    two_lidars = {
        "/front/odometry": (lidar, _ODOMETRY),
        "/rear/odometry": (camera, _ODOMETRY),
    }
    write_bag(folder / "my_yard", two_lidars)
    _write_ins(folder / "ins.csv", camera, places)
    columns = _after_times(camera.stamps_ns, places)
    _write_csv(folder / "gnss.csv", "time,latitude,longitude,height", columns)
    columns = _after_times(imu_ns, rates)
    _write_csv(folder / "imu.csv", "time,wx,wy,wz", columns)
    return lidar, camera


def _write_machine(folder):
    """Write the lidar's poses and the wheel speeds of a machine."""
    robot = simulate_machine(7, duration_s=60.0)
    hec.write_trajectory(folder / "robot_lidar.tum", robot.sensor)
    columns = _after_times(robot.stamps_ns, robot.values)
    _write_csv(folder / "wheels.csv", "time,left,right", columns)


def _write_arm(folder, stamps_ns):
    """Write the poses of a flange and of a camera on an arm, and samples of their stops."""
    flange = wandering_poses(_POSES, seed=3)
    camera = flange @ T_LIDAR_CAMERA
    hec.write_trajectory(folder / "flange.tum", _noisy(stamps_ns, flange, 3))
    hec.write_trajectory(
        folder / "camera_on_arm.tum", _noisy(stamps_ns, camera, 4)
    )

    noisy_camera = disturbed(camera, 5, 1e-3, 5e-4)
    flange_stops = flange[::10].tolist()
    camera_stops = se3.inverse(noisy_camera[::10]).tolist()
    samples = list(zip(flange_stops, camera_stops, strict=True))
    (folder / "samples.yaml").write_text(json.dumps(samples), encoding="utf-8")


def _after_times(stamps_ns, values):
    """Columns of times (s) and values."""
    times_s = stamps_ns * 1e-9
    return np.column_stack([times_s, values])


def _noisy(stamps_ns, poses, seed, sensor="", world=""):
    noisy_poses = disturbed(poses, seed, 1e-3, 5e-4)
    return hec.Trajectory(stamps_ns, noisy_poses, sensor, world)


def _rows(trajectory, scalar_first):
    times_s = trajectory.stamps_ns * 1e-9
    positions = trajectory.poses[:, :3, 3]
    quats = se3.to_quat_xyzw(trajectory.poses)
    if scalar_first:
        quats = np.roll(quats, 1, axis=1)
    return np.column_stack([times_s, positions, quats])


def _rates(trajectory):
    """Stamps between the poses, and the mean angular rates there."""
    rotations = Rotation.from_matrix(trajectory.poses[:, :3, :3])
    increments = rotations[:-1].inv() * rotations[1:]
    steps_ns = np.diff(trajectory.stamps_ns)
    steps_s = steps_ns * 1e-9
    rates = increments.as_rotvec() / steps_s[:, None]
    stamps_ns = trajectory.stamps_ns[:-1] + steps_ns // 2
    return stamps_ns, rates


def _geodetic(trajectory):
    """Latitude, longitude (deg) and height (m) of every position."""
    positions = trajectory.poses[:, :3, 3]
    origin = (60.17, 24.94, 20.0)
    return np.transpose(geodetic(positions, origin))


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
        for stamp_ns, pose in zip(
            lidar.stamps_ns.tolist(), lidar.poses, strict=True
        ):
            message = tf_message([(stamp_ns, "odom", "lidar", pose)])(JAZZY)
            writer.write(connection, stamp_ns, JAZZY.serialize_cdr(message, TF))
        connection = writer.add_connection(
            "/gnss/fix", "sensor_msgs/msg/NavSatFix", typestore=JAZZY
        )
        for stamp_ns, place in zip(
            camera.stamps_ns.tolist(), places.tolist(), strict=True
        ):
            writer.write(
                connection, stamp_ns, fix(2, *place, stamp_ns=stamp_ns)
            )
        connection = writer.add_connection(
            "/imu", "sensor_msgs/msg/Imu", typestore=JAZZY
        )
        for stamp_ns, rate in zip(
            rates[0].tolist(), rates[1].tolist(), strict=True
        ):
            writer.write(connection, stamp_ns, imu(rate, stamp_ns=stamp_ns))


def _write_ins(path, trajectory, places):
    """Latitude, longitude, height, and angles as an INS has them."""
    yaw, pitch, roll = (
        Rotation.from_matrix(trajectory.poses[:, :3, :3])
        .as_euler("ZYX", degrees=True)
        .T
    )
    columns = [
        trajectory.stamps_ns * 1e-9,
        places,
        roll,
        -pitch,
        (90 - yaw) % 360,
    ]
    names = "time,latitude,longitude,height,roll_deg,pitch_deg,heading_deg"
    _write_csv(path, names, np.column_stack(columns))


def _write_csv(path, names, columns):
    np.savetxt(path, columns, "%.10f", delimiter=",", header=names, comments="")
