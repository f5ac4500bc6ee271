"""Rows measured in this process: solvers on synchronised poses, the engine, and bags."""

import functools
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from hand_eye_calib.core.assessment.covariance import assess
from hand_eye_calib.core.assessment.reference_selection import select_reference
from hand_eye_calib.core.engine.calibrator import Calibrator
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import absolute_errors
from hand_eye_calib.core.noise import estimator
from hand_eye_calib.core.pairing.motion_pairs import motion_pairs
from hand_eye_calib.core.solvers import quadratic_form
from hand_eye_calib.core.solvers.registry import Method
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.writer import write_bag
from suite.baseline import FLOOR, OPENCV
from suite.data import LONG, REFERENCE, SHORT, messages, parts
from suite.measuring import measure, measure_in_turn, row_of

# Largest numbers of pairs of some rows in a usual run.
_USUAL = {"other methods": 10_000, "adaptive": 10_000}
# The same in a run with ``--full``.
_FULL = {"other methods": 100_000, "adaptive": 100_000}
# Largest number of pairs of the row "jackknife and covariance".
_JACKKNIFE = 100_000
OPENCV_METHODS = ("PARK", "TSAI", "HORAUD", "ANDREFF", "DANIILIDIS")
TOPICS = ("/lidar/odometry", "/camera/odometry")


def solver_rows(drive, is_full):
    """Yield the rows of all steps from synchronised poses to the extrinsic, for a drive."""
    poses = drive.poses
    pairs = drive.pairs
    size = len(pairs)
    most = _FULL if is_full else _USUAL

    def row(name, work):
        measured, _ = measure(name, size, work)
        return measured

    def row_with_errors(name, work):
        measured, result = measure(name, size, work)
        objective = getattr(result, "objective", None)
        return with_errors(measured, result.T_parent_child, objective)

    def with_errors(measured, T_parent_child, objective):
        metres, radians = absolute_errors(T_parent_child, drive.T_parent_child)
        return replace(
            measured, objective=objective, error_m=metres, error_rad=radians
        )

    def solved(method, backend="fast"):
        return lambda: Method(method, backend=backend).solve(pairs)

    yield row(
        FLOOR,
        lambda: pairs.Ts_parenti_parentj.sum() + pairs.Ts_childi_childj.sum(),
    )
    yield row(
        "pairs", lambda: motion_pairs(poses.Ts_pw_p, poses.Ts_cw_c, REFERENCE)
    )
    yield row("condense", lambda: quadratic_form.condense(pairs))
    for method in ("dnl", "dnlo"):
        fast = (f"{method} fast", solved(method))
        if size in (SHORT, LONG):
            slow = (f"{method} ipopt", solved(method, "ipopt"))
            for measured, solution in measure_in_turn(size, slow, fast):
                yield with_errors(
                    measured, solution.T_parent_child, solution.objective
                )
        else:
            yield row_with_errors(*fast)
    if size <= most["other methods"]:
        for method in ("park", "taylor", "zhuang", "ali"):
            yield row_with_errors(method, solved(method))
    if size <= _JACKKNIFE:
        method = Method("dnlo")
        solution = solved("dnlo")()
        yield row(
            "jackknife and covariance",
            lambda: assess(
                pairs,
                solution,
                lambda left_out: method.solve_without(
                    pairs, solution, left_out
                ),
            ),
        )
    if size <= most["adaptive"]:
        yield row_with_errors(
            "adaptive",
            lambda: estimator.solve(
                poses.stamps_ns, poses.Ts_pw_p, poses.Ts_cw_c
            ),
        )
        yield row(
            "reference auto", lambda: select_reference(poses, Method("dnlo"))
        )


