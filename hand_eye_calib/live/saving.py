"""Saves the session's result: files at once, report and rig by a process of their own."""

import pickle
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

from hand_eye_calib.config import NodeConfig
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.io.results import keep_earlier_results, save_result
from hand_eye_calib.live.cycle import SolveCycle
from hand_eye_calib.live.log import NodeLog
from hand_eye_calib.live.processes import start
from hand_eye_calib.live.session import LiveSession, output_path
from hand_eye_calib.live.state import SavedState
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.text import listing

_REPORT = "from hand_eye_calib.cli.reporting import write_session; write_session()"


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


class Saver:
    """Saves results; those of an earlier session in the same directory are kept once. The process
    that writes report and rig outlives the node; there is one at a time, as the newest counts.
    ``state`` is the newest save of this session.
    """

    def __init__(self, session: LiveSession, cycle: SolveCycle, log: NodeLog) -> None:
        self._session, self._cycle, self._log = session, cycle, log
        self._earlier_kept_in = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._answer: IO[bytes] | None = None
        self.state: SavedState | None = None

    def restart(self) -> None:
        """Begin a new session: results of the one before are of no use."""
        self._answer = self.state = None

    def save(self, options: NodeConfig) -> tuple[bool, str]:
        """Write the result files; whether that worked, and one line about it, which is logged."""
        saved, text = self._save(options)
        (self._log.info if saved else self._log.warning)(text)
        return saved, text

    def _save(self, options: NodeConfig) -> tuple[bool, str]:
        directory = options.output_directory
        result, snapshot = self._cycle.result, self._cycle.snapshot
        if not directory:
            return False, "nowhere to save to: set the parameter output_directory to a directory"
        if result is None or snapshot is None:
            return False, "nothing to save: there is no result yet"
        # A check may have been certain of other options.
        inputs = self._session.inputs() | {"options": snapshot.config.to_options()}
        result = replace(result, goal=self._cycle.goal.progress)
        try:
            path = output_path(directory)
            if self._earlier_kept_in != directory:
                keep_earlier_results(path)
            self._earlier_kept_in = directory
            if self._process is not None:  # it writes the result too, an older one
                self._process.kill()
                self._process.wait()
            save_result(result, path, inputs)
        except (OSError, HandEyeCalibError) as error:
            return False, f"cannot save to {directory}: {error}"
        where = str(path.resolve())
        text = f"result saved to {where}: {result.headline}"
        self.state = SavedState(directory=where, at_s=time.time(), text=result.headline)
        others = {name: each.snapshot() for name, each in self._session.others.items()}
        if not (options.report or others):
            return True, text
        session = SessionResult(result, snapshot, inputs, options.report, others)
        return True, f"{text}; {self._write(path, session)}"

    def _write(self, directory: Path, result: SessionResult) -> str:
        """Start to write report and rig, which takes milliseconds; returns a sentence about that.

        The result is handed over in a file that has no name: nobody else can change it, and no
        pipe has to be waited for at the end of the node.
        """
        files = ["report.html"] * result.with_report + ["rig/"] * bool(result.others)
        self._process = self._answer = None
        try:
            answer = tempfile.TemporaryFile()  # noqa: SIM115
            with tempfile.TemporaryFile() as file:
                pickle.dump(result, file, pickle.HIGHEST_PROTOCOL)
                file.seek(0)
                where = str(directory.resolve())
                self._process = start(_REPORT, where, stdin=file, stdout=answer)
        except OSError as error:  # a full temporary directory, or no process can be started
            return f"{listing(files)} cannot be written: {error.strerror}"
        self._answer = answer
        return f"{listing(files)} follow{'s' * (len(files) == 1)}"

    def take_others(self) -> Sequence[Calibration]:
        """New results of further child sensors, in their order, once."""
        if self._answer is None or self._process is None or self._process.poll() is None:
            return ()
        with self._answer as answer:
            self._answer = None
            answer.seek(0)
            done = self._process.returncode == 0 and bool(self._session.others)
            found: list[Calibration] = pickle.load(answer) if done else []
            return found
