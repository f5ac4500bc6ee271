"""When to stop recording: how far each axis is from its target, how long it still takes, which
motion helps most, and whether this motion gets there at all.

A standard deviation that once falls below the target is no reason to stop: time-correlated errors
have not shown yet in a short recording. The rule was measured on recordings with known truth,
docs/session.md.
"""

from collections.abc import Sequence

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.excitation import Excitation, helpful_motion
from hand_eye_calib.results.calibration import Calibration, DofVerdict, SolveStatus, Verdict
from hand_eye_calib.results.context import AxisProgress, Progress
from hand_eye_calib.results.records import AXES
from hand_eye_calib.results.verdict import what_is_known
from hand_eye_calib.text import axes_in_words, duration

# An axis is known if its standard deviation is below this share of its target ...
_SHARE = 0.7
# ... or what the common-mode floor leaves of it, of the variance at least this share, ...
_LEAST_ROOM = 0.25
# ... at two results in a row, after so many seconds of motion, and so many correlation times of
# time-correlated errors.
_MIN_MOTION_S, _CORRELATION_TIMES = 30.0, 10.0

# Times left (s) that a person is told: they only shrink, by one step at a result. A motion that
# would take longer than the last of them will not get there.
_STEPS_S = np.array([0.0, 15.0, 30.0, 60.0, 120.0, 180.0, 300.0, 600.0, 1200.0, np.inf])

# Standard deviations are estimates too: a result with more motion replaces the best one unless its
# own are larger by more than this factor.
_AS_GOOD = 1.25


