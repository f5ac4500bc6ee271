"""When the node solves and checks the streams, what came of it, and who waits for the answer."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hand_eye_calib.assessment.excitation import what_is_missing
from hand_eye_calib.checks.check import MIN_DURATION_S, MIN_ROTATION_RAD, CheckResult
from hand_eye_calib.checks.findings import Finding, Severity, answered, gravest_first
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.engine.run import with_options
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.geometry import se3
from hand_eye_calib.live.log import GOES_ON_S, ONCE_S, NodeLog
from hand_eye_calib.live.session import LiveSession
from hand_eye_calib.live.solving import NO_MOTION, Answer, Failure, Job, SolvingProcess
from hand_eye_calib.live.state import (
    ANSWER_WITHIN_S,
    Broadcast,
    ChecksState,
    ExtrinsicState,
    InputState,
    Level,
    ProgressState,
    ResultState,
    Standing,
    by_axis,
)
from hand_eye_calib.option import Options
from hand_eye_calib.plain import plain
from hand_eye_calib.results.calibration import Calibration, SolveStatus, Verdict
from hand_eye_calib.results.context import Comparison
from hand_eye_calib.results.records import AXES
from hand_eye_calib.session.goal import Goal
from hand_eye_calib.text import duration, listing, parse_targets

# Takes whether a solve was good, and a line about it.
OnSolved = Callable[[bool, str], None]

# The streams are checked at most this often (s), which costs a second or two each time.
_CHECK_PERIOD_S = 30.0

# Options that change how a result is judged, but not the result.
_TARGETS = ("target_translation", "target_rotation", "target_axes")


# Findings about the poses of one stream as they came in. Once poses are paired, and with that
# interpolated, they do not show any more.
_OF_RAW_POSES = frozenset({"leap", "interleaved", "frozen", "coarse_positions"})


class StreamChecks:
    """Keeps the findings of stream checks.

    Errors count at once; warnings, and what is merely possible, only if two checks in a row have
    them: over a short recording, odometry may well be off by some per cent. An error of the poses
    as they came in stays for the session, because its poses do.
    """

    def __init__(self, log: NodeLog) -> None:
        self._log = log
        self.restart()

    def restart(self) -> None:
        """Begin a new session: nothing is known yet."""
        self._result: CheckResult | None = None
        self._checked_at_s = 0.0
        self._suspected: set[tuple[str, str]] = set()
        self._faults: dict[tuple[str, str], Finding] = {}
        self._lasting: dict[tuple[str, str], Finding] = {}

    def follow(self, config: CalibratorConfig) -> None:
        """Forget lasting findings that the options answer."""
        open_findings = {}
        for key, finding in self._lasting.items():
            (graded,) = answered([finding], config)
            if graded.makes_unusable:
                open_findings[key] = finding
        self._lasting = open_findings

    def take(self, result: CheckResult) -> None:
        """Take what a check found; what is new, and what no longer holds, is logged."""
        before, self._result, self._checked_at_s = self._faults, result, time.monotonic()
        found = {(f.code, f.stream): f for f in result.findings if f.severity is not Severity.NOTE}
        self._faults = {
            key: f for key, f in found.items() if f.makes_unusable or key in self._suspected
        }
        self._suspected = set(found)
        for key, finding in self._faults.items():
            if finding.makes_unusable and finding.code in _OF_RAW_POSES:
                self._lasting[key] = finding
        # Those of this check have the newest numbers.
        self._faults = {**self._lasting, **self._faults}
        for key in self._faults.keys() - before.keys():
            self._log.warning(_in_parameters(self._faults[key]))
        for key in before.keys() - self._faults.keys():
            self._log.info(f"no longer found: {before[key].what}")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What speaks against calibrating with these streams, the gravest first."""
        return tuple(self._faults.values())

    def _unseen(self) -> list[Finding]:
        """Lasting findings that the last check does not have."""
        keys = {(each.code, each.stream) for each in self._result.findings} if self._result else ()
        return [finding for key, finding in self._lasting.items() if key not in keys]

    def faults(self) -> tuple[str, ...]:
        """The findings against calibrating, in a line each, with the parameters that help."""
        return tuple(map(_in_parameters, self.findings))

    def state(self) -> ChecksState:
        """Findings of the last check."""
        if self._result is None:
            text = (
                f"not checked yet: that takes {MIN_DURATION_S:g} s of motion with rotations of "
                f"{np.degrees(MIN_ROTATION_RAD):.0f} deg"
            )
            return ChecksState(level=Level.WARN, text=text)
        found = gravest_first([*self._result.findings, *self._unseen()])
        return ChecksState(
            level=Level.WARN if self._faults else Level.OK,
            text="; ".join(self.faults()) or "both streams can be of one rigid body",
            age_s=time.monotonic() - self._checked_at_s,
            findings=tuple(f"{each.severity.value}: {_in_parameters(each)}" for each in found),
        )


