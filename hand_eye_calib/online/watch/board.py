"""Convert the state of a node into what ``watch`` displays: words, signs and bars.

A :class:`Board` stores the newest state of a node and makes a :class:`View` from it. This module
does not depend on ROS, a terminal or a browser.
"""

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.core.base.plain import from_plain
from hand_eye_calib.core.base.text import duration
from hand_eye_calib.core.results.records import AXES, ROTATIONS
from hand_eye_calib.online.live.progress import AXIS_KEYS
from hand_eye_calib.online.live.state import (
    REPORT_PERIOD_S,
    Broadcast,
    ChecksState,
    ExtrinsicState,
    InputState,
    Level,
    MountState,
    NodeState,
    Part,
    Standing,
)
from hand_eye_calib.online.watch.axes import bar_of, mount_line, pose_values
from hand_eye_calib.online.watch.headline import (
    DONE,
    MOVED,
    headline_of,
    saved_at,
    typeset,
)
from hand_eye_calib.online.watch.view import AxisTexts, Line, Texts, Tone, View

# A node is silent if its newest state is older than this (s), which is three missing reports.
_SILENT_AFTER_S = 3.5 * REPORT_PERIOD_S

# Smallest displayed age (s) of a result.
_MIN_AGE_S = 30.0

# Time (s) for which the answer to a button remains displayed.
_ANSWER_FOR_S = 20.0

# Tone of each level, verdict, verdict of a comparison, and state of a broadcast.
_TONES: dict[object, Tone] = {
    **dict.fromkeys((Level.OK, "USE", "same", Broadcast.ON), Tone.GOOD),
    **dict.fromkeys(
        (
            Level.WARN,
            "USE WITH CARE",
            "moved",
            Broadcast.REFUSED,
            Broadcast.WITHDRAWN,
        ),
        Tone.ACT,
    ),
    **dict.fromkeys((Level.ERROR, "DO NOT USE"), Tone.BAD),
    Broadcast.WAITING: Tone.BUSY,
}

# States of a broadcast in words, if they differ from the values.
_BROADCASTS = {
    Broadcast.ON: "yes, as a static transform",
    Broadcast.WITHDRAWN: "no longer; programs that received it keep it until they restart",
}

# The board displays the solver's reason in these states, because no newest result explains them.
_WITHOUT_RESULT = (Standing.NONE, Standing.OUTDATED)

# Units of typed values without a unit.
_TYPED_UNITS = {axis: "deg" if axis in ROTATIONS else "m" for axis in AXES}


