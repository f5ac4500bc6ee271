"""Saves the session's result: files at once, report and rig by a process of their own."""

import pickle
import subprocess
import tempfile
import time
from collections.abc import Sequence

from hand_eye_calib.core.base.config import NodeConfig
from hand_eye_calib.core.base.errors import ConfigError, HandEyeCalibError, NotEnoughDataError
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.engine.session_result import SessionResult
from hand_eye_calib.formats.results import keep_earlier_results, save_result
from hand_eye_calib.online.live.cycle import SolveCycle
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.session import LiveSession, output_path
from hand_eye_calib.online.live.solving import start
from hand_eye_calib.online.live.state import SavedState, Standing

_REPORT = "from hand_eye_calib.online.live.pages import write_session; write_session()"


class Saver:
    """Saves results; those of an earlier session in the same directory are kept once. The process
    that writes report and rig outlives the node; there is one at a time, as the newest counts.
    ``state`` is the newest save of this session.
    """

    def __init__(self, session: LiveSession, cycle: SolveCycle, log: NodeLog) -> None:
        self._session = session
        self._cycle = cycle
        self._log = log
        self._earlier_kept_in = ""
        self._process: subprocess.Popen[bytes] | None = None
        self.state: SavedState | None = None

    def save(self, options: NodeConfig) -> tuple[bool, str]:
        """Write the result files; whether that worked, and one line about it, which is logged."""
        try:
            text = self._save(options)
        except (OSError, HandEyeCalibError) as error:
            text = f"cannot save: {error}"
            self._log.warning(text)
            return False, text
        self._log.info(text)
        return True, text

    def _save(self, options: NodeConfig) -> str:
        directory = options.output_directory
        result = self._cycle.result_to_save()
        snapshot = self._cycle.snapshot()
        if not directory:
            raise ConfigError("set the parameter output_directory to a directory")
        if result is None or snapshot is None:
            raise NotEnoughDataError("there is no result yet")
        # A check may have been certain of other options.
        inputs = self._session.calibrator.inputs(self._session.topics)
        inputs |= {"options": snapshot.config.to_options()}
        result = result.with_part("goal", self._cycle.goal.progress)
        path = output_path(directory)
        if self._earlier_kept_in != directory:
            keep_earlier_results(path)
        self._earlier_kept_in = directory
        if self._process is not None:  # it writes the result too, an older one
            self._process.kill()
            self._process.wait()
        save_result(result, path, inputs)
        where = str(path.resolve())
        said = result.headline
        if self._cycle.standing is Standing.OUTDATED:
            said = f"{said}; {self._cycle.problem}"
        text = f"result saved to {where}: {said}"
        verdict = result.verdict.value
        self.state = SavedState(directory=where, at_s=time.time(), text=said, verdict=verdict)
        engines = self._session.engines
        others = {name: each.snapshot() for name, each in engines.items() if name != "child"}
        session = SessionResult(result, snapshot, inputs, options.report, others)
        files = ["report.html"] * options.report + ["rig/"] * bool(others)
        return f"{text}; {self._write(where, session, files)}" if files else text

    def _write(self, directory: str, result: SessionResult, files: Sequence[str]) -> str:
        """Start to write report and rig, which takes milliseconds; returns a sentence about that.

        The result is handed over in a file that has no name: nobody else can change it, and no
        pipe has to be waited for at the end of the node.
        """
        self._process = None
        try:
            with tempfile.TemporaryFile() as file:
                pickle.dump(result, file, pickle.HIGHEST_PROTOCOL)
                file.seek(0)
                self._process = start(_REPORT, directory, stdin=file, stdout=subprocess.DEVNULL)
        except OSError as error:  # a full temporary directory, or no process can be started
            return f"{listing(files)} cannot be written: {error.strerror}"
        return f"{listing(files)} follow{'s' * (len(files) == 1)}"