def _in_parameters(finding: Finding) -> str:
    """A finding in one line, with what helps as parameters."""
    helps = (f": set {name} to {value}" for name, value in finding.options.items())
    return f"{finding}{''.join(helps)}"


class SolveCycle:
    """Sends snapshots of the session to the solving process and takes the answers.

    At most one job is under way; a result of an older session is dropped.

    Parameters
    ----------
    session : LiveSession
    log : NodeLog
    wake : callable
        Called in another thread when :meth:`take_answers` has something to do.
    complete, publish : callable
        Called with each usable Calibration, which gives it with what there is to add; and when an
        answer is taken, before who has asked is told.
    targets : (6,) sequence
        Standard deviations wanted, m and rad.

    Attributes
    ----------
    is_solving : bool
    result : Calibration or None
        The session's result: the newest usable one; once the goal is reached, the one kept, whose
        warnings say why the newest is not. A contradicted prior puts a result in its place that
        says DO NOT USE.
    """

    def __init__(
        self,
        session: LiveSession,
        log: NodeLog,
        wake: Callable[[], None],
        complete: Callable[[Calibration], Calibration],
        publish: Callable[[], None],
        targets: Sequence[float],
    ) -> None:
        self.is_solving = False
        self.checks, self.goal = StreamChecks(log), Goal(targets)
        self._session, self._log = session, log
        self._complete, self._publish = complete, publish
        self._rest_until_s = 0.0
        # Who waits, since when; in flight are those that the next answer is for.
        self._asked: dict[OnSolved, float] = {}
        self._in_flight: tuple[OnSolved, ...] = ()
        self._process = SolvingProcess(wake)
        self.restart()

    def restart(self) -> None:
        """Begin a new session: no result yet."""
        self.result: Calibration | None = None
        self._told_result: ResultState | None = None
        self._solved: tuple[Calibrator, Options] | None = None
        self._solved_at_s = 0.0
        self._seen = NO_MOTION
        self._failure: Failure | None = None
        # Why every solve since the result has failed, and since when (steady time, s).
        self._failing: Failure | None = None
        self._failing_since_s = 0.0
        # Reasons in the log as warnings, by their rules.
        self._warned: dict[str, str] = {}
        self._certain: Options = {}
        self._told: tuple[str, ...] = ()
        self._is_unchecked, self._check_due_s = False, 0.0
        self.checks.restart()
        self.goal.restart()

    def follow(self, config: CalibratorConfig, before: CalibratorConfig) -> None:
        """Start over with other options than before, and check at once.

        Targets alone do not change the result: it is judged again, also if nothing moves any more.
        """
        self._certain, self._told = {}, ()
        self._is_unchecked, self._check_due_s = True, 0.0
        self.checks.follow(config)
        targets = {name: getattr(config, name) for name in _TARGETS}
        result = self.published
        others = before.given.difference(_TARGETS), config.given.difference(_TARGETS)
        is_other = replace(before, **targets) != config or others[0] != others[1]
        if result is None or is_other:
            self.goal.follow(config.targets)
            return
        targets["target_axes"] = parse_targets("target.axes", config.target_axes)
        result = replace(result, **targets)
        self.goal.retarget(result, config.targets)
        self.result = result
        self._told_result = _result_state(result)

    @property
    def published(self) -> Calibration | None:
        """The result for the topics; None without one that holds."""
        return None if self.result is None or is_refuted(self.result) else self.result

    @property
    def standing(self) -> Standing:
        """Whether the result holds."""
        if self.result is None:
            return Standing.NONE
        if is_refuted(self.result):
            return Standing.REFUTED
        return Standing.CURRENT if self._failing is None else Standing.OUTDATED

    @property
    def problem(self) -> str:
        """Why the result does not hold, in one line; empty if it does."""
        result, failing = self.result, self._failing
        if result is not None and is_refuted(result):
            reason = result.reasons[0]
            remedy = ", or remove it" if result.status is SolveStatus.CONTRADICTED else ""
            return f"{reason.sentence}; {reason.what_to_do}{remedy}"
        if result is None or failing is None:
            return ""
        now_s = time.monotonic()
        failing_s = duration(now_s - self._failing_since_s)
        age_s = duration(now_s - self._solved_at_s)
        return (
            f"every solve has failed for {failing_s}: {failing.what.rstrip('.')}; the result shown "
            f"is {age_s} old, of {result.n_poses} poses"
        )

    def result_to_save(self) -> Calibration | None:
        """The result, with a warning if every solve since has failed; None without one."""
        if self.result is None or self.standing is not Standing.OUTDATED:
            return self.result
        return replace(self.result, warnings=(*self.result.warnings, self.problem))

    def snapshot(self) -> Snapshot | None:
        """The poses and options that gave the result; None without one."""
        if self._solved is None:
            return None
        calibrator, certain = self._solved
        return with_options(calibrator.snapshot(), certain)

    # ------------------------------------------------------------------ solving

    def ask(self, on_solved: OnSolved) -> None:
        """Solve as soon as possible."""
        self._asked[on_solved] = time.monotonic()
        if not self.is_solving:
            self._start()

    def tell_who_waits(self) -> None:
        """Tell those who have waited for long that the solve goes on; to be called often."""
        long_ago_s = time.monotonic() - ANSWER_WITHIN_S
        for on_solved in [each for each, since_s in self._asked.items() if since_s < long_ago_s]:
            del self._asked[on_solved]
            text = f"still solving after {ANSWER_WITHIN_S:g} s (do others use the processor?)"
            on_solved(False, f"{text}: the result will be in the log and on the topics")

    def start_if_due(self) -> None:
        """Solve if there is something new and the last solve has left the processor a rest."""
        now_s = time.monotonic()
        has_work = self._session.has_new_poses or self._must_check(now_s)
        if has_work and not self.is_solving and now_s >= self._rest_until_s:
            self._start()

    def take_answers(self) -> None:
        """Take what the solving process has sent."""
        for answer in self._process.answers():
            good, text = self.conclude(answer)
            self.is_solving = False
            self._publish()
            for on_solved in self._in_flight:
                if self._asked.pop(on_solved, None) is not None:
                    on_solved(good, text)
            self._in_flight = ()
            if self._asked:
                self._start()

    def stop(self, timeout_s: float) -> None:
        """Wait so long for the solve under way, take its result, and end the process."""
        self._process.stop(timeout_s)
        for answer in self._process.answers():
            self.conclude(answer)

    def _must_check(self, now_s: float) -> bool:
        return self._is_unchecked and now_s >= self._check_due_s

    def _start(self) -> None:
        self.is_solving, now_s = True, time.monotonic()
        self._is_unchecked |= self._session.has_new_poses
        self._in_flight = tuple(self._asked)
        # What somebody asks for is told together with what speaks against it.
        if check := self._must_check(now_s) or (self._is_unchecked and bool(self._in_flight)):
            self._is_unchecked, self._check_due_s = False, now_s + _CHECK_PERIOD_S
        self._submitted = self._session.copy_to_solve()
        self._process.submit(Job(self._session.number, self._submitted, check, self._certain))

    # ------------------------------------------------------------------ answers

    def conclude(self, answer: Answer) -> tuple[bool, str]:
        """Take an answer; whether it is good, and a line about it."""
        if answer.session != self._session.number:
            return False, "the session was reset during the solve: its result is dropped"
        # Solves that take longer than their period leave the processor free for half the time.
        self._rest_until_s = time.monotonic() + answer.seconds
        # The most of each rotation so far: of more poses, it would fall while somebody drives on.
        rotation = np.maximum(self._seen.rotation, answer.seen.rotation)
        self._seen, self._failure = replace(answer.seen, rotation=rotation), answer.failure
        self._session.calibrator.adopt(answer.time_offset)
        if answer.options:
            self._certain, self._told = {**self._certain, **answer.options}, answer.told
        if answer.check is not None:
            self.checks.take(answer.check)
        elif answer.is_checked:
            self._check_due_s = 0.0
        if answer.failure is not None:
            text = self._report(answer.failure)
            if answer.calibration is None:
                missing = what_is_missing(self._seen) if self._seen.n_poses else ""
                self.goal.wait(missing or answer.failure.what)
                self._keep_result(answer.failure)
                return False, text
        assert answer.calibration is not None
        told = tuple(dict.fromkeys((*self._told, *answer.calibration.warnings)))
        for warning in told:
            self._log.warning(warning)
        newest = self._with_findings(replace(answer.calibration, warnings=told))
        if newest.status is SolveStatus.CONTRADICTED:
            return self._refute(newest)
        if newest.status.failure:
            self._failure = Failure(newest.status.failure)
            self.goal.wait(f"No usable result: {newest.status.failure}.")
            self._keep_result(self._failure)
            return False, self._say(newest)
        return self._take(self._complete(newest))

    def _keep_result(self, failure: Failure) -> None:
        """Keep the result although the newest solve has failed."""
        if self._failing is None:
            self._failing_since_s = time.monotonic()
        self._failing = failure

    def _refute(self, newest: Calibration) -> tuple[bool, str]:
        """Take a calibration whose prior the motion contradicts: it replaces the result, so that
        what was found before is neither published nor saved any more.
        """
        self.goal.add(newest, self._seen, self.checks.faults())
        self._solved = self._submitted, self._certain
        self._set_result(newest)
        return False, self._say(newest)

    def _set_result(self, result: Calibration) -> None:
        self.result = result
        self._told_result = _result_state(result)
        self._solved_at_s = time.monotonic()
        self._failing = None

    def _take(self, newest: Calibration) -> tuple[bool, str]:
        """Take a usable calibration: it becomes the session's result, unless a better one that has
        reached the goal is kept.
        """
        was_done = self.goal.progress.done
        progress = self.goal.add(newest, self._seen, self.checks.faults())
        result = self.goal.best or newest
        if result is newest:
            self._solved = self._submitted, self._certain
        else:
            kept = f"kept is the result of {result.n_poses} poses, as the newest is worse"
            kept = f"{kept}: {describe(newest)}"
            self._log.info(kept, ONCE_S, key="kept")
            result = replace(result, warnings=(*result.warnings, kept))
            result = _with_halves_of(newest, result)
        self._set_result(self._with_findings(result))
        if not progress.is_faulty and progress.sentence:
            write = self._log.warning if progress.will_not_get_there else self._log.info
            write(progress.sentence, GOES_ON_S, key=f"now {progress.done}")
        every_s = GOES_ON_S if progress.done == was_done else 0.0
        is_good = result.status is SolveStatus.OK
        return is_good, self._say(self._with_findings(result), every_s)

    def _say(self, calibration: Calibration, every_s: float = GOES_ON_S) -> str:
        """A line about a calibration with its reasons and warnings. What is new of that is logged:
        the reasons once the motion has had its chance, as the progress says what to do before.
        """
        text, progress = describe(calibration), self.goal.progress
        self._log.info(text, every_s, key="result")
        is_final = progress.done or progress.will_not_get_there or calibration.status.failure
        said = []
        for reason in calibration.reasons:
            said.append(f"{reason.sentence}; {reason.what_to_do}")
            if is_final and not reason.is_finding:  # which are in the log already
                self._log.warning(f"{reason.verdict.value}: {said[-1]}")
                self._warned[reason.rule] = reason.sentence
        rules = {reason.rule for reason in calibration.reasons}
        for rule in self._warned.keys() - rules:
            self._log.info(f"no longer found: {self._warned.pop(rule)}")
        return "; ".join((text, *said, *calibration.warnings))

    def _with_findings(self, calibration: Calibration) -> Calibration:
        findings = self.checks.findings
        if calibration.measured != "poses":  # it has its own
            own = {(each.code, each.stream) for each in calibration.findings}
            others = [each for each in findings if (each.code, each.stream) not in own]
            lasting = [each for each in others if each.code in _OF_RAW_POSES]
            findings = gravest_first([*calibration.findings, *lasting])
        if calibration.findings == findings:
            return calibration
        return replace(calibration, findings=findings)

    def _report(self, failure: Failure) -> str:
        if failure.details:
            text = f"the solve failed unexpectedly: {failure.what}"
            self._log.error(f"{text}\n{failure.details}")
            return f"{text}; see the log"
        if failure.is_early:
            self._log.info(f"cannot solve yet: {failure.what}", ONCE_S)
        else:
            self._log.warning(f"cannot solve: {failure.what}")
        return failure.what

    # -------------------------------------------------------------------- state

    def extrinsic_state(
        self, accepts_poses: bool, tf_static: tuple[Broadcast, str]
    ) -> ExtrinsicState:
        """The result: what is missing, how good it is, how it was found. ``tf_static`` is what is
        done about that topic, and the reason.
        """
        seen, told = self._seen, self._told_result
        level, text = self._judged(accepts_poses, tf_static)
        contradictions = self.result.contradictions if self.result is not None else {}
        return ExtrinsicState(
            level=level,
            text=text,
            is_solving=self.is_solving,
            n_poses=seen.n_poses,
            path_m=seen.distance,
            motion_s=seen.motion_s,
            has_vehicle_axes=seen.has_vehicle_axes,
            rotation_deg=dict(zip("xyz", plain(np.degrees(seen.rotation)), strict=True)),
            tf_static=tf_static[0],
            tf_static_reason=tf_static[1],
            standing=self.standing,
            problem=self.problem,
            priors=priors_of(self._session.calibrator.config),
            contradicted=tuple(contradictions),
            result=told and replace(told, age_s=time.monotonic() - self._solved_at_s),
        )

    def _judged(self, accepts_poses: bool, tf_static: tuple[Broadcast, str]) -> tuple[Level, str]:
        """Level and message: the gravest that applies."""
        result, failure = self.result, self._failure
        if failure is not None and failure.details:
            return Level.ERROR, f"the solve failed unexpectedly, see the log: {failure.what}"
        if result is not None and self.problem:
            joint = ": " if self.standing is Standing.REFUTED else ", but "
            return Level.WARN, f"{result.verdict.value}{joint}{self.problem}"
        if not accepts_poses:
            return Level.WARN, "not accepting poses: call ~/set_enabled to go on"
        if result is None:
            said = [f"{Verdict.DO_NOT_USE.value}: {fault}" for fault in self.checks.faults()[:1]]
            said += [failure.what] if failure else []
            return Level.WARN, "; ".join(said) or "no result yet"
        if tf_static[0] is Broadcast.REFUSED and result.verdict is not Verdict.DO_NOT_USE:
            return Level.WARN, f"publish_tf is refused: {tf_static[1]}"
        if failure is not None:
            return Level.WARN, failure.what
        return Level.OK if result.verdict is Verdict.USE else Level.WARN, result.headline

    def progress_state(
        self, why_not_compared: str, pause: tuple[Level, str] = (Level.OK, "")
    ) -> ProgressState:
        """Each axis against its target, the seconds left, and what to do now; WARN while somebody
        should do something else than go on. ``why_not_compared`` with what is installed: empty if
        that was not asked for. ``pause`` is why no poses come in, and how grave that is.
        """
        progress, result = self.goal.progress, self.result
        is_well = self.standing is Standing.CURRENT and not progress.is_faulty
        may_go_on = is_well and not progress.will_not_get_there
        comparison = result.comparison if result is not None else None
        if comparison is None and why_not_compared:
            comparison = Comparison(sentence=f"not compared yet: {why_not_compared}")
        is_paused = bool(pause[1]) and not progress.done
        level = Level.OK if may_go_on else Level.WARN
        text = progress.sentence
        if not progress.is_faulty:
            text = self.problem or (pause[1] if is_paused else text)
        return ProgressState(
            level=max(level, pause[0]) if is_paused else level,
            text=text,
            is_paused=is_paused,
            progress=progress,
            comparison=comparison,
        )