class Board:
    """Stores the newest state of one node, and makes views from it. Several threads may use it.

    Parameters
    ----------
    wanted : str
        Fully qualified name of the node. If empty, the first node that sends a state is displayed.
        When it is silent and another node sends a state, the display changes to this node.

    Attributes
    ----------
    topics : tuple of str
        A line for each topic with poses that the displayed node does not use.
    shared_names : frozenset of str
        Names that several nodes have. Their states alternate, and a request may reach any of them.
    """

    def __init__(self, wanted: str = "") -> None:
        self.topics: Texts = ()
        self.shared_names: frozenset[str] = frozenset()
        self._wanted = wanted
        # State and answer, each with its time (s). Each pair is one tuple and replaced as a whole,
        # so that no thread combines a state with another time.
        self._newest: tuple[NodeState, float] | None = None
        self._answer: tuple[Line, float] | None = None
        # Acknowledged alarm: its node and its start (ns).
        self._acknowledged: tuple[str, int | None] | None = None

    @property
    def priors(self) -> Texts:
        """Axes of the displayed node that have a prior."""
        return tuple(dict(_priors_of(self._newest[0]))) if self._newest else ()

    @property
    def inputs(self) -> Texts:
        """Topics that the displayed node uses."""
        if self._newest is None:
            return ()
        return tuple(stream.topic for stream in self._newest[0].inputs.values())

    @property
    def node(self) -> str:
        """Fully qualified name of the displayed node; empty before its first state."""
        return self._newest[0].node if self._newest else ""

    def take(self, state: NodeState, now_s: float) -> None:
        """Store a state; ignore it if another node is displayed.

        ``now_s`` is the time (s) on a steady clock at which the state was received.
        """
        if self._wanted:
            is_displayed = state.node == self._wanted
        else:
            is_silent = (
                not self._newest or now_s - self._newest[1] > _SILENT_AFTER_S
            )
            is_displayed = is_silent or state.node == self.node
        if is_displayed:
            self._newest = state, now_s

    def answer(
        self, request: str, good: bool | None, text: str, now_s: float
    ) -> None:
        """Store the answer to a request. ``good`` is None until the answer arrives."""
        tones = {None: Tone.BUSY, True: Tone.GOOD, False: Tone.ACT}
        self._answer = Line(tones[good], request, text), now_s

    def acknowledge(self) -> None:
        """Mark the present alarm of the mount as acknowledged, until another alarm begins."""
        self._acknowledged = (
            _alarm_of(self._newest[0]) if self._newest else None
        )

    def view(self, now_s: float) -> View:
        """Return the view at a time ``now_s`` (s), on the clock of :meth:`take`."""
        if self._newest is None:
            name = self._wanted or "a calibrator"
            text = f"No message from {name} yet. Is the node running, on the same ROS domain and "
            return View(
                self._wanted, Tone.UNKNOWN, "NO NODE", f"{text}network?"
            )
        state, received_s = self._newest
        if state.node in self.shared_names:
            return _of_shared_name(state.node)
        view = _view(state, now_s - received_s)
        if view.word == MOVED and _alarm_of(state) == self._acknowledged:
            view = replace(
                view,
                tone=Tone.ACT,
                advice="Check the mount, then recalibrate.",
                facts=f"{view.facts}; acknowledged",
                buttons=("recalibrate", "reset"),
                asked="recalibrate",
            )
        if _lacks_messages(state):
            view = replace(view, topics=self.topics)
        if self._answer and now_s - self._answer[1] < _ANSWER_FOR_S:
            view = replace(view, answer=self._answer[:1])
        return view


def _of_shared_name(node: str) -> View:
    """Return the view of several nodes with one name, without their values and without buttons."""
    return View(
        node,
        Tone.ACT,
        "CHECK INPUT",
        f"Two nodes are named {node}.",
        "Stop one of them, or set another ROS_DOMAIN_ID.",
    )


def _alarm_of(state: NodeState) -> tuple[str, int | None]:
    """Return node and start (ns) of an alarm of the mount. They identify the alarm."""
    return state.node, state.mount.since_ns if state.mount else None


def _lacks_messages(state: NodeState) -> bool:
    """Return whether an input has no message yet; its topic may have another name."""
    return any(stream.messages == 0 for stream in state.inputs.values())


def _priors_of(state: NodeState) -> AxisTexts:
    """Return the axes with a prior, and the priors as typed by the user."""
    if state.extrinsic is None:
        return ()
    priors = state.extrinsic.priors
    return tuple((axis, priors[axis]) for axis in AXES if axis in priors)


def _view(state: NodeState, silent_s: float) -> View:
    """Return the view of a state that was received ``silent_s`` seconds ago."""
    is_silent = silent_s > _SILENT_AFTER_S
    is_old = state.has_ended or is_silent
    headline = headline_of(state, silent_s if is_silent else 0.0)
    view = View(
        state.node,
        headline.tone,
        headline.word,
        headline.sentence,
        headline.advice,
        asked="" if is_old else headline.request,
        health=() if state.has_ended else tuple(_health(state, is_old)),
        saved_in=state.saved.directory if state.saved else "",
    )
    if state.mount is not None:
        return _with_mount(view, state.mount, state.has_ended)
    view = _with_result(view, state)
    view = replace(view, facts=_facts(state, is_old))
    if progress := state.progress:
        bars = tuple(bar_of(axis, progress, state.extrinsic) for axis in AXES)
        view = replace(view, bars=bars)
    if is_old:
        return view
    return replace(
        view,
        priors=_priors_of(state),
        by_hand=_axes_by_hand(state),
        buttons=_buttons(state, view.asked),
    )


