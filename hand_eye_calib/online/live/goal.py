"""Progress of a recording session.

It has the distance to the target on each axis, the time left, the most helpful motion, and whether
the present motion can reach the target.

A session has one scale: the standard deviation of an axis, allowance included, compared with the
target of the axis. A single standard deviation below the target is no reason to stop, because a
short recording does not contain the time-correlated errors yet. Further motion must confirm it. The
rule was chosen on simulated recordings with known truth, see docs/session.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.excitation import MIN_ROTATION, Excitation, helpful_motion
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.text import amount, axes_in_words, duration
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict, SolveStatus, Verdict
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.core.results.verdict import what_is_known
from hand_eye_calib.online.live.progress import AXIS_KEYS, AxisProgress, Progress

# Share of the motion so far, up to the newest result, in which every result must be within the
# targets. All motion is measured in seconds of movement.
_CONFIRMING_SHARE = 0.5
# Shortest and longest motion (s) that confirms a result within the targets.
_SHORTEST_CONFIRMATION_S = 20.0
_LONGEST_CONFIRMATION_S = 75.0

# Shortest motion (s) after which the motion may be called useless for an axis.
_JUDGED_FROM_S = 30.0

# Times left that are reported (s). They only decrease, by one step for each result. Beyond the last
# finite step, the present motion cannot reach the target.
_STEPS_S = np.array([0.0, 15, 30, 60, 90, 120, 180, 240, 360, 600, 900, 1200, np.inf])

# A time left that is this many steps longer than the last one is a new estimate.
_NEW_STEPS = 3

# Largest ratio of standard deviations at which a newer result replaces the best result: standard
# deviations are estimates, and the newer result has more motion.
_AS_GOOD = 1.25

# Target standard deviations of x, y, z (m), roll, pitch and yaw (rad).
Targets: TypeAlias = Sequence[float] | FloatArray

_NO_RESULT = "No result yet: move the sensors, with rotations."


@dataclass(frozen=True)
class _Result:
    """Standard deviations of a result without the allowance, and whether the result is usable."""

    motion_s: float
    sigmas_measured: FloatArray
    is_usable: bool


class Goal:
    """Goal of a session, compared with each new result.

    Once the goal is reached, it stays reached, unless a result is refuted or the options change.
    ``best`` is the newest result within the targets, unless an earlier result is clearly better.

    Parameters
    ----------
    targets : (6,) array-like
        Target standard deviations of x, y, z (m), roll, pitch and yaw (rad).

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
        # Results of the newest motion, as far back as a confirmation needs them, each with more
        # motion than the result before it.
        self._results: list[_Result] = []
        # Motion and faults of the newest result.
        self._motion: Excitation | None = None
        self._faults: Sequence[str] = ()
        self._start_over(_NO_RESULT)

    def _start_over(self, sentence: str) -> None:
        """Forget the progress towards the goal; the results stay."""
        self.best: Calibration | None = None
        self._best_ratio = np.inf
        self._steps = np.full(7, len(_STEPS_S) - 1)
        self.progress = self._nothing_yet(sentence)

    def wait(self, sentence: str) -> None:
        """Store the reason why there is no result yet; ignored once there is a result."""
        if self._motion is None:
            self.progress = self._nothing_yet(sentence)

    def follow(self, targets: Targets) -> None:
        """Start over with these targets, because options have changed.

        Earlier results still confirm the next result, because the robot may be parked by now.
        """
        self._targets = np.asarray(targets, dtype=float)
        has_result = self._motion is not None
        self._start_over("Solving with the new options." if has_result else _NO_RESULT)

    def retarget(self, calibration: Calibration, targets: Targets) -> None:
        """Compare the session's result with new targets; no other option has changed.

        Parameters
        ----------
        calibration : Calibration
            The result with the new targets.
        targets : (6,) array-like
        """
        self.follow(targets)
        if self._motion is not None:
            self.add(calibration, self._motion, self._faults)

    def add(
        self,
        calibration: Calibration,
        motion: Excitation,
        faults: Sequence[str] = (),
        newest_motion: Excitation | None = None,
    ) -> Progress:
        """Add the next result of the session and update ``best`` and ``progress``.

        Parameters
        ----------
        calibration : Calibration
        motion : Excitation
            The motion of the result.
        faults : sequence of str
            Findings of the stream checks. The goal is not reached while there are any.
        newest_motion : Excitation, optional
            The motion of the last minute. Default: ``motion``.
        """
        self._motion = motion
        self._faults = faults or _own_faults(calibration)
        self._append(calibration, motion.motion_s)
        if calibration.status is SolveStatus.CONTRADICTED:
            self._start_over(f"No usable result: {calibration.status.failure}.")
            return self.progress
        needs = self._needs(calibration)
        self._update_best(calibration, needs)
        if self.best is not None:
            self.progress = self._done(self.best)
        else:
            self.progress = self._not_done(calibration, needs, newest_motion or motion)
        return self.progress

    def _append(self, calibration: Calibration, motion_s: float) -> None:
        """Store a result for the confirmation of later results.

        Without more motion a result replaces the newest result, because the robot is parked.
        """
        if self._results and motion_s <= self._results[-1].motion_s:
            motion_s = self._results.pop().motion_s
        is_usable = not self._faults and not calibration.status.failure
        self._results.append(_Result(motion_s, calibration.sigmas_measured, is_usable))
        # The newest result that is old enough for the longest confirmation stays, too.
        start_s = motion_s - _LONGEST_CONFIRMATION_S
        while len(self._results) > 1 and self._results[1].motion_s <= start_s:
            del self._results[0]

    def _needs(self, newest: Calibration, sigmas_measured: FloatArray | None = None) -> FloatArray:
        """Return the measured variances (6,) as multiples of the variances that the targets allow.

        A target is reached at 1. Its variance includes the allowance, which no motion reduces. The
        multiple is infinite if the allowance alone exceeds the target.

        Parameters
        ----------
        newest : Calibration
            Its allowance and priors count, because options may have changed in between.
        sigmas_measured : (6,) array, optional
            Of an earlier result. Default: those of the newest result.
        """
        if sigmas_measured is None:
            sigmas_measured = newest.sigmas_measured
        allowed = self._targets**2 - newest.allowance**2
        needs = np.full(6, np.inf)
        np.divide(sigmas_measured**2, allowed, out=needs, where=allowed > 0.0)
        # Motion improves neither an axis with a prior nor one out of reach of the streams.
        needs[np.isin(AXES, newest.out_of_reach)] = 0.0
        needs[[dof.verdict is DofVerdict.PRIOR for dof in newest.observability]] = 0.0
        return needs

    def _update_best(self, newest: Calibration, needs: FloatArray) -> None:
        """Make the newest result the best result if it reaches the goal and is not clearly worse.

        Parameters
        ----------
        newest : Calibration
        needs : (6,) array
            See :meth:`_needs`.
        """
        is_usable = newest.status is SolveStatus.OK and newest.verdict is not Verdict.DO_NOT_USE
        if not is_usable or self._faults or needs.max() > 1.0:
            return
        if self.best is None and self._confirmation_s(newest) > 0.0:
            return
        ratio = float((newest.sigmas / self._targets)[needs > 0.0].max(initial=0.0))
        if ratio <= _AS_GOOD * self._best_ratio:
            self.best = newest
            self._best_ratio = min(ratio, self._best_ratio)

    def _confirmation_s(self, newest: Calibration) -> float:
        """Return the further motion (s) that confirms the newest result; 0 if it is confirmed."""
        motion_s = self._results[-1].motion_s
        # Motion (s) since which every result is within the targets.
        since_s = motion_s
        for result in reversed(self._results):
            is_within = self._needs(newest, result.sigmas_measured).max() <= 1.0
            if not is_within or not result.is_usable:
                break
            since_s = result.motion_s
        return max(since_s + _confirmation_after(since_s) - motion_s, 0.0)

    def _time_left(self, newest: Calibration, needs: FloatArray) -> FloatArray:
        """Return the times (6,) of further motion (s) until each axis is within its target.

        The information of an axis, the inverse of its variance, grows at the rate of the session
        so far or of the last minute, whichever is higher: the present motion may be a better one.
        """
        oldest = self._results[0]
        motion_s = self._results[-1].motion_s
        # Shares of the information that the targets need, now and before the last minute.
        share = 1.0 / np.maximum(needs, 1.0)
        share_before = 1.0 / np.maximum(self._needs(newest, oldest.sigmas_measured), 1.0)
        rate = share / max(motion_s, 1e-6)
        minute_s = motion_s - oldest.motion_s
        if minute_s >= _SHORTEST_CONFIRMATION_S:
            rate = np.maximum(rate, (share - share_before) / minute_s)
        left_s = np.full(6, np.inf)
        np.divide(1.0 - share, rate, out=left_s, where=rate > 0.0)
        return left_s

    def _not_done(
        self, newest: Calibration, needs: FloatArray, newest_motion: Excitation
    ) -> Progress:
        """Return the progress before the goal is reached.

        Parameters
        ----------
        newest : Calibration
        needs : (6,) array
            See :meth:`_needs`.
        newest_motion : Excitation
            The motion of the last minute.
        """
        motion_s = self._results[-1].motion_s
        left_s = self._time_left(newest, needs)
        total_s = float(left_s.max())
        if total_s > 0.0:
            # The confirmation begins when the last axis is within its target.
            total_s += _confirmation_after(motion_s + total_s)
        else:
            total_s = self._confirmation_s(newest)
        *axes_left_s, total_s = self._in_steps(np.append(left_s, total_s))
        axes = self._by_axis(newest.sigmas, axes_left_s)
        progress = Progress(
            sentence=f"Confirming, {duration(total_s)}: every axis is within its target. Go on.",
            seconds_left=total_s,
            is_faulty=bool(self._faults),
            axes=axes,
        )
        if needs.max() > 1.0:
            progress = self._with_advice(progress, newest, needs, newest_motion)
        reason = self._reason_to_stop(newest)
        return replace(progress, sentence=reason) if reason else progress

    def _with_advice(
        self,
        progress: Progress,
        newest: Calibration,
        needs: FloatArray,
        newest_motion: Excitation,
    ) -> Progress:
        """Return the progress with the axis that is farthest from its target, and what helps.

        An axis whose target is below the allowance counts only if all others are within theirs.
        """
        is_too_small = newest.allowance >= self._targets
        reachable = np.where(is_too_small, 0.0, needs)
        limiting = int(np.argmax(reachable if reachable.max() > 1.0 else needs))
        axis = AXES[limiting]
        row = progress.axes[AXIS_KEYS[axis]]
        if is_too_small[limiting]:
            return replace(
                progress,
                sentence=_too_small_in_words(axis, row.target, newest.allowance[limiting]),
                limiting_axis=AXIS_KEYS[axis],
                will_not_get_there=True,
                target_is_too_small=True,
            )
        is_right = _is_helpful(newest_motion, axis)
        is_long = self._results[-1].motion_s >= _JUDGED_FROM_S
        will_not_get_there = is_long and row.seconds_left == np.inf and not is_right
        assert self._motion is not None
        motion = helpful_motion([axis], self._motion)
        axis_text = axes_in_words([axis])
        if will_not_get_there:
            sentence = f"This motion will not determine {axis_text} well enough: {motion}."
        else:
            if is_right:
                motion = "this motion is right, more of it"
            if np.isfinite(progress.seconds_left):
                left = duration(progress.seconds_left)
                sentence = f"Go on for about {left}: {axis_text} takes longest, {motion}."
            else:
                sentence = f"{axis_text} is not determined well enough yet: {motion}."
        return replace(
            progress,
            sentence=sentence,
            limiting_axis=AXIS_KEYS[axis],
            will_not_get_there=will_not_get_there,
        )

    def _done(self, best: Calibration) -> Progress:
        """Return the progress after the goal is reached, with the axes of the kept result."""
        precision = what_is_known(best)
        return Progress(
            sentence=self._reason_to_stop(best) or f"Done: {precision}. Stop and save.",
            done=not self._faults,
            precision=precision,
            seconds_left=0.0,
            is_faulty=bool(self._faults),
            axes=self._by_axis(best.sigmas, [0.0] * 6),
        )

    def _in_steps(self, left_s: FloatArray) -> list[float]:
        """Round times left (7,), of each axis and in all, to steps that decrease one by one.

        Estimates jump; only a much longer time is a new estimate.
        """
        before = self._steps
        far = len(_STEPS_S) - 1
        # 5 % tolerance: a time slightly above a step is rounded down to it.
        steps = np.searchsorted(_STEPS_S, 0.95 * left_s)
        is_new = (before == far) | (steps == far) | (steps == 0) | (steps >= before + _NEW_STEPS)
        # An axis that was within its target may be beyond it again by the smallest step.
        slower = np.clip(steps, before - 1, np.maximum(before, 1))
        self._steps = np.where(is_new, steps, slower)
        return [float(seconds) for seconds in _STEPS_S[self._steps]]

    def _nothing_yet(self, sentence: str) -> Progress:
        """Progress without a result."""
        return Progress(sentence=sentence, axes=self._by_axis(np.full(6, np.inf), [np.inf] * 6))

    def _by_axis(self, sigmas: FloatArray, left_s: Sequence[float]) -> dict[str, AxisProgress]:
        """Progress by axis from standard deviations (6,) and times left."""
        keys = AXIS_KEYS.values()
        columns = zip(keys, sigmas.tolist(), self._targets.tolist(), left_s, strict=True)
        return {
            key: AxisProgress(sigma=sigma, target=target, seconds_left=seconds)
            for key, sigma, target, seconds in columns
        }

    def _reason_to_stop(self, newest: Calibration) -> str:
        """Return the sentence to stop if the streams or the result are unusable; else empty."""
        if self._faults:
            return f"Stop: the streams are faulty: {self._faults[0]}."
        if newest.status.failure:
            return f"No usable result: {newest.status.failure}."
        return ""