class Goal:
    """Judges the results of a session, one after the other.

    Once the goal is reached, it stays reached. Of the results that reach it, the newest is kept,
    but not one that is clearly worse than the best.

    Parameters
    ----------
    targets : (6,) array-like
        Target standard deviations of x, y, z (m), roll, pitch and yaw (rad); the goal is 0.7 of
        each.

    Attributes
    ----------
    best : Calibration or None
        The best result that reaches the goal; None before that.
    progress : Progress
    """

    def __init__(self, targets: Sequence[float] | FloatArray) -> None:
        self._targets = np.asarray(targets, dtype=float)
        self.restart()

    def restart(self) -> None:
        """Begin a new session."""
        self._motion_s, self._was_known = -1.0, False
        self.best: Calibration | None = None
        self._best_information = 0.0
        self._steps = np.full(6, len(_STEPS_S) - 1)
        self.progress = self._nothing_yet("No result yet: move the sensors, with rotations.")

    def wait(self, sentence: str) -> None:
        """Take note that there is no result yet, and why."""
        if self._motion_s < 0:
            self.progress = self._nothing_yet(sentence)

    def add(
        self, calibration: Calibration, seen: Excitation, faults: Sequence[str] = ()
    ) -> Progress:
        """Take the next result of the session.

        Parameters
        ----------
        calibration : Calibration
        seen : Excitation
            The motion that it comes from.
        faults : sequence of str
            What the stream checks found; the goal is not reached while there is something.
        """
        ratios = self._ratios(calibration)
        worst, motion_s = int(np.argmax(ratios)), seen.motion_s
        if not faults:  # errors that the result has of its own, as one of positions or rates
            found = [each for each in calibration.reasons if each.is_finding]
            faults = [one.sentence for one in found if one.verdict is Verdict.DO_NOT_USE]
        may_be_used = calibration.verdict is not Verdict.DO_NOT_USE and not faults
        is_within = calibration.status is SolveStatus.OK and may_be_used and ratios[worst] <= 1.0
        # Below so many seconds of motion, a standard deviation is not believed.
        lasting = calibration.noise.lasting if calibration.noise else ()
        slowest_s = max((each.tau_s for each in lasting if each.kind != "path"), default=0.0)
        least_s = max(_MIN_MOTION_S, _CORRELATION_TIMES * slowest_s)
        is_known, may_end = bool(is_within) and motion_s >= least_s, self.best is not None
        # Every result of a robot that stands still is the same result.
        if motion_s > self._motion_s:
            may_end |= is_known and self._was_known
            self._motion_s, self._was_known = motion_s, is_known
        information = 1.0 / max(ratios[worst], 1e-12)
        if is_within and may_end and information * _AS_GOOD**2 >= self._best_information:
            self.best = calibration
            self._best_information = max(information, self._best_information)
        # Not 0 seconds of motion: an axis that was not seen at all takes for ever, not "nan".
        left_s = max(motion_s, 1e-6) * np.maximum(ratios - 1.0, 0.0)
        left_s = np.maximum(left_s, max(least_s - motion_s, 0.0))
        is_done = self.best is not None
        stuck = not is_done and motion_s >= _MIN_MOTION_S and left_s[worst] > _STEPS_S[-2]
        left_s = self._told(left_s)
        known = self._ended(calibration, faults)
        behind = AXES[worst] if stuck or ratios[worst] > 1.0 else ""
        self.progress = Progress(
            sentence=known or _way_on(behind, left_s[worst], bool(stuck), seen),
            done=is_done and not faults,
            is_faulty=bool(faults),
            limiting_axis="" if is_done else AXES[worst],
            will_not_get_there=bool(stuck),
            axes=self._by_axis(calibration.sigmas_with_floor, np.zeros(6) if is_done else left_s),
        )
        return self.progress

    def _ratios(self, calibration: Calibration) -> FloatArray:
        """Variances (6,) over what the common-mode floor leaves of the targets: a floor above them
        cannot be driven away.
        """
        wanted = _SHARE * self._targets
        room = np.maximum(wanted**2 - calibration.sigmas_of_floor**2, _LEAST_ROOM * wanted**2)
        # What somebody measured by hand, no motion would tell better; some streams never show all.
        exempt = np.isin(AXES, calibration.out_of_reach)
        exempt |= [dof.verdict is DofVerdict.PRIOR for dof in calibration.observability]
        return np.asarray(np.where(exempt, 0.0, calibration.sigmas**2 / room))

    def _told(self, left_s: FloatArray) -> FloatArray:
        """The steps (6,) that are told of these times: estimates jump, and a person who is told 4
        min, 5 s, 25 s believes none of them.
        """
        steps, before = np.searchsorted(_STEPS_S, 0.95 * left_s), self._steps
        far = len(_STEPS_S) - 1
        is_new = (before == far) | (before == 0) | (steps == far) | (steps == 0)
        self._steps = np.where(is_new, steps, np.clip(steps, before - 1, before))
        return np.asarray(_STEPS_S[self._steps])

    def _nothing_yet(self, sentence: str) -> Progress:
        unknown = np.full(6, np.inf)
        return Progress(sentence=sentence, axes=self._by_axis(unknown, unknown))

    def _by_axis(self, sigmas: FloatArray, left_s: FloatArray) -> dict[str, AxisProgress]:
        columns = zip(AXES, sigmas.tolist(), self._targets.tolist(), left_s.tolist(), strict=True)
        return {
            axis: AxisProgress(sigma=sigma, target=target, seconds_left=seconds)
            for axis, sigma, target, seconds in columns
        }

    def _ended(self, calibration: Calibration, faults: Sequence[str]) -> str:
        """What to do if more motion would not help, or is not needed; empty if it is."""
        if faults:
            return f"Stop: the streams are faulty: {faults[0]}."
        if calibration.status.failure:
            return f"No usable result: {calibration.status.failure}."
        if self.best is not None:
            return f"Done: {what_is_known(self.best)}. Stop and save."
        return ""


def _way_on(axis: str, left_s: float, is_stuck: bool, seen: Excitation) -> str:
    """Which motion helps most, for the axis that takes longest; there may be none."""
    left = duration(np.clip(left_s, _STEPS_S[1], _STEPS_S[-2]))
    if not axis:
        return f"Go on for about {left}: every axis is good enough if the next results agree."
    motion, called = helpful_motion([axis], seen), axes_in_words([axis])
    if is_stuck:
        return f"This motion will not determine {called} well enough: {motion}."
    if not np.isfinite(left_s):
        return f"{called} is not determined yet: {motion}."
    return f"Go on for about {left}: {called} takes longest, {motion}."