def _with_result(view: View, state: NodeState) -> View:
    """Add the result to the view of a calibrating node. A refuted result has no pose."""
    view = replace(view, result=tuple(_result(state, view)))
    if result := state.result:
        pose_of = f"of {result.child_frame} in {result.parent_frame}"
        view = replace(view, reasons=result.reasons, pose_of=pose_of)
        if state.standing is not Standing.REFUTED:
            values = tuple(pose_values(result))
            view = replace(view, title=f"pose {pose_of}", values=values)
    return view


def _with_mount(view: View, mount: MountState, has_ended: bool) -> View:
    """Add the mount to the view of a node that monitors the mount."""
    facts = f"{duration(mount.seconds_of_motion)} of motion seen"
    if mount.since_ns and mount.newest_ns:
        since = duration((mount.newest_ns - mount.since_ns) * 1e-9)
        facts = f"{since} ago"
        if has_ended:
            facts = f"moved {since} before the last motion"
    view = replace(
        view,
        facts=facts,
        watched=tuple(mount_line(axis, mount) for axis in AXES),
    )
    if view.word != MOVED:
        return view
    buttons = ("recalibrate", "acknowledge", "reset")
    return replace(
        view, facts=f"{facts}; a reset ends the alarm", buttons=buttons
    )


def _buttons(state: NodeState, asked: str) -> Texts:
    """Return the possible requests to a calibrating node, the recommended request first.

    ``asked`` is the request that the headline recommends; empty if there is none.
    """
    buttons: Texts = ("reset",)
    if state.result and state.extrinsic and state.extrinsic.contradicted:
        buttons = ("solve", "reset")
    elif state.result:
        buttons = ("solve", "save", "reset")
    if state.extrinsic and state.extrinsic.priors:
        buttons += ("forget",)
    return tuple(sorted(buttons, key=lambda request: request != asked))


def _axes_by_hand(state: NodeState) -> Texts:
    """Return axes whose prior a person may set, correct or remove, in order of importance.

    The order is: axes whose prior contradicts the motion, axes that the present motion cannot
    determine, and other axes with a prior.
    """
    extrinsic = state.extrinsic
    if extrinsic is None or state.progress is None:
        return ()
    progress = state.progress.progress
    axes = [*extrinsic.contradicted, *progress.by_hand]
    if progress.will_not_get_there and not progress.target_is_too_small:
        axes += [
            axis
            for axis, key in AXIS_KEYS.items()
            if key == progress.limiting_axis
        ]
    axes += extrinsic.priors
    return tuple(axis for axis in dict.fromkeys(axes) if axis in AXES)


def _facts(state: NodeState, is_old: bool) -> str:
    """Return path length, duration of motion and age of the result; empty without poses.

    The age is of interest while solves take long, but not while the session is paused.
    """
    extrinsic = state.extrinsic
    if extrinsic is None or not extrinsic.n_poses:
        return ""
    facts = (
        f"{extrinsic.path_m:,.0f} m, {duration(extrinsic.motion_s)} of motion"
    )
    is_paused = any(stream.is_paused for stream in state.inputs.values())
    is_refuted = extrinsic.standing is Standing.REFUTED
    is_without_age = is_old or is_paused or is_refuted
    result = extrinsic.result
    if result and result.age_s >= _MIN_AGE_S and not is_without_age:
        facts += f", result {duration(result.age_s)} old"
    if extrinsic.standing is Standing.OUTDATED:
        facts += ", newer solves fail"
    return facts


def _health(state: NodeState, is_old: bool) -> Iterator[Line]:
    """Yield a line for each input, for the stream checks and for the journal.

    Without a result, a line of the solver contains the reason, if there is one.
    Lines of an old state have no tones, because conditions may have changed.
    """
    for name, part in state.parts():
        has_problem = part.level is not Level.OK and part.text
        if (
            name == "extrinsic"
            and state.standing in _WITHOUT_RESULT
            and has_problem
        ):
            yield Line(
                Tone.UNKNOWN if is_old else Tone.ACT, "solver", part.text
            )
        if name in ("extrinsic", "progress", "mount"):
            continue
        text = part.text
        if isinstance(part, InputState) and part.topic not in text:
            text = f"{text}, {part.topic}"
        yield Line(Tone.UNKNOWN if is_old else _tone_of(part), name, text)