def _own_faults(calibration: Calibration) -> list[str]:
    """Errors among the findings of a result from positions, rotations or rates."""
    return [
        reason.sentence
        for reason in calibration.reasons
        if reason.is_finding and reason.verdict is Verdict.DO_NOT_USE
    ]


def _confirmation_after(motion_s: float) -> float:
    """Return the motion (s) that confirms results within the targets since this motion (s)."""
    share_s = _CONFIRMING_SHARE * motion_s
    return min(max(share_s, _SHORTEST_CONFIRMATION_S), _LONGEST_CONFIRMATION_S)


def _is_helpful(motion: Excitation, axis: str) -> bool:
    """Whether the motion contains a rotation that reveals an axis and that a flat drive lacks.

    The rotation is across the axis. The main rotation does not count, because every drive has it.
    """
    main = int(np.argmax(motion.rotation))
    index = AXES.index(axis) % 3
    others = [other for other in range(3) if other not in (index, main)]
    return bool(motion.rotation[others].max() >= MIN_ROTATION)


def _too_small_in_words(axis: str, target: float, allowance: float) -> str:
    """Return the sentence about a target below the allowance."""
    return (
        f"More motion cannot make {axes_in_words([axis])} good to {amount(axis, target)}: "
        f"{amount(axis, allowance)} is the allowance for constant errors. "
        "Stop and save, or set a larger target."
    )
