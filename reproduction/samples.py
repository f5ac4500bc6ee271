"""Make the sample files of the package: ``python -m reproduction.samples``.

The bag contains the poses of the sample files ``lidar.tum`` and ``camera.tum``. The arm is
simulated; the first lines of its file contain the true extrinsic. The robot with two driven wheels
and a lidar is simulated, too; its true parameters are in ``docs/tutorials/base_link.md``.
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from rosbags.rosbag2 import (
    CompressionFormat,
    CompressionMode,
    StoragePlugin,
    Writer,
)

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.samples import read_arm_samples
from hand_eye_calib.formats.bags.writer import write_streams
from hand_eye_calib.formats.files import local_path
from hand_eye_calib.formats.trajectory_files.reading import read_trajectory
from reproduction.machines import Machine, simulate_machine

# Number of stops of the arm. The poses below are x, y, z (m) and a rotation vector (rad).
N_STOPS = 24
# Camera on the hand.
CAMERA_IN_GRIPPER = [0.06, -0.03, 0.09, 0.1, -0.05, 1.5]
# Target on the table.
TARGET_IN_BASE = [0.5, 0.05, 0.02, 0.0, 0.0, 0.4]
# Mean pose of the hand: above the target, the camera looks down.
HAND_IN_BASE = [0.45, 0.0, 0.4, 3.0, 0.05, 0.1]
# Standard deviations of the hand's positions (m) and rotations (rad) between the stops.
SPREAD_M = 0.1
SPREAD_RAD = 0.35
# Noise of the poses of the target: position (m), rotation (rad).
NOISE = np.repeat([0.0005, 0.001], 3)
SEED = 1

# Seed of the robot's drive, and its duration (s).
ROBOT_SEED = 5254
ROBOT_S = 120.0
# Number of rows of the simulated wheel data (50 Hz) that are averaged to a row of the file.
ROBOT_ROWS = 2


def write_sample_bag(path: Path) -> None:
    """Write the bag, in chunks that are compressed."""
    streams = {}
    for name in ("lidar", "camera"):
        trajectory = read_trajectory(f"sample:{name}.tum")
        named = replace(
            trajectory, world_frame=f"{name}_odom", sensor_frame=name
        )
        streams[f"/{name}/odometry"] = (named, "nav_msgs/msg/Odometry")
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "drive"
        writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            write_streams(writer, streams, "mcap")
        shutil.copyfile(bag / "drive.mcap", path)


def write_sample_arm(path: Path) -> None:
    """Write the stops in the format of easy_handeye2."""
    random = np.random.default_rng(SEED)
    turns = se3.rotation_exp(SPREAD_RAD * random.normal(size=(N_STOPS, 3)))
    T_base_hand = se3_of(HAND_IN_BASE)
    rotations = se3.rotation_of(T_base_hand) @ turns
    positions = HAND_IN_BASE[:3] + SPREAD_M * random.normal(size=(N_STOPS, 3))
    Ts_base_gripper = se3.from_rotation_translation(rotations, positions)
    T_gripper_camera = se3_of(CAMERA_IN_GRIPPER)
    Ts_camera_base = se3.inverse(Ts_base_gripper @ T_gripper_camera)
    noise = se3.exp(NOISE * random.normal(size=(N_STOPS, 6)))
    Ts_camera_target = Ts_camera_base @ se3_of(TARGET_IN_BASE) @ noise
    parameters = {
        "calibration_type": "eye_in_hand",
        "robot_base_frame": "base",
        "robot_effector_frame": "gripper",
        "tracking_base_frame": "camera",
        "tracking_marker_frame": "target",
    }
    lines = [
        "# Stops of a simulated arm with a camera on the gripper, and a target on the table.",
        f"# True pose of the camera in the gripper: x y z {CAMERA_IN_GRIPPER[:3]} m,",
        f"# rotation vector {CAMERA_IN_GRIPPER[3:]} rad.",
        f"parameters: {json.dumps(parameters)}",
        "samples:",
    ]
    for robot, tracking in zip(Ts_base_gripper, Ts_camera_target, strict=True):
        lines.append(f"- robot: {json.dumps(message_of(robot))}")
        lines.append(f"  tracking: {json.dumps(message_of(tracking))}")
    _write_lines(path, lines)


def write_sample_arm_files(folder: Path) -> None:
    """Write the stops of ``arm.yaml`` as two files of poses: hand in base, camera in target."""
    samples = read_arm_samples(folder / "arm.yaml")
    stacks = {
        "hand.tum": samples.robot,
        "camera_in_target.tum": se3.inverse(samples.tracking),
    }
    for name, poses in stacks.items():
        numbers = np.arange(len(poses))
        _write_tum(folder / name, numbers, poses)


def _write_tum(path: Path, times_s: ArrayLike, poses: FloatArray) -> None:
    """Write times (N,) and poses (N, 4, 4) with six decimals."""
    rows = np.column_stack([times_s, se3.to_rows(poses)])
    lines = []
    for row in rows.tolist():
        words = [f"{value:.6f}" for value in row]
        lines.append(" ".join(words))
    _write_lines(path, lines)


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    text = "\n".join([*lines, ""])
    path.write_text(text, encoding="utf-8")


def sample_robot() -> Machine:
    """Simulate the robot: figures of eight on a flat floor, with slip."""
    return simulate_machine(ROBOT_SEED, duration_s=ROBOT_S)


def write_sample_robot(folder: Path) -> None:
    """Write the trajectory of the lidar, and the rates of the wheels at 25 Hz."""
    robot = sample_robot()
    lidar = robot.sensor
    _write_tum(folder / "robot_lidar.tum", lidar.stamps_ns * 1e-9, lidar.poses)
    blocks = robot.values.reshape(-1, ROBOT_ROWS, 2)
    times_s = robot.stamps_ns.reshape(-1, ROBOT_ROWS) * 1e-9
    rows = np.column_stack([times_s.mean(axis=1), blocks.mean(axis=1)])
    lines = ["t,left_rad_s,right_rad_s"]
    for time_s, left, right in rows.tolist():
        lines.append(f"{time_s:.3f},{left:.4f},{right:.4f}")
    _write_lines(folder / "robot_wheels.csv", lines)


def se3_of(values: list[float]) -> FloatArray:
    """Return the transform (4, 4) of a position and a rotation vector."""
    rotation = se3.rotation_exp(np.array(values[3:]))
    return se3.from_rotation_translation(rotation, values[:3])


def message_of(T: FloatArray) -> dict[str, dict[str, float]]:
    """Return a transform as the fields of geometry_msgs/Transform, to a micrometre."""
    values = [round(value, 6) for value in se3.to_rows(T).tolist()]
    return {
        "translation": dict(zip("xyz", values[:3], strict=True)),
        "rotation": dict(zip("xyzw", values[3:], strict=True)),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=local_path("sample:"))
    folder = parser.parse_args().out
    write_sample_bag(folder / "drive.mcap")
    write_sample_arm(folder / "arm.yaml")
    write_sample_arm_files(folder)
    write_sample_robot(folder)
