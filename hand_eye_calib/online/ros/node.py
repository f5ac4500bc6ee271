"""Entry point of the node ``calibrator``: start, spin, and clean end after a signal.

ROS and the engine are imported late, so that Ctrl-C during the import ends the program quietly.
"""

import gc
import os
import re
import signal
import sys
import threading
import time
import traceback

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)

# Pause (s) before waiting messages are taken without the executor. Waiting in the executor takes as
# much processor time as ten messages.
_PAUSE_S = 0.003
# Longest time (s) for which messages are taken without the executor.
_MAX_WITHOUT_EXECUTOR_S = 0.02


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM.

    Parameters
    ----------
    args : list of str, optional
        Arguments without the name of the program; by default the arguments of the process.

    Returns
    -------
    int
        Exit code: 0 stopped by a signal; 1 bad parameter, failure, or a result that could not be
        saved (reported on stderr); 2 wrong usage.
    """
    # A signal only makes this pipe readable. Therefore no KeyboardInterrupt interrupts a callback,
    # rclpy does not shut down its context during a callback, and a second Ctrl-C has no effect.
    readable, writable = os.pipe()
    os.set_blocking(writable, False)
    signal.set_wakeup_fd(writable, warn_on_full_buffer=False)
    for number in STOP_SIGNALS:
        signal.signal(number, lambda *_: None)
    code = _init(sys.argv[1:] if args is None else args) or _run_node(readable)
    # At its end, the interpreter restores the default handlers. Ignore signals from now on, so that
    # a late Ctrl-C does not change the exit code.
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    return code


def _init(arguments: list[str]) -> int:
    """Start rclpy and return the exit code, which is 0 after a successful start."""
    import rclpy
    from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
    from rclpy.logging import LoggingSeverity, set_logger_level
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args

    def fail(text: str, code: int) -> int:
        print(f"calibrator: {text}", file=sys.stderr)
        return code

    # rcl logs an error before it raises the same error with the cause. Suppress the log.
    set_logger_level("rcl", LoggingSeverity.FATAL)
    try:
        if unknown := remove_ros_args(args=arguments):
            return fail(
                f"unknown arguments {unknown}; ROS arguments follow --ros-args, such as "
                "--ros-args -r parent_odom:=TOPIC -r child_odom:=TOPIC",
                2,
            )
        rclpy.init(
            args=arguments, signal_handler_options=SignalHandlerOptions.NO
        )
    except UnknownROSArgsError as error:
        return fail(f"unknown ROS arguments {error}", 2)
    except RCLError as error:
        return fail(_in_words(str(error)), 1)
    set_logger_level("rcl", LoggingSeverity.UNSET)
    return 0


# Messages of rcl: a rule without the sign := or with a wrong name, and a parameter file.
_WRONG_RULE = re.compile(
    r"Couldn't parse (\w+) (?:\w+ )?rule: '(-+\S+) ([^']*)'"
)
_WRONG_FILE = re.compile(
    r"Couldn't parse params file: '\S+ ([^']*)'\. Error: (.*)"
)


def _in_words(error: str) -> str:
    """Return an error of rcl about the arguments in one line, with the right form of a rule."""
    text = re.sub(r", at \S+:\d+", "", " ".join(error.split()))
    if rule := _WRONG_RULE.search(text):
        form = "FROM:=TO" if rule[1] == "remap" else "NAME:=VALUE"
        return (
            f"cannot read {rule[2]} {rule[3]}: write {rule[2]} {form}; names consist of letters, "
            "digits, _ and /"
        )
    if file := _WRONG_FILE.search(text):
        return (
            f"cannot read the parameter file {file[1]}: {file[2]}; check the path, and compare the "
            "file with config/calibrator.yaml of the package"
        )
    return text


def _run_node(signals: int) -> int:
    """Run the node until the pipe ``signals`` is readable; return the exit code."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    from hand_eye_calib.core.base.errors import HandEyeCalibError
    from hand_eye_calib.core.base.registry import RESULT_PARTS
    from hand_eye_calib.online.live.state import GRACE_S
    from hand_eye_calib.online.ros.calibrator_node import CalibratorNode

    # The multi-threaded executor would lose most messages of two 100 Hz streams.
    executor = SingleThreadedExecutor()
    stopping = threading.Event()

    def wait_for_signal() -> None:
        os.read(signals, 1)
        # executor.wake() does not make spin_once() return, but a task does.
        executor.create_task(stopping.set)

    threading.Thread(
        target=wait_for_signal, name="signals", daemon=True
    ).start()
    node = None
    code = 1
    try:
        node = CalibratorNode()
        executor.add_node(node)
        # Import the modules of results now. At the first result, the import would delay messages by
        # 40 ms.
        for make_part in RESULT_PARTS.values():
            make_part()
        # Exclude all present objects from garbage collection. With them, a collection delays
        # callbacks by 30 ms, and by 250 ms on a slow computer.
        gc.collect()
        gc.freeze()
        # Longest time (s) for which the thread of the journal delays a message.
        sys.setswitchinterval(_PAUSE_S / 8)
        while not stopping.is_set():
            executor.spin_once()
            until_s = time.monotonic() + _MAX_WITHOUT_EXECUTOR_S
            while node.take_messages() and time.monotonic() < until_s:
                time.sleep(_PAUSE_S)
        code = 0
    except HandEyeCalibError as error:
        print(f"calibrator: {error}", file=sys.stderr)
    except Exception:
        traceback.print_exc()
    executor.shutdown()
    if node is not None:
        try:
            code = code if node.stop(GRACE_S) else 1
        except Exception:
            traceback.print_exc()
            code = 1
        node.destroy_node()
    rclpy.try_shutdown()
    return code
