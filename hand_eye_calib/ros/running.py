"""From arguments to a spinning node, and from a signal to a clean end."""

import argparse
import gc
import os
import re
import sys
import threading
import time
import traceback
from collections import deque

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.ros.calibrator_node import CalibratorNode

# How long a running solve may hold up the end of the program.
SOLVE_GRACE_S = 0.5

# At high rates, so many callbacks within so long, the executor takes more time to wait for each
# message than the node to use it. A pause lets several come together: on a slow computer the node
# keeps up.
_AT_HIGH_RATE, _AT_HIGH_RATE_WITHIN_S = 8, 0.04
_PAUSE_S, _BETWEEN_PAUSES_S = 0.002, 0.001


def run(arguments: list[str], signals: int) -> int:
    """Run the node until ``signals``, a file descriptor, is readable; returns the exit code."""
    try:
        _init(arguments)
    except UnknownROSArgsError as error:
        print(f"calibrator: unknown ROS arguments {error}", file=sys.stderr)
        return 2
    except RCLError as error:
        reason = re.sub(r", at \S+:\d+", "", " ".join(str(error).split()))
        print(f"calibrator: {reason}", file=sys.stderr)
        return 1
    return _run_node(signals)


def _init(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="calibrator",
        description="The extrinsic between two sensors from their odometry, live.",
        epilog="ROS arguments follow --ros-args.",
    )
    # rcl logs an error of its own before it raises the one that says what is wrong.
    set_logger_level("rcl", LoggingSeverity.FATAL)
    parser.parse_args(remove_ros_args(args=arguments))
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    set_logger_level("rcl", LoggingSeverity.UNSET)


def _run_node(signals: int) -> int:
    # Not the multi-threaded executor: it loses most messages of two 100 Hz streams.
    executor = SingleThreadedExecutor()
    node = None
    try:
        node = CalibratorNode()
        executor.add_node(node)
        gc.freeze()  # what was imported is not looked through again while messages wait
        _spin(executor, signals)
        code = 0
    except HandEyeCalibError as error:
        print(f"calibrator: {error}", file=sys.stderr)
        code = 1
    except Exception:
        traceback.print_exc()
        code = 1
    executor.shutdown()
    if node is not None:
        code = code if _stopped(node) else 1
        node.destroy_node()
    rclpy.try_shutdown()
    return code


def _stopped(node: CalibratorNode) -> bool:
    """Whether the node has ended with everything saved."""
    try:
        return node.stop(SOLVE_GRACE_S)
    except Exception:
        traceback.print_exc()
        return False


def _spin(executor: SingleThreadedExecutor, signals: int) -> None:
    stopping = threading.Event()

    def wait_for_signal() -> None:
        os.read(signals, 1)
        # As a task: executor.wake() alone does not make spin_once() return.
        executor.create_task(stopping.set)

    threading.Thread(target=wait_for_signal, name="signals", daemon=True).start()
    newest, resumed = deque([0.0], maxlen=_AT_HIGH_RATE), 0.0
    while not stopping.is_set():
        executor.spin_once()
        newest.append(time.monotonic())
        is_busy = newest[-1] - newest[0] < _AT_HIGH_RATE_WITHIN_S
        if is_busy and newest[-1] - resumed > _BETWEEN_PAUSES_S:
            time.sleep(_PAUSE_S)
            resumed = time.monotonic()