def opencv_rows(drives):
    """Yield rows of OpenCV: all methods on the short drive, and the fastest on the long drive."""
    try:
        import cv2
    except ImportError:
        advice = "its rows are left out; pip install 'opencv-python-headless<5'"
        print(f"opencv: not installed, {advice}", file=sys.stderr)
        return
    methods = OPENCV_METHODS
    for size in (SHORT, LONG):
        poses = drives[size].poses
        rows_of_drive = []
        for method in methods:
            row, T_parent_child = measure(
                f"opencv {method.lower()}",
                size,
                lambda method=method, poses=poses: opencv(
                    cv2, method, poses.Ts_pw_p, poses.Ts_cw_c
                ),
            )
            metres, radians = absolute_errors(
                T_parent_child, drives[size].T_parent_child
            )
            rows_of_drive.append(
                replace(row, error_m=metres, error_rad=radians)
            )
        yield from rows_of_drive
        quickest = min(rows_of_drive, key=lambda row: row.seconds)
        yield replace(quickest, name=OPENCV)
        methods = [
            method
            for method in methods
            if quickest.name == f"opencv {method.lower()}"
        ]


def opencv(cv2, method, Ts_pw_p, Ts_cw_c):
    """Return T_parent_child (4, 4) from OpenCV's ``calibrateHandEye``.

    OpenCV's "gripper to base" is the pose of the parent in its world. OpenCV's "target to camera"
    is the inverse of the pose of the child in its world. Then OpenCV's "camera to gripper" is
    T_parent_child. OpenCV uses the motions between all pairs of poses.
    """
    Ts_child_world = se3.inverse(Ts_cw_c)
    rotation, translation = cv2.calibrateHandEye(
        list(Ts_pw_p[:, :3, :3]),
        list(Ts_pw_p[:, :3, 3]),
        list(Ts_child_world[:, :3, :3]),
        list(Ts_child_world[:, :3, 3]),
        method=getattr(cv2, f"CALIB_HAND_EYE_{method}"),
    )
    return se3.from_rotation_translation(rotation, np.ravel(translation))


def engine_rows(n_messages):
    """Yield rows of the engine's time for a message: median and 99th percentile."""
    calibrator = Calibrator()
    times = []
    streams = parts(0, n_messages // 2, 100)
    for pose in range(n_messages // 2):
        for stream, (stamps_ns, positions, quats) in streams.items():
            start = time.perf_counter_ns()
            calibrator.add_pose(
                stream, stamps_ns[pose], positions[pose], quats[pose]
            )
            times.append((time.perf_counter_ns() - start) * 1e-9)
    fifths = np.array_split(times, 5)
    yield row_of(
        "add_pose, median", n_messages, [np.median(part) for part in fifths]
    )
    tails = [np.percentile(part, 99) for part in fifths]
    yield row_of("add_pose, 99th percentile", n_messages, tails)


def bag_rows(n_messages):
    """Yield rows for the reading of two Odometry topics, by rosbags alone and by this package.

    rosbags alone only decodes all messages. Every kind of storage has its own rows.
    """
    for storage in ("mcap", "sqlite3", "rosbag1"):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(
                folder, "recording.bag" if storage == "rosbag1" else "recording"
            )
            write_messages(path, n_messages, storage)
            for name, work in (
                ("rosbags alone", _by_rosbags),
                ("bag: read", _by_us),
            ):
                row, _ = measure(
                    f"{name}, {storage}",
                    n_messages,
                    functools.partial(work, path),
                )
                yield row


def write_messages(path, n_messages, storage="mcap"):
    """Write a bag of both streams on TOPICS."""
    trajectories = messages(0, n_messages // 2, 100)
    streams = zip(trajectories, ["nav_msgs/msg/Odometry"] * 2, strict=True)
    write_bag(path, dict(zip(TOPICS, streams, strict=True)), storage)


def _by_rosbags(path):
    with AnyReader(
        [path], default_typestore=get_typestore(Stores.ROS2_JAZZY)
    ) as reader:
        for connection, _, data in reader.messages(reader.connections):
            reader.deserialize(data, connection.msgtype)


def _by_us(path):
    with PoseBag(path) as bag:
        bag.poses(*TOPICS)
