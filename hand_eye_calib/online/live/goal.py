"""Progress of a recording session.

It has the distance to the target on each axis, the time left, the most helpful motion, and whether
the present motion can reach the target.

A single standard deviation below the target is no reason to stop, because a short recording does
not contain the time-correlated errors yet. The rule was tuned on recordings with known truth, see
docs/session.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.excitation import Excitation, helpful_motion
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.text import axes_in_words, duration
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict, SolveStatus, Verdict
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.core.results.verdict import what_is_known
from hand_eye_calib.online.live.progress import AxisProgress, Progress

# Share of its target that the standard deviation of an axis must reach, allowance included.
_SHARE = 0.7
# Least share of the wanted variance that remains for the measured variance if the allowance takes
# the rest.
_LEAST_ROOM = 0.25
# Least duration of motion (s) of the two results in a row that must reach the target.
_MIN_MOTION_S = 30.0
# Least duration in correlation times of the slowest time-correlated error.
_CORRELATION_TIMES = 10.0

# Times left that are reported (s). They only decrease, by one step for each result. Beyond the last
# finite step, the present motion cannot reach the target.
_STEPS_S = np.array([0.0, 15.0, 30.0, 60.0, 120.0, 180.0, 300.0, 600.0, 1200.0, np.inf])

# Largest ratio of standard deviations at which a newer result replaces the best result: standard
# deviations are estimates, and the newer result has more motion.
_AS_GOOD = 1.25

# Target standard deviations of x, y, z (m), roll, pitch and yaw (rad).
Targets: TypeAlias = Sequence[float] | FloatArray

_NO_RESULT = "No result yet: move the sensors, with rotations."


@dataclass(frozen=True)
class _Result:
    """Result of the session, its motion, and the faults of its streams."""

    calibration: Calibration
    motion: Excitation
    faults: Sequence[str]

    @property
    def is_long(self) -> bool:
        """Whether the motion is long enough to trust the standard deviations."""
        return self.motion.motion_s >= _least_motion_s(self.calibration)


class Goal:
    """Goal of a session, compared with each new result.

    Once the goal is reached, it stays reached, unless a result is refuted or the options change.
    ``best`` is the newest result that reaches the goal, unless an earlier result is clearly
    better.

    Parameters
    ----------
    targets : (6,) array-like
        Target standard deviations of x, y, z (m), roll, pitch and yaw (rad). The goal is 0.7 of
        each target.

    Attributes
    ----------
    best : Calibration or None
        Best result that reaches the goal; None before the goal is reached.
    progress : Progress
    """

    def __init__(self, targets: Targets) -> None:
        self._targets = np.asarray(targets, dtype=float)
        self.restart()

    def restart(self) -> None:
        """Begin a new session."""
        # The newest result, and the newest result with less motion.
        self._newest: _Result | None = None
        self._before: _Result | None = None
        self._motion_s = -1.0
        self._start_over(_NO_RESULT)

    def _start_over(self, sentence: str) -> None:
        """Forget the progress towards the goal; the newest and the previous result stay."""
        self.best: Calibration | None = None
        self._best_information = 0.0
        self._steps = np.full(6, len(_STEPS_S) - 1)
        self.progress = self._nothing_yet(sentence)

    def wait(self, sentence: str) -> None:
        """Store the reason why there is no result yet; ignored once there is a result."""
        if self._newest is None:
            self.progress = self._nothing_yet(sentence)

    def follow(self, targets: Targets) -> None:
        """Start over with these targets, because options have changed.

        Earlier results still confirm the next result, because the robot may be parked by now.
        """
        self._targets = np.asarray(targets, dtype=float)
        self._start_over("Solving with the new options." if self._newest else _NO_RESULT)

    def retarget(self, calibration: Calibration, targets: Targets) -> None:
        """Compare the session's result with new targets; no other option has changed.

        Parameters
        ----------
        calibration : Calibration
            The result with the new targets.
        targets : (6,) array-like
        """
        self.follow(targets)
        if self._newest is not None:
            self.add(calibration, self._newest.motion, self._newest.faults)

    def add(
        self, calibration: Calibration, motion: Excitation, faults: Sequence[str] = ()
    ) -> Progress:
        """Add the next result of the session and update ``best`` and ``progress``.

        Parameters
        ----------
        calibration : Calibration
        motion : Excitation
            The motion of the result.
        faults : sequence of str
            Findings of the stream checks. The goal is not reached while there are any.
        """
        newest = _Result(calibration, motion, faults or _own_faults(calibration))
        # Without more motion a result cannot confirm the previous result: the robot is parked.
        if motion.motion_s > self._motion_s:
            self._before = self._newest
            self._motion_s = motion.motion_s
        self._newest = newest
        if calibration.status is SolveStatus.CONTRADICTED:
            self._start_over(f"No usable result: {calibration.status.failure}.")
            return self.progress
        ratios = self._ratios(calibration, calibration)
        worst = int(np.argmax(ratios))
        self._update_best(newest, ratios[worst])
        is_done = self.best is not None
        left_s = _time_left(newest, ratios)
        is_long = motion.motion_s >= _MIN_MOTION_S
        is_stuck = bool(not is_done and is_long and left_s[worst] > _STEPS_S[-2])
        left_s = self._in_steps(left_s)
        sentence = self._reason_to_stop(newest)
        if not sentence:
            limiting = AXES[worst] if is_stuck or ratios[worst] > 1.0 else ""
            sentence = _advice(limiting, left_s[worst], is_stuck, motion)
        self.progress = Progress(
            sentence=sentence,
            done=is_done and not newest.faults,
            precision=what_is_known(self.best) if self.best else "",
            is_faulty=bool(newest.faults),
            limiting_axis="" if is_done else AXES[worst],
            will_not_get_there=is_stuck,
            axes=self._by_axis(calibration.sigmas, np.zeros(6) if is_done else left_s),
        )
        return self.progress

    def _update_best(self, newest: _Result, ratio: float) -> None:
        """Make the newest result the best result if it reaches the goal and is not clearly worse.

        Parameters
        ----------
        newest : _Result
        ratio : float
            Largest ratio of :meth:`_ratios`.
        """
        calibration = newest.calibration
        if calibration.status is not SolveStatus.OK or newest.faults or ratio > 1.0:
            return
        if calibration.verdict is Verdict.DO_NOT_USE:
            return
        # The first result that reaches the goal must be long enough and confirmed.
        if self.best is None and not (newest.is_long and self._is_confirmed(calibration)):
            return
        information = 1.0 / max(ratio, 1e-12)
        if information * _AS_GOOD**2 >= self._best_information:
            self.best = calibration
            self._best_information = max(information, self._best_information)

    def _is_confirmed(self, newest: Calibration) -> bool:
        """Whether the previous result, from less motion, reaches the goal, too.

        Allowance and priors are taken from the newest result, because options may have changed in
        between.
        """
        before = self._before
        if before is None or before.faults or not before.is_long:
            return False
        if before.calibration.status is SolveStatus.NOT_CONVERGED:
            return False
        return bool(self._ratios(before.calibration, newest).max() <= 1.0)

    def _ratios(self, calibration: Calibration, newest: Calibration) -> FloatArray:
        """Ratios (6,) of the measured variances to the variances that are allowed for them.

        The wanted variance includes the allowance, which no motion reduces: the rest is allowed for
        the measured variance. Allowance and priors are taken from the newest result.
        """
        wanted = _SHARE * self._targets
        room = np.maximum(wanted**2 - newest.allowance**2, _LEAST_ROOM * wanted**2)
        # Motion improves neither an axis with a prior nor one out of reach of the streams.
        exempt = np.isin(AXES, newest.out_of_reach)
        exempt |= [dof.verdict is DofVerdict.PRIOR for dof in newest.observability]
        ratios: FloatArray = calibration.sigmas_measured**2 / room
        ratios[exempt] = 0.0
        return ratios

    def _in_steps(self, left_s: FloatArray) -> FloatArray:
        """Round times left (6,) to steps that decrease one by one, because estimates jump."""
        before = self._steps
        # 5 % tolerance: a time slightly above a step is rounded down to it.
        steps = np.searchsorted(_STEPS_S, 0.95 * left_s)
        far = len(_STEPS_S) - 1
        # To and from infinity and zero, a time may jump.
        is_new = (before == far) | (before == 0) | (steps == far) | (steps == 0)
        self._steps = np.where(is_new, steps, np.clip(steps, before - 1, before))
        return _STEPS_S[self._steps]

    def _nothing_yet(self, sentence: str) -> Progress:
        """Progress without a result."""
        unknown = np.full(6, np.inf)
        return Progress(sentence=sentence, axes=self._by_axis(unknown, unknown))

    def _by_axis(self, sigmas: FloatArray, left_s: FloatArray) -> dict[str, AxisProgress]:
        """Progress by axis from standard deviations (6,) and times left (6,)."""
        columns = zip(AXES, sigmas.tolist(), self._targets.tolist(), left_s.tolist(), strict=True)
        return {
            axis: AxisProgress(sigma=sigma, target=target, seconds_left=seconds)
            for axis, sigma, target, seconds in columns
        }

    def _reason_to_stop(self, newest: _Result) -> str:
        """Sentence to stop if more motion is useless or not needed; empty otherwise."""
        if newest.faults:
            return f"Stop: the streams are faulty: {newest.faults[0]}."
        if newest.calibration.status.failure:
            return f"No usable result: {newest.calibration.status.failure}."
        if self.best is not None:
            return f"Done: {what_is_known(self.best)}. Stop and save."
        return ""


def _own_faults(calibration: Calibration) -> list[str]:
    """Errors among the findings of a result from positions, rotations or rates."""
    return [
        reason.sentence
        for reason in calibration.reasons
        if reason.is_finding and reason.verdict is Verdict.DO_NOT_USE
    ]


def _time_left(newest: _Result, ratios: FloatArray) -> FloatArray:
    """Times (6,) of further motion (s) until each axis reaches its target.

    Variances decrease with 1 / time.
    """
    motion_s = newest.motion.motion_s
    # An infinite ratio times 0 s would be NaN.
    left_s = max(motion_s, 1e-6) * np.maximum(ratios - 1.0, 0.0)
    return np.maximum(left_s, max(_least_motion_s(newest.calibration) - motion_s, 0.0))


def _least_motion_s(calibration: Calibration) -> float:
    """Least duration of motion (s) before a standard deviation is trusted."""
    lasting = calibration.noise.lasting if calibration.noise else ()
    slowest_s = max((error.tau_s for error in lasting if error.kind != "path"), default=0.0)
    return max(_MIN_MOTION_S, _CORRELATION_TIMES * slowest_s)


def _advice(axis: str, left_s: float, is_stuck: bool, excitation: Excitation) -> str:
    """Sentence with the most helpful motion for the axis that takes longest.

    ``axis`` is empty if every axis is within its target.
    """
    left = duration(np.clip(left_s, _STEPS_S[1], _STEPS_S[-2]))
    if not axis:
        return f"Go on for about {left}: every axis is good enough if the next results agree."
    motion = helpful_motion([axis], excitation)
    axis_text = axes_in_words([axis])
    if is_stuck:
        return f"This motion will not determine {axis_text} well enough: {motion}."
    if not np.isfinite(left_s):
        return f"{axis_text} is not determined yet: {motion}."
    return f"Go on for about {left}: {axis_text} takes longest, {motion}."