def pause_of(inputs: Mapping[str, InputState], accepts_poses: bool) -> tuple[Level, str]:
    """Why the session gets no poses, and whether a person should act; no text if it gets some."""
    if not accepts_poses:
        return Level.WARN, "Paused: not accepting poses; call ~/set_enabled to go on."
    paused = {name: state for name, state in inputs.items() if state.is_paused}
    if not paused:
        return Level.OK, ""
    level = max(state.level for state in paused.values())
    longest_s = max(state.silent_s or 0.0 for state in paused.values())
    streams = listing([f"{name} ({state.topic})" for name, state in paused.items()])
    if len(paused) < len(inputs):
        level = Level.WARN
    remedy = "start its source again" if level > Level.OK else "go on driving, or save"
    return level, f"Paused: no pose of {streams} for {duration(longest_s)}; {remedy}."


def _with_halves_of(newest: Calibration, kept: Calibration) -> Calibration:
    """The result that is kept, with the comparison of both halves of the whole drive."""
    if newest.cross_check is None or kept.cross_check is None:
        return kept
    rows = {}
    for axis, row in kept.cross_check.items():
        newer = newest.cross_check[axis]
        excess = newer.excess_of_halves
        rows[axis] = replace(row, of_halves=newer.of_halves, excess_of_halves=excess)
    return replace(kept, cross_check=rows)


