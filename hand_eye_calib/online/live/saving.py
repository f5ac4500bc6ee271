"""Save the result of the session: data files at once, report and rig in a separate process."""

import pickle
import subprocess
import tempfile
import time

from hand_eye_calib.core.base.config import NodeConfig
from hand_eye_calib.core.base.errors import (
    ConfigError,
    HandEyeCalibError,
    NotEnoughDataError,
)
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.engine.session_result import SessionResult
from hand_eye_calib.formats.results import keep_earlier_results, save_result
from hand_eye_calib.online.live.cycle import SolveCycle
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.session import LiveSession, output_path
from hand_eye_calib.online.live.solving import start
from hand_eye_calib.online.live.state import Outcome, SavedState, Standing

_PAGES = "from hand_eye_calib.online.live.pages import write_session; write_session()"


class Saver:
    """Save the result of the session.

    Before the first save into a directory, the files of an earlier session are kept aside. The
    process for report and rig may run longer than the node. A newer save kills this process,
    because only the newest result is of use.

    Attributes
    ----------
    state : SavedState or None
        Newest save of this session.
    """

    def __init__(
        self, session: LiveSession, cycle: SolveCycle, log: NodeLog
    ) -> None:
        self.state: SavedState | None = None
        self._session = session
        self._cycle = cycle
        self._log = log
        # Directory whose earlier results are already kept aside.
        self._earlier_kept_in = ""
        self._process: subprocess.Popen[bytes] | None = None

    def save(self, options: NodeConfig) -> Outcome:
        """Write the result files. Return the success, and a line of text that is also logged."""
        try:
            text = self._save(options)
        except (OSError, HandEyeCalibError) as error:
            text = f"cannot save: {error}"
            self._log.warning(text)
            return False, text
        self._log.info(text)
        return True, text

    def _save(self, options: NodeConfig) -> str:
        """Write the result files, start the process for the pages, and return a line of text.

        Raises
        ------
        ConfigError
            If there is no output directory.
        NotEnoughDataError
            If there is no result.
        OSError
            If a file cannot be written.
        """
        directory = options.output_directory
        if not directory:
            raise ConfigError(
                "set the parameter output_directory to a directory"
            )
        result = self._cycle.result_to_save()
        snapshot = self._cycle.snapshot()
        if result is None or snapshot is None:
            raise NotEnoughDataError("there is no result yet")
        result = result.with_part("goal", self._cycle.goal.progress)
        inputs = self._session.calibrator.inputs(self._session.topics)
        # Options of the result, including those that a check has set.
        inputs["options"] = snapshot.config.to_options()
        path = output_path(directory)
        if self._earlier_kept_in != directory:
            keep_earlier_results(path)
        self._earlier_kept_in = directory
        # Kill the process of an earlier save, because it writes an older result.
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        save_result(result, path, inputs)
        where = str(path.resolve())
        text = result.headline
        if self._cycle.standing is Standing.OUTDATED:
            text = f"{text}; {self._cycle.problem}"
        verdict = result.verdict.value
        self.state = SavedState(
            directory=where, at_s=time.time(), text=text, verdict=verdict
        )
        text = f"result saved to {where}: {text}"
        engines = self._session.engines
        others = {
            name: engine.snapshot()
            for name, engine in engines.items()
            if name != "child"
        }
        files = ["report.html"] if options.report else []
        if others:
            files.append("rig/")
        if not files:
            return text
        session = SessionResult(
            result, snapshot, inputs, options.report, others
        )
        return f"{text}; {self._write_pages(where, session, listing(files))}"

    def _write_pages(
        self, directory: str, session: SessionResult, files: str
    ) -> str:
        """Start the process for report and rig. Return a sentence about its files.

        The start takes milliseconds. The process reads the result from an unnamed file. No other
        program can change this file, and the node can end without waiting for a pipe.
        """
        self._process = None
        try:
            with tempfile.TemporaryFile() as file:
                pickle.dump(session, file, pickle.HIGHEST_PROTOCOL)
                file.seek(0)
                self._process = start(
                    _PAGES, directory, stdin=file, stdout=subprocess.DEVNULL
                )
        # The temporary directory is full, or no process can be started.
        except OSError as error:
            return f"{files} cannot be written: {error.strerror}"
        return f"{files} follow" if " and " in files else f"{files} follows"