def _tone_of(part: Part) -> Tone:
    """Return the tone of the line of an input, of the checks or of the journal."""
    # Before the first check the level is WARN, but nobody needs to act.
    if isinstance(part, ChecksState) and part.age_s is None:
        return Tone.BUSY
    tone = _TONES[part.level]
    # A parked robot has no poses, but nobody needs to act.
    if isinstance(part, InputState) and part.is_paused and tone is Tone.GOOD:
        return Tone.BUSY
    return tone


def _result(state: NodeState, view: View) -> Iterator[Line]:
    """Yield the lines of the result: verdict, warnings, priors, comparison, broadcast and files.

    ``view`` has the headline. When a session is DONE, lines with evidence follow the warnings.
    """
    result = state.result
    verdict = result.verdict if result else "no result yet"
    yield Line(_TONES.get(verdict, Tone.UNKNOWN), "verdict", verdict)
    if result:
        for warning in result.warnings:
            yield Line(Tone.ACT, "note", typeset(warning))
        if view.word == DONE and result.angles:
            yield Line(Tone.BUSY, "angles", typeset(result.angles))
        # The reasons of another verdict contain the same numbers.
        if view.word == DONE and result.verdict == "USE":
            for fact in result.facts:
                yield Line(Tone.GOOD, "evidence", typeset(fact))
    yield from _prior_lines(state)
    if state.progress and (comparison := state.progress.comparison):
        tone = _TONES.get(comparison.verdict, Tone.UNKNOWN)
        yield Line(
            tone,
            "compared with the installed transform",
            typeset(comparison.sentence),
        )
    if state.extrinsic and state.extrinsic.tf_static is not Broadcast.OFF:
        yield _broadcast(state.extrinsic, state.has_ended)
    if state.saved:
        # At the end, the headline is about the saved result.
        tone = view.tone
        if not state.has_ended:
            tone = _TONES.get(state.saved.verdict, Tone.GOOD)
        yield Line(
            tone, "saved", f"{saved_at(state.saved)}: {state.saved.text}"
        )


def _prior_lines(state: NodeState) -> Iterator[Line]:
    """Yield a line for each prior that is set."""
    contradicted = state.extrinsic.contradicted if state.extrinsic else ()
    for axis, prior in _priors_of(state):
        text = f"{axis} = {prior.replace('+/-', ' ± ')}"
        if not any(character.isalpha() for character in prior):
            text = f"{text} {_TYPED_UNITS[axis]}"
        if axis in contradicted:
            yield Line(Tone.BAD, "typed in", f"{text}: contradicts the motion")
        else:
            yield Line(Tone.BUSY, "typed in", text)


def _broadcast(extrinsic: ExtrinsicState, has_ended: bool) -> Line:
    """Return the line about the broadcast of the result to other programs."""
    tone = _TONES[extrinsic.tf_static]
    text = _BROADCASTS.get(extrinsic.tf_static, extrinsic.tf_static.value)
    if extrinsic.tf_static_reason:
        text += f": {extrinsic.tf_static_reason}"
    if has_ended:
        tone = Tone.ACT
        text = "nothing: the node has ended"
    return Line(tone, "sent to other programs", text)


def state_of(text: str) -> NodeState | None:
    """Return the state of a node from its JSON, without control characters.

    Any program may publish on the topic. The result is None if the text is no state, is the state
    of another version, or has values that cannot be displayed.
    """
    try:
        state = from_plain(NodeState, _printable(json.loads(text)))
        # Make a view as a trial. It raises an error for values that cannot be displayed.
        _view(state, 0.0)
    except (
        TypeError,
        ValueError,
        KeyError,
        RecursionError,
        OverflowError,
        OSError,
    ):
        return None
    return state


def _printable(value: Any) -> Any:
    """Return plain data with all control characters of texts and keys escaped."""
    if isinstance(value, dict):
        return {printable(key): _printable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_printable(item) for item in value]
    return printable(value) if isinstance(value, str) else value
