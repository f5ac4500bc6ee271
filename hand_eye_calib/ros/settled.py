"""Whether a result has settled: only then it is broadcast to the robot's TF tree."""

from collections import deque

import numpy as np

from hand_eye_calib.calibration import Calibration, DofVerdict, SolveStatus, Verdict
from hand_eye_calib.geometry import se3

# So many results in a row must agree, over so much of the recording (s).
RESULTS, SPAN_S = 5, 10.0

# They agree if none lies farther from the newest than so many of its own standard deviations, along
# and about any axis ...
SIGMAS = 1.0
# ... or than this (m, rad), which no robot notices: noise-free streams have no sigma.
_NOTHING = 1e-5

_KNOWN = (DofVerdict.OBSERVED, DofVerdict.PRIOR)


class SettledRule:
    """A result has settled if all six degrees of freedom are observed (or come from a prior), none
    of them weakly, no stream check speaks against it, and the last five results over at least ten
    seconds agree within one standard deviation.
    """

    def __init__(self) -> None:
        self._results: deque[Calibration] = deque(maxlen=RESULTS)

    def restart(self) -> None:
        """Begin a new session."""
        self._results.clear()

    def add(self, calibration: Calibration) -> None:
        """Take the next result."""
        self._results.append(calibration)

    def what_is_missing(self, faults: tuple[str, ...] = ()) -> str:
        """Why the newest result has not settled; empty if it has.

        Parameters
        ----------
        faults : tuple of str
            Findings of the stream checks.
        """
        if not self._results:
            return "no result yet"
        newest = self._results[-1]
        if faults:
            return f"the streams are faulty: {faults[0]}"
        if unknown := what_is_unknown(newest):
            return unknown
        span_s = (newest.stamp_ns - self._results[0].stamp_ns) * 1e-9
        if len(self._results) < RESULTS or span_s < SPAN_S:
            found = f"{len(self._results)} results over {span_s:.0f} s"
            return f"{found}, it takes {RESULTS} over {SPAN_S:g} s"
        if not all(_agree(earlier, newest) for earlier in self._results):
            return f"the last {RESULTS} results differ by more than their standard deviations"
        return ""


def what_is_unknown(calibration: Calibration) -> str:
    """What a result lacks to be broadcast, looked at alone; empty if nothing."""
    if calibration.status is not SolveStatus.OK:
        return f"the result is {calibration.status.value}"
    if calibration.verdict is Verdict.DO_NOT_USE:
        return calibration.headline
    weak = [dof.name for dof in calibration.observability if dof.verdict not in _KNOWN]
    return f"{', '.join(weak)} only weakly observable" if weak else ""


def _agree(earlier: Calibration, newest: Calibration) -> bool:
    error = se3.log(se3.inverse(earlier.T_parent_child) @ newest.T_parent_child)
    sigmas = np.sqrt(np.diag(earlier.covariance))
    return bool(np.all(np.abs(error) <= np.maximum(SIGMAS * sigmas, _NOTHING)))
