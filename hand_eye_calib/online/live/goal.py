"""Goal of a recording session: every axis is within its target standard deviation.

For each new result, the goal computes the time left on each axis, names the most helpful motion,
and decides whether the present motion can reach the targets.

An axis is within its target if its standard deviation is at most the target. The standard deviation
includes the allowance for constant errors, which no motion reduces. A single result within the
targets is no reason to stop: a short recording does not contain the time-correlated errors yet, so
its standard deviations are too small. Results of further motion must confirm the first result. This
rule was chosen on simulated recordings with known truth, see docs/session.md.

All motion is measured in seconds during which the sensors move.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.excitation import (
    MIN_ROTATION,
    Excitation,
    axes_by_hand,
    helpful_motion,
)
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.text import (
    amount,
    axes_in_words,
    capital,
    duration,
)
from hand_eye_calib.core.results.axes import what_is_known
from hand_eye_calib.core.results.calibration import (
    Calibration,
    DofVerdict,
    SolveStatus,
    Verdict,
)
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.online.live.brief import of_reason
from hand_eye_calib.online.live.progress import (
    AXIS_KEYS,
    AxisProgress,
    Progress,
)

# Bounds of the motion (s) that confirms a first result within the targets. Between these bounds, it
# equals the motion before that result.
_MIN_CONFIRMATION_S = 20.0
_MAX_CONFIRMATION_S = 75.0

# Shortest motion (s) of a session after which the motion may be called useless for an axis. Also
# the shortest motion between two results from which a rate of information is computed. It is about
# the time between two ramps.
_MIN_MOTION_TO_JUDGE_S = 30.0

# Values (s) to which the reported time left is rounded. Beyond the last finite value, the present
# motion cannot reach the target.
_STEPS_S = np.array(
    [0.0, 15, 30, 60, 90, 120, 180, 240, 360, 600, 900, 1200, np.inf]
)

# Values (s) to which the time of a confirmation is rounded up. This time is exact, not estimated.
_CONFIRMING_STEPS_S = np.array([4.0, 8, 12, 16, 20, 30, 40, 50, 60, 75])

# Largest decrease of the reported time left between two results, in steps.
_MAX_DECREASE_STEPS = 2
# The reported time left increases only if the new value is longer by at least this number of steps.
_MIN_INCREASE_STEPS = 3

# The newest result replaces the best result if its standard deviations are at most larger by this
# factor. Standard deviations are estimates, and the newest result has more motion.
_MAX_RATIO_TO_BEST = 1.25

# Target standard deviations of x, y, z (m), roll, pitch and yaw (rad).
Targets: TypeAlias = Sequence[float] | FloatArray

_NO_RESULT = "No result yet: move the sensors, with rotations."


@dataclass(frozen=True)
class _Result:
    """Result that may confirm a later result.

    Attributes
    ----------
    motion_s : float
        Motion of the session up to the result (s).
    sigmas_measured : (6,) array
        Standard deviations without the allowance (m, rad).
    allowance : (6,) array
        Allowance for constant errors (m, rad); infinite after a change of options.
    is_usable : bool
        Whether the solve succeeded and the streams had no faults.
    """

    motion_s: float
    sigmas_measured: FloatArray
    allowance: FloatArray
    is_usable: bool


class Goal:
    """Compare each new result of a session with the targets, and keep the best result.

    Once the goal is reached, it stays reached until the motion contradicts a prior or the options
    change.

    Parameters
    ----------
    targets : (6,) array-like
        Target standard deviations of x, y, z (m), roll, pitch and yaw (rad).

    Attributes
    ----------
    best : Calibration or None
        Newest result within the targets, unless an earlier one is clearly better. None before the
        goal is reached.
    progress : Progress
    """

    def __init__(self, targets: Targets) -> None:
        self._targets = np.asarray(targets, dtype=float)
        self.restart()

    def restart(self) -> None:
        """Begin a new session."""
        # Results of the last minutes of motion, as many as a confirmation needs. They are in the
        # order of their motion.
        self._results: list[_Result] = []
        # Motion of the newest result, and faults of its streams.
        self._motion: Excitation | None = None
        self._faults: Sequence[str] = ()
        # Time until the next result (s).
        self._period_s = 0.0
        self._start_over(_NO_RESULT)

    def _start_over(self, sentence: str) -> None:
        """Reset the best result and the progress; the list of results stays."""
        self.best: Calibration | None = None
        # Largest standard deviation of the best result, in units of its target.
        self._best_ratio = np.inf
        # Reported times left, of six axes and of the whole goal, as indices of _STEPS_S.
        self._steps = np.full(7, len(_STEPS_S) - 1)
        self.progress = self._nothing_yet(sentence)

    def wait(self, sentence: str, by_hand: tuple[str, ...] = ()) -> None:
        """Use a sentence as the progress if the session has no result; otherwise ignore it.

        ``by_hand`` has the axes for which the sentence proposes a measurement by hand.
        """
        if self._motion is None:
            self.progress = replace(
                self._nothing_yet(sentence), by_hand=by_hand
            )

    def follow(self, targets: Targets) -> None:
        """Start over with new targets, because options have changed.

        The robot may be parked, so earlier results can still confirm the next result.
        """
        self._targets = np.asarray(targets, dtype=float)
        has_result = self._motion is not None
        unknown = np.full(6, np.inf)
        self._results = [
            replace(result, allowance=unknown) for result in self._results
        ]
        self._start_over(
            "Solving with the new options." if has_result else _NO_RESULT
        )

    def retarget(self, calibration: Calibration, targets: Targets) -> None:
        """Compare the session's result with new targets if no other option has changed.

        Parameters
        ----------
        calibration : Calibration
            The result with the new targets.
        targets : (6,) array-like
        """
        self.follow(targets)
        if self._motion is not None:
            self.add(
                calibration, self._motion, self._faults, period_s=self._period_s
            )

    def add(
        self,
        calibration: Calibration,
        motion: Excitation,
        faults: Sequence[str] = (),
        newest_motion: Excitation | None = None,
        period_s: float = 0.0,
    ) -> Progress:
        """Add the next result of the session and update ``best`` and ``progress``.

        Parameters
        ----------
        calibration : Calibration
        motion : Excitation
            The motion of the result.
        faults : sequence of str
            Findings of the stream checks. With any finding, the goal is not reached.
        newest_motion : Excitation, optional
            The motion of the last minute. Default: ``motion``.
        period_s : float
            Time until the next result (s). A confirmation takes at least as long.
        """
        self._motion = motion
        self._period_s = period_s
        self._faults = faults or _own_faults(calibration)
        self._append(calibration, motion.motion_s)
        if calibration.status is SolveStatus.CONTRADICTED:
            self._start_over(f"No usable result: {calibration.status.failure}.")
            return self.progress
        ratios = self._variance_ratios(calibration)
        self._update_best(calibration, ratios)
        if self.best is not None:
            self.progress = self._progress_at_goal(self.best)
        else:
            last_minute = newest_motion or motion
            self.progress = self._progress_before_goal(
                calibration, ratios, last_minute
            )
        return self.progress

    def _append(self, calibration: Calibration, motion_s: float) -> None:
        """Store a result that may confirm later results.

        If the robot is parked, the motion is unchanged, and the result replaces the newest one.
        """
        if self._results and motion_s <= self._results[-1].motion_s:
            motion_s = self._results.pop().motion_s
        is_usable = not self._faults and not calibration.status.failure
        result = _Result(
            motion_s,
            calibration.sigmas_measured,
            calibration.allowance,
            is_usable,
        )
        self._results.append(result)
        # A confirmation also needs the last result before the longest confirming motion.
        start_s = motion_s - _MAX_CONFIRMATION_S
        while len(self._results) > 1 and self._results[1].motion_s <= start_s:
            del self._results[0]

    def _variance_ratios(
        self, newest: Calibration, earlier: _Result | None = None
    ) -> FloatArray:
        """Return measured variances (6,) divided by ``target**2 - allowance**2``.

        An axis is within its target if its ratio is at most 1. The ratio is infinite if the
        allowance alone exceeds the target. It is 0 if more motion cannot improve the axis: it has a
        prior, or the streams do not measure it.

        Parameters
        ----------
        newest : Calibration
            Its priors are used, because options may have changed since an earlier result.
        earlier : _Result, optional
            Earlier result, whose standard deviations are used, with the smaller of both allowances.
            The allowance is an estimate that varies from result to result. A confirmation must not
            begin again because the newest allowance is larger. Default: the newest result.
        """
        sigmas_measured = newest.sigmas_measured
        allowance = newest.allowance
        if earlier is not None:
            sigmas_measured = earlier.sigmas_measured
            allowance = np.minimum(allowance, earlier.allowance)
        allowed = self._targets**2 - allowance**2
        ratios = np.full(6, np.inf)
        np.divide(sigmas_measured**2, allowed, out=ratios, where=allowed > 0.0)
        ratios[np.isin(AXES, newest.out_of_reach)] = 0.0
        is_by_prior = [
            dof.verdict is DofVerdict.PRIOR for dof in newest.observability
        ]
        ratios[is_by_prior] = 0.0
        return ratios

    def _update_best(self, newest: Calibration, ratios: FloatArray) -> None:
        """Store the newest result as the best one if it reaches the goal and is not clearly worse.

        Parameters
        ----------
        newest : Calibration
        ratios : (6,) array
            See :meth:`_variance_ratios`.
        """
        is_usable = (
            newest.status is SolveStatus.OK
            and newest.verdict is not Verdict.DO_NOT_USE
        )
        if not is_usable or self._faults or ratios.max() > 1.0:
            return
        if self.best is None and self._confirmation_s(newest) > 0.0:
            return
        # Ignore axes that motion cannot improve.
        ratio = float(
            (newest.sigmas / self._targets)[ratios > 0.0].max(initial=0.0)
        )
        if ratio <= _MAX_RATIO_TO_BEST * self._best_ratio:
            self.best = newest
            self._best_ratio = min(ratio, self._best_ratio)

    def _confirmation_s(self, newest: Calibration) -> float:
        """Return the further motion (s) that confirms the newest result; 0 if it is confirmed."""
        motion_s = self._results[-1].motion_s
        # Motion (s) at the first result of the current sequence of results within the targets.
        first_s = motion_s
        for result in reversed(self._results):
            is_within = self._variance_ratios(newest, result).max() <= 1.0
            if not is_within or not result.is_usable:
                break
            first_s = result.motion_s
        return max(first_s + _confirming_motion(first_s) - motion_s, 0.0)

    def _time_left(self, newest: Calibration, ratios: FloatArray) -> FloatArray:
        """Return the times (6,) of further motion (s) until each axis is within its target.

        The information on an axis is the inverse of its variance. It is assumed to grow at the
        average rate of the session. If the rate since one of the last results is higher, this rate
        is used, because the motion may have improved. The time is infinite if the motion is too
        short for an estimate.
        """
        motion_s = self._results[-1].motion_s
        # Information as a share of the information that the target requires.
        share = 1.0 / np.maximum(ratios, 1.0)
        rate = np.zeros(6)
        if motion_s >= _MIN_CONFIRMATION_S:
            rate = share / motion_s
        for result in self._results:
            further_s = motion_s - result.motion_s
            if further_s < _MIN_MOTION_TO_JUDGE_S:
                break
            earlier = self._variance_ratios(newest, result)
            earlier_share = 1.0 / np.maximum(earlier, 1.0)
            rate = np.maximum(rate, (share - earlier_share) / further_s)
        left_s = np.full(6, np.inf)
        np.divide(1.0 - share, rate, out=left_s, where=rate > 0.0)
        left_s[share >= 1.0] = 0.0
        return left_s

    def _progress_before_goal(
        self, newest: Calibration, ratios: FloatArray, newest_motion: Excitation
    ) -> Progress:
        """Return the progress before the goal is reached.

        Parameters
        ----------
        newest : Calibration
        ratios : (6,) array
            See :meth:`_variance_ratios`.
        newest_motion : Excitation
            The motion of the last minute.
        """
        motion_s = self._results[-1].motion_s
        left_s = self._time_left(newest, ratios)
        total_s = float(left_s.max())
        is_confirming = total_s <= 0.0
        # The confirmation begins when the last axis is within its target.
        total_s += _confirming_motion(motion_s + total_s)
        *axes_left_s, total_s = self._in_steps(np.append(left_s, total_s))
        if is_confirming:
            total_s = max(self._confirmation_s(newest), self._period_s)
            step = np.searchsorted(_CONFIRMING_STEPS_S[:-1], 0.99 * total_s)
            total_s = float(_CONFIRMING_STEPS_S[step])
            # The last reported total was an estimate. Do not compare the new value with it.
            self._steps[-1] = len(_STEPS_S) - 1
        axes = self._by_axis(newest.sigmas, axes_left_s)
        left_text = duration(total_s).replace(".0 ", " ")
        progress = Progress(
            sentence=f"Confirming, {left_text}: every axis is within its target. Go on.",
            seconds_left=total_s,
            is_faulty=bool(self._faults),
            axes=axes,
        )
        if ratios.max() > 1.0:
            progress = self._with_advice(
                progress, newest, ratios, newest_motion
            )
        reason = self._reason_to_stop(newest)
        return replace(progress, sentence=reason) if reason else progress

    def _with_advice(
        self,
        progress: Progress,
        newest: Calibration,
        ratios: FloatArray,
        newest_motion: Excitation,
    ) -> Progress:
        """Return the progress with its limiting axis, and with the motion that helps this axis.

        The limiting axis is farthest from its target. An axis whose allowance exceeds its target is
        limiting only if all other axes are within their targets.
        """
        is_out_of_reach = newest.allowance >= self._targets
        reachable = np.where(is_out_of_reach, 0.0, ratios)
        limiting = int(
            np.argmax(reachable if reachable.max() > 1.0 else ratios)
        )
        axis = AXES[limiting]
        row = progress.axes[AXIS_KEYS[axis]]
        if is_out_of_reach[limiting]:
            return _with_small_target(
                progress, axis, newest.allowance[limiting]
            )
        is_helpful = _is_helpful(newest_motion, axis)
        is_long = self._results[-1].motion_s >= _MIN_MOTION_TO_JUDGE_S
        will_not_get_there = (
            is_long and row.seconds_left == np.inf and not is_helpful
        )
        assert self._motion is not None
        motion = capital(helpful_motion([axis], self._motion))
        by_hand = () if is_helpful else axes_by_hand([axis], self._motion)
        axis_text = axes_in_words([axis])
        if will_not_get_there:
            sentence = f"This motion will not determine {axis_text} well enough. {motion}."
        else:
            if is_helpful:
                motion = "This motion is right: continue it"
            elif _turns_about(newest_motion, axis):
                # A rotation about an axis does not observe this axis. The motion must change, so
                # the time left with the present motion is no forecast.
                row = replace(row, seconds_left=np.inf)
                axes = {**progress.axes, AXIS_KEYS[axis]: row}
                progress = replace(progress, seconds_left=np.inf, axes=axes)
            if np.isfinite(progress.seconds_left):
                left = duration(progress.seconds_left)
                sentence = f"Go on for about {left}, {axis_text} takes longest. {motion}."
            else:
                sentence = f"{_not_yet_in_words(axis, ratios)}. {motion}."
        return replace(
            progress,
            sentence=sentence,
            limiting_axis=AXIS_KEYS[axis],
            will_not_get_there=will_not_get_there,
            by_hand=by_hand,
        )

    def _progress_at_goal(self, best: Calibration) -> Progress:
        """Return the progress after the goal is reached, with the axes of the best result."""
        precision = what_is_known(best)
        return Progress(
            sentence=self._reason_to_stop(best)
            or _done_in_words(best, precision),
            done=not self._faults,
            precision=precision,
            seconds_left=0.0,
            is_faulty=bool(self._faults),
            axes=self._by_axis(best.sigmas, [0.0] * 6),
        )

    def _in_steps(self, left_s: FloatArray) -> list[float]:
        """Round times left (7,), of six axes and in all, to steps that decrease slowly.

        Estimates of the time left jump from result to result. Therefore the reported time decreases
        by a few steps at most, or at once to 0. It increases only by several steps, to or from an
        unknown value, or from 0 to the smallest step.
        """
        before = self._steps
        infinite = len(_STEPS_S) - 1
        # The tolerance is 5 %: a time slightly above a step is rounded down to it.
        steps = np.searchsorted(_STEPS_S, 0.95 * left_s)
        has_infinite = (before == infinite) | (steps == infinite)
        is_new = (
            has_infinite
            | (steps == 0)
            | (steps >= before + _MIN_INCREASE_STEPS)
        )
        # If an axis leaves its target again, its time increases to the smallest step only.
        slower = np.clip(
            steps, before - _MAX_DECREASE_STEPS, np.maximum(before, 1)
        )
        self._steps = np.where(is_new, steps, slower)
        return [float(seconds) for seconds in _STEPS_S[self._steps]]

    def _nothing_yet(self, sentence: str) -> Progress:
        """Return the progress of a session without a result."""
        return Progress(
            sentence=sentence,
            axes=self._by_axis(np.full(6, np.inf), [np.inf] * 6),
        )

    def _by_axis(
        self, sigmas: FloatArray, left_s: Sequence[float]
    ) -> dict[str, AxisProgress]:
        """Return the progress by axis from standard deviations (6,) and times left (6,) (s)."""
        keys = AXIS_KEYS.values()
        columns = zip(
            keys, sigmas.tolist(), self._targets.tolist(), left_s, strict=True
        )
        return {
            key: AxisProgress(sigma=sigma, target=target, seconds_left=seconds)
            for key, sigma, target, seconds in columns
        }

    def _reason_to_stop(self, newest: Calibration) -> str:
        """Return the reason to stop; empty if the streams and the result are sound.

        If the streams are faulty, the person must stop. After a failed solve, the session waits.
        """
        if self._faults:
            return f"Stop: the streams are faulty: {self._faults[0]}."
        if newest.status.failure:
            return no_result_in_words(newest.status.failure)
        return ""


def _own_faults(calibration: Calibration) -> list[str]:
    """Return the findings that make a result unusable, one sentence each.

    For positions, rotations and rates, the findings are in the result. For poses, the caller of
    :meth:`Goal.add` passes the findings of the stream checks.
    """
    return [
        reason.sentence
        for reason in calibration.reasons
        if reason.is_finding and reason.verdict is Verdict.DO_NOT_USE
    ]


def _confirming_motion(motion_s: float) -> float:
    """Return the motion (s) that confirms a first result within the targets after ``motion_s``."""
    return min(max(motion_s, _MIN_CONFIRMATION_S), _MAX_CONFIRMATION_S)


def _is_helpful(motion: Excitation, axis: str) -> bool:
    """Return whether the motion observes an axis by a rotation that a flat drive lacks.

    The rotations about the two other axes observe an axis. The axis with the most rotation is left
    out, because every drive has this rotation.
    """
    main_axis = int(np.argmax(motion.rotation))
    own_axis = AXES.index(axis) % 3
    useful = [k for k in range(3) if k not in (own_axis, main_axis)]
    return bool(motion.rotation[useful].max() >= MIN_ROTATION)


def _turns_about(motion: Excitation, axis: str) -> bool:
    """Return whether most rotation of the motion is about an axis, such as z for a vehicle."""
    return int(np.argmax(motion.rotation)) == AXES.index(axis) % 3


def no_result_in_words(failure: str) -> str:
    """Return a sentence about a solve that has failed, with the next step."""
    return f"No usable result yet: {failure}. Go on, with turns to both sides."


def _done_in_words(best: Calibration, precision: str) -> str:
    """Return the sentence of a session that has reached its goal, with the verdict."""
    if not best.reasons:
        return f"Done: {precision}. Stop and save."
    problem, step = of_reason(best.reasons[0])
    return f"Done. {best.verdict.value}: {problem}. Save. {step}"


def _not_yet_in_words(limiting: str, ratios: FloatArray) -> str:
    """Return the sentence that an axis is not determined, and all other axes without a result."""
    axes = [limiting]
    if np.isinf(ratios[AXES.index(limiting)]):
        axes = [
            axis
            for axis, ratio in zip(AXES, ratios, strict=True)
            if ratio == np.inf
        ]
    verb = "is" if len(axes) == 1 else "are"
    return f"{axes_in_words(axes)} {verb} not determined well enough yet"


def _with_small_target(
    progress: Progress, axis: str, allowance: float
) -> Progress:
    """Return the progress of a session whose target for an axis is below the allowance."""
    key = AXIS_KEYS[axis]
    sentence = _too_small_in_words(axis, progress.axes[key].target, allowance)
    return replace(
        progress,
        sentence=sentence,
        limiting_axis=key,
        will_not_get_there=True,
        target_is_too_small=True,
    )


def _too_small_in_words(axis: str, target: float, allowance: float) -> str:
    """Return the sentence about a target below the allowance."""
    return (
        f"No motion makes {axes_in_words([axis])} good to {amount(axis, target)}. "
        f"Constant errors alone may be {amount(axis, allowance)}. "
        "Stop and save, or set a larger target."
    )