def is_refuted(result: Calibration) -> bool:
    """Whether the solve failed, or an error in the streams speaks against every axis."""
    return bool(result.status.failure) or any(each.makes_unusable for each in result.findings)


def priors_of(config: CalibratorConfig) -> dict[str, str]:
    """The priors that are set, by axis, as they were typed."""
    priors = {axis: getattr(config, f"prior_{axis}") for axis in AXES}
    return {axis: text for axis, text in priors.items() if text}


def _result_state(result: Calibration) -> ResultState:
    pose, sigmas = se3.xyz_rpy(result.T_parent_child), result.sigmas_printed
    return ResultState(
        parent_frame=result.parent_frame,
        child_frame=result.child_frame,
        verdict=result.verdict.value,
        status=result.status.value,
        reasons=tuple(f"{each.sentence}: {each.what_to_do}" for each in result.reasons),
        pose=by_axis(np.where(np.isfinite(sigmas), pose, np.nan)),
        pose_sigma=by_axis(sigmas),
        warnings=result.warnings,
        n_poses=result.n_poses,
        time_offset_s=result.time_offset_s,
        scale=result.scale,
        age_s=0.0,
    )


def describe(calibration: Calibration) -> str:
    """One line for a log: whose pose in whose frame, how good, from how much."""
    pose, sigmas = se3.xyz_rpy(calibration.T_parent_child), calibration.sigmas_printed
    xyz = ", ".join(f"{value:.4f}" for value in pose[:3])
    rpy = ", ".join(f"{value:.3f}" for value in np.degrees(pose[3:]))
    mm = ", ".join(f"{value:.1f}" for value in 1000 * sigmas[:3]).replace("inf", "unknown")
    deg = ", ".join(f"{value:.3f}" for value in np.degrees(sigmas[3:])).replace("inf", "unknown")
    return (
        f"{calibration.headline.rstrip('.')}. "
        f"{calibration.child_frame} in {calibration.parent_frame}: "
        f"xyz = ({xyz}) m +/- ({mm}) mm, rpy = ({rpy}) deg +/- ({deg}) deg; "
        f"status {calibration.status.value}; {calibration.method} {calibration.reference}"
        f": {calibration.n_poses} poses, {calibration.n_pairs} pairs, "
        f"{calibration.n_inliers} inliers"
    )
