"""The process that writes ``report.html`` of a session of the node: it reads the result from
standard input, as ``ros/report_process.py`` writes it.
"""

import os
import pickle
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.cli.console import fail
from hand_eye_calib.errors import HandEyeCalibError

if TYPE_CHECKING:
    from hand_eye_calib.ros.report_process import SessionResult

# Every other program goes first.
_NICENESS = 15


def main() -> None:
    """Write the report into the directory that is the only argument."""
    os.nice(_NICENESS)
    result: SessionResult = pickle.load(sys.stdin.buffer)
    try:
        write(Path(sys.argv[1]), result)
    except HandEyeCalibError as error:
        sys.exit(fail(error, 1))


def write(directory: Path, result: "SessionResult") -> None:
    """Check the streams, cross-check the result, and write the page, if it comes from poses.

    Raises
    ------
    HandEyeCalibError
        If it cannot be written.
    """
    from hand_eye_calib.cli.findings import with_findings
    from hand_eye_calib.cli.reporting import with_cross_check, write_report

    if result.calibration.measured != "poses":
        return  # the figures are of poses
    calibration, _ = with_findings(result.calibration, result.snapshot)
    calibration, evidence = with_cross_check(calibration, result.snapshot)
    config, inputs = result.snapshot.config, result.inputs
    write_report(directory, calibration, evidence, config, inputs)
