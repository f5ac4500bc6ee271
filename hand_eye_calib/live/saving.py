"""Saves the session's result: files at once, report and rig by a process of their own."""

import time
from collections.abc import Sequence
from dataclasses import replace

from hand_eye_calib.config import NodeConfig
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.io.results import keep_earlier_results, save_result
from hand_eye_calib.live.cycle import SolveCycle
from hand_eye_calib.live.log import NodeLog
from hand_eye_calib.live.processes import ReportProcess, SessionResult
from hand_eye_calib.live.session import LiveSession, output_path
from hand_eye_calib.live.state import SavedState
from hand_eye_calib.results.calibration import Calibration


class Saver:
    """Saves results; those of an earlier session in the same directory are kept once.

    Parameters
    ----------
    session : LiveSession
    cycle : SolveCycle
    log : NodeLog

    Attributes
    ----------
    state : SavedState or None
        The newest save of this session.
    """

    def __init__(self, session: LiveSession, cycle: SolveCycle, log: NodeLog) -> None:
        self._session, self._cycle, self._log = session, cycle, log
        self._report = ReportProcess()
        self._earlier_kept_in = ""
        self.state: SavedState | None = None

    def save(self, options: NodeConfig) -> tuple[bool, str]:
        """Write the result files; whether that worked, and one line about it, which is logged."""
        saved, text = self._save(options)
        (self._log.info if saved else self._log.warning)(text)
        return saved, text

    def take_others(self) -> Sequence[Calibration]:
        """New results of further child sensors, in their order."""
        return self._report.take_others()

    def restart(self) -> None:
        """Begin a new session."""
        self._report.forget()
        self.state = None

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
            self._report.stop()  # it writes the result too, an older one
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
        return True, f"{text}; {self._report.write(path, session)}"
