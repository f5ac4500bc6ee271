"""Starts the process that writes the report of a session and solves for all sensors of a rig."""

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.results.calibration import Calibration

_COMMAND = "from hand_eye_calib.cli.reporting import write_session; write_session()"


@dataclass(frozen=True)
class SessionResult:
    """A result of the node, the poses that gave it, and where these came from; whether a report is
    wanted, and the poses of further child sensors, each with those of the parent.
    """

    calibration: Calibration
    snapshot: Snapshot
    inputs: Mapping[str, Any]
    with_report: bool = True
    others: Mapping[str, Snapshot] = field(default_factory=dict)

    @property
    def files(self) -> str:
        """What is written, in words."""
        return " and ".join(["report.html"] * self.with_report + ["rig/"] * bool(self.others))

    @property
    def what_follows(self) -> str:
        """The same as a sentence."""
        return f"{self.files} follow" + "s" * (" and " not in self.files)


class ReportProcess:
    """Writes reports in a process that outlives the node, one at a time: the newest counts."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._answer: IO[bytes] | None = None

    def write(self, directory: Path, result: SessionResult) -> None:
        """Start to write ``report.html`` into a directory; takes milliseconds.

        The result is handed over in a file that has no name: nobody else can change it, and no
        pipe has to be waited for at the end of the node.

        Raises
        ------
        OSError
            If the temporary directory is full, or no process can be started.
        """
        self._end_earlier()
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        answer = tempfile.TemporaryFile() if result.others else None  # noqa: SIM115
        with tempfile.TemporaryFile() as file:
            pickle.dump(result, file, pickle.HIGHEST_PROTOCOL)
            file.seek(0)
            # In a group of its own, which Ctrl-C in the terminal leaves alone.
            self._process = subprocess.Popen(
                [sys.executable, "-c", _COMMAND, str(directory.resolve())],
                stdin=file,
                stdout=answer or subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": path},
                process_group=0,
            )
        self._answer = answer

    def take_others(self) -> list[Calibration]:
        """Results of further child sensors in their order, once, when they are there."""
        if self._answer is None or self._process is None or self._process.poll() is None:
            return []
        with self._answer as answer:
            self._answer = None
            answer.seek(0)
            found: list[Calibration] = pickle.load(answer) if self._process.returncode == 0 else []
            return found

    def forget(self) -> None:
        """A new session has begun: results of the one before are of no use."""
        self._answer = None

    def _end_earlier(self) -> None:
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
            self._process.wait()
        self._process = self._answer = None
