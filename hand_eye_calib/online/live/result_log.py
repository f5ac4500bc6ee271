"""Lines of the log about the results and failures of solves."""

from hand_eye_calib.core.base.spelling import Interface
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.online.live.describing import describe
from hand_eye_calib.online.live.log import GOES_ON_S, ONCE_S, NodeLog
from hand_eye_calib.online.live.progress import Progress
from hand_eye_calib.online.live.solving import Failure


class ResultLog:
    """Log the results and failures of a session, and return them as text."""

    def __init__(self, log: NodeLog) -> None:
        self._log = log
        self.restart()

    def restart(self) -> None:
        """Begin a new session."""
        # Reasons for a verdict that were logged as warnings: their sentences, by rule.
        self._warned: dict[str, str] = {}

    def result(
        self,
        calibration: Calibration,
        progress: Progress,
        every_s: float = GOES_ON_S,
    ) -> str:
        """Return a line about a calibration, with reasons and warnings. Log what is new.

        While more motion helps, the progress names the next action. Therefore the reasons for the
        verdict are logged only if more motion does not help.

        Parameters
        ----------
        calibration : Calibration
        progress : Progress
            Progress after this calibration.
        every_s : float
            Shortest time (s) between two lines in the log.
        """
        texts = [describe(calibration)]
        self._log.info(texts[0], every_s, key="result")
        is_final = (
            progress.done
            or progress.will_not_get_there
            or calibration.status.failure
        )
        for reason in calibration.reasons:
            text = f"{reason.sentence}; {reason.advice_on(Interface.NODE)}"
            texts.append(text)
            # The stream checks have already logged the findings.
            if is_final and not reason.is_finding:
                self._log.warning(f"{reason.verdict.value}: {text}")
                self._warned[reason.rule] = reason.sentence
        rules = {reason.rule for reason in calibration.reasons}
        for rule in self._warned.keys() - rules:
            self._log.info(f"no longer found: {self._warned.pop(rule)}")
        return "; ".join((*texts, *calibration.warnings))

    def failure(self, failure: Failure) -> str:
        """Log a failure and return its text."""
        if failure.details:
            text = f"the solve failed unexpectedly: {failure.what}"
            self._log.error(f"{text}\n{failure.details}")
            return f"{text}; see the log"
        if failure.is_early:
            self._log.info(f"cannot solve yet: {failure.what}", ONCE_S)
        else:
            self._log.warning(f"cannot solve: {failure.what}")
        return failure.what
