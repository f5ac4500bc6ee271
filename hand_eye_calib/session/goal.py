"""When to stop recording: how far each axis is from its target, how long it still takes, which
motion helps most, and whether this motion gets there at all.

A standard deviation that once falls below the target is no reason to stop: time-correlated errors
have not shown yet in a short recording. The rule was measured on recordings with known truth,
docs/session.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass

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
# ... or what the allowance leaves of it, of the variance at least this share, ...
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

_NO_RESULT = "No result yet: move the sensors, with rotations."


@dataclass(frozen=True)
class _Judged:
    """A result of the session, the motion it comes from, and whether its streams were faulty."""

    calibration: Calibration
    seen: Excitation
    faults: tuple[str, ...]


class Goal:
    """Judges the results of a session, one after the other.

    Once the goal is reached, it stays reached, unless a result is refuted or the options change. Of
    the results that reach it, the newest is kept, but not one that is clearly worse than the best.

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
        # The newest result, and the newest of those from less motion.
        self._newest: _Judged | None = None
        self._before: _Judged | None = None
        self._motion_s = -1.0
        self._start_over(_NO_RESULT)

    def _start_over(self, sentence: str) -> None:
        """Forget that the goal was reached, but not the results."""
        self.best: Calibration | None = None
        self._best_information = 0.0
        self._steps = np.full(6, len(_STEPS_S) - 1)
        self.progress = self._nothing_yet(sentence)

    def wait(self, sentence: str) -> None:
        """Take note that there is no result yet, and why."""
        if self._newest is None:
            self.progress = self._nothing_yet(sentence)

    def follow(self, targets: Sequence[float] | FloatArray) -> None:
        """Start over with these targets, because options have changed.

        Earlier results still confirm the next one: a robot may be parked by now.
        """
        self._targets = np.asarray(targets, dtype=float)
        if self._newest is not None:
            self._start_over("Solving with the new options.")
        else:
            self._start_over(_NO_RESULT)

    def retarget(self, calibration: Calibration, targets: Sequence[float] | FloatArray) -> Progress:
        """Judge the session's result again, because the targets, and nothing else, have changed.

        Parameters
        ----------
        calibration : Calibration
            The result with the new targets.
        targets : (6,) array-like
        """
        self.follow(targets)
        if self._newest is None:
            return self.progress
        return self.add(calibration, self._newest.seen, self._newest.faults)

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
        if not faults:  # errors that the result has of its own, as one of positions or rates
            findings = [reason for reason in calibration.reasons if reason.is_finding]
            errors = [each for each in findings if each.verdict is Verdict.DO_NOT_USE]
            faults = [error.sentence for error in errors]
        # Every result of a robot that stands still is the same result.
        if seen.motion_s > self._motion_s:
            self._before = self._newest
            self._motion_s = seen.motion_s
        self._newest = _Judged(calibration, seen, tuple(faults))
        if calibration.status is SolveStatus.CONTRADICTED:
            self._start_over(f"No usable result: {calibration.status.failure}.")
            return self.progress
        ratios = self._ratios(calibration, calibration)
        worst, motion_s = int(np.argmax(ratios)), seen.motion_s
        may_be_used = calibration.verdict is not Verdict.DO_NOT_USE and not faults
        is_within = calibration.status is SolveStatus.OK and may_be_used and ratios[worst] <= 1.0
        least_s = _least_motion_s(calibration)
        is_known = is_within and motion_s >= least_s
        may_end = self.best is not None or (is_known and self._is_confirmed(calibration))
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
            axes=self._by_axis(calibration.sigmas, np.zeros(6) if is_done else left_s),
        )
        return self.progress

    def _is_confirmed(self, newest: Calibration) -> bool:
        """Whether the result before, from less motion, reaches the goal as the newest one does.

        Options may have changed in between: allowance and priors are those of the newest result.
        """
        before = self._before
        if before is None or before.faults:
            return False
        if before.calibration.status is SolveStatus.NOT_CONVERGED:
            return False
        is_long = before.seen.motion_s >= _least_motion_s(before.calibration)
        return bool(is_long and self._ratios(before.calibration, newest).max() <= 1.0)

    def _ratios(self, calibration: Calibration, newest: Calibration) -> FloatArray:
        """Measured variances (6,) over what the allowance leaves of the targets: an allowance above
        them cannot be driven away. Allowance and priors are those of the newest result.
        """
        wanted = _SHARE * self._targets
        room = np.maximum(wanted**2 - newest.allowance**2, _LEAST_ROOM * wanted**2)
        # What somebody measured by hand, no motion would tell better; some streams never show all.
        exempt = np.isin(AXES, newest.out_of_reach)
        exempt |= [dof.verdict is DofVerdict.PRIOR for dof in newest.observability]
        return np.asarray(np.where(exempt, 0.0, calibration.sigmas_measured**2 / room))

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


def _least_motion_s(calibration: Calibration) -> float:
    """Seconds of motion below which a standard deviation is not believed."""
    lasting = calibration.noise.lasting if calibration.noise else ()
    slowest_s = max((error.tau_s for error in lasting if error.kind != "path"), default=0.0)
    return max(_MIN_MOTION_S, _CORRELATION_TIMES * slowest_s)


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
