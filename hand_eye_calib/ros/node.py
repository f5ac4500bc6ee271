"""Entry point of the node ``calibrator``."""

import os
import signal
import sys

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM.

    Parameters
    ----------
    args : list of str, optional
        Arguments without the program's name; the process's own by default.

    Returns
    -------
    int
        Exit code: 0 stopped by a signal; 1 bad parameter, failure, or a result that could not be
        saved (reported on stderr); 2 wrong usage.
    """
    signals = _signal_pipe()
    # Imported this late so that Ctrl-C while numpy, scipy and rclpy load ends the program quietly
    # too.
    from hand_eye_calib.ros.running import run

    code = run(sys.argv[1:] if args is None else args, signals)
    # The interpreter's own clean-up would restore the defaults, and a late Ctrl-C change the exit
    # code.
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    return code


def _signal_pipe() -> int:
    """File descriptor that becomes readable on SIGINT or SIGTERM.

    The signals do nothing else: no KeyboardInterrupt in the middle of a callback, no context that
    rclpy shuts down while a callback still publishes, and a second Ctrl-C changes nothing.
    """
    readable, writable = os.pipe()
    os.set_blocking(writable, False)
    signal.set_wakeup_fd(writable, warn_on_full_buffer=False)
    for number in STOP_SIGNALS:
        signal.signal(number, lambda *_: None)
    return readable
