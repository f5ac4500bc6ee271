"""A calibration on the screen: as text for people, as JSON for programs, and as an exit code."""

import argparse
import shlex
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hand_eye_calib.cli.console import as_typed, fail, note, typed_options, waiting_for
from hand_eye_calib.cli.reporting import (
    static_transform_command,
    with_cross_check,
    write_report,
)
from hand_eye_calib.cli.robot import with_robot, write_description
from hand_eye_calib.errors import printable
from hand_eye_calib.methods import METHODS
from hand_eye_calib.plain import json_text
from hand_eye_calib.results.calibration import Calibration, DofVerdict, Reason, Verdict
from hand_eye_calib.results.records import CrossCheck
from hand_eye_calib.results.verdict import shown
from hand_eye_calib.text import (
    amount,
    angle,
    axes_in_words,
    given_or_estimated,
    listing,
    with_sigma,
)

if TYPE_CHECKING:
    from hand_eye_calib.engine.evidence import Evidence
    from hand_eye_calib.engine.snapshot import Snapshot

_EXIT_FAILED, _EXIT_NOT_ALL = 1, 3

_WIDTH = 100

_ROTATIONS = ("roll", "pitch", "yaw")
_ROTATION_VECTOR = ("rx", "ry", "rz")
_VERDICTS = {
    DofVerdict.OBSERVED: "observed",
    DofVerdict.WEAK: "weak",
    DofVerdict.PRIOR: "mostly from the prior",
    DofVerdict.UNOBSERVABLE: "unobservable",
}
_PROOF = {
    "yes": ", proved to be the global minimum over them",
    "no": ", not proved to be the global minimum over them",
}
_SCATTER = {
    "of_methods": "scatter of other methods and references about it",
    "of_halves": "scatter of the two halves of the recording about it",
    "of_model": "difference between dnlo and adaptive",
}


def deliver(
    calibration: Calibration,
    arguments: argparse.Namespace,
    inputs: dict[str, Any],
    snapshot: "Snapshot | None" = None,
    **more: Any,
) -> int:
    """Print a calibration, save it if ``--out`` asks for that, and return the exit code.

    Parameters
    ----------
    calibration : Calibration
    arguments : argparse.Namespace
        With ``json`` and ``out``.
    inputs : dict
        Where the data came from, in plain values: part of the JSON document and of the saved file's
        provenance.
    snapshot : Snapshot, optional
        The poses and options that gave it. With them, ``--out`` also runs the cross-checks and
        writes the report.
    **more
        What else the JSON document holds.
    """
    calibration = with_robot(calibration, arguments)
    evidence: Evidence | None = None
    if arguments.out and snapshot is not None:
        with waiting_for("cross-checks with other methods and halves of the recording"):
            calibration, evidence = with_cross_check(calibration, snapshot)

    def save() -> Path:
        from hand_eye_calib.io.results import keep_earlier_results, save_result

        keep_earlier_results(arguments.out)
        return save_result(calibration, arguments.out, inputs)

    def finish() -> None:
        write_description(calibration, arguments)
        if evidence is not None and snapshot is not None:
            write_report(arguments.out, calibration, evidence, snapshot.config, inputs)

    code = exit_code(calibration)
    reasons = calibration.reasons[:1] if code == _EXIT_FAILED else ()
    return show(
        arguments,
        lambda: calibration.to_dict() | {"inputs": inputs} | more,
        lambda: as_text(calibration, next_steps(calibration, arguments, snapshot)),
        save=save,
        finish=finish,
        errors=[f"{one.sentence}; do not use this result, {one.what_to_do}" for one in reasons],
        code=code,
    )


def show(
    arguments: argparse.Namespace,
    document: Callable[[], Mapping[str, Any]],
    text: Callable[[], str],
    *,
    save: Callable[[], Path] | None = None,
    finish: Callable[[], None] | None = None,
    errors: Iterable[str] = (),
    code: int = 0,
) -> int:
    """Show what a command found, in the order of all commands; returns ``code``.

    Parameters
    ----------
    arguments : argparse.Namespace
        With ``json`` and ``out``.
    document, text : callable
        What ``--json`` prints, and what is printed otherwise.
    save : callable, optional
        Writes the files of ``--out``, before anything is printed; returns the most important one.
    finish : callable, optional
        Writes what takes longer, or may fail, after that.
    errors : iterable of str
        Lines for stderr, at the end.
    code : int
        The exit code.
    """
    if arguments.out and save is not None:
        note(f"wrote {save()}")
    print(json_text(document()) if arguments.json else text())
    sys.stdout.flush()
    if finish is not None:
        finish()
    for error in errors:
        fail(error, code)
    return code


def exit_code(calibration: Calibration) -> int:
    """0 good; 1 failed; 3 solved, but an axis is unobservable or the verdict is DO NOT USE."""
    if calibration.status.failure:
        return _EXIT_FAILED
    hidden = {*calibration.unobservable()} - {*calibration.out_of_reach}
    is_all = calibration.verdict is not Verdict.DO_NOT_USE and not hidden
    return 0 if is_all else _EXIT_NOT_ALL


def as_json(calibration: Calibration) -> str:
    """One JSON document: Calibration.to_dict()."""
    return json_text(calibration.to_dict())


def as_text(calibration: Calibration, steps: Iterable[str] = ()) -> str:
    """Everything a person needs to see: verdict and reasons, the extrinsic in both directions, what
    to do next, details.

    Parameters
    ----------
    calibration : Calibration
    steps : iterable of str
        What to do next: sentences, and commands that are indented.
    """
    parent, child = calibration.parent_frame, calibration.child_frame
    document = calibration.to_dict()
    lines = [
        calibration.headline,
        *_reason_lines(calibration),
        *_warning_lines(calibration),
        "",
        f"{child} in {parent}: maps coordinates of {child} into {parent}",
        *transform_lines(document["T_parent_child"], calibration.out_of_reach),
        "",
        f"{parent} in {child}: maps coordinates of {parent} into {child}",
        *transform_lines(document["T_child_parent"], calibration.out_of_reach),
        "",
        *_base_lines(calibration),
        *(["Next", *(f"  {step}" for step in steps), ""] if steps else []),
        *_publishing_lines(calibration),
        "Details",
        *(line for detail in _details(calibration) for line in wrapped(detail, "  ", "    ")),
    ]
    return "\n".join(printable(line) for line in lines)


def _base_lines(calibration: Calibration) -> Iterator[str]:
    """The child's pose in the base frame, if there is one."""
    if calibration.T_base_child is not None:
        yield f"{calibration.child_frame} in {calibration.base_frame}"
        document = calibration.to_dict()["T_base_child"]
        yield from transform_lines(document, calibration.out_of_reach)
        yield ""


def _details(calibration: Calibration) -> Iterator[str]:
    yield f"along and about the axes of {calibration.parent_frame}: {_observability(calibration)}"
    yield from _floor_lines(calibration)
    yield from _scatter_lines(calibration.cross_check)
    yield from _comparison_lines(calibration)
    yield from _solution_lines(calibration)


def _reason_lines(calibration: Calibration) -> Iterator[str]:
    for number, reason in enumerate(shown(calibration.reasons)):
        # What to do about the first one may follow the headline, which says why, at once.
        if number or not calibration.headline.endswith(reason.sentence):
            yield from wrapped(reason.sentence, "- ", "  ")
        yield from wrapped(_what_to_do(reason), "  -> ", "     ")


def _warning_lines(calibration: Calibration) -> Iterator[str]:
    for warning in calibration.warnings:
        yield from wrapped(f"Note: {warning}", "", "  ")


def _what_to_do(reason: Reason) -> str:
    options = typed_options(reason.options.items())
    return f"{reason.what_to_do}: {options}" if options else reason.what_to_do


def wrapped(text: str, first: str, others: str) -> list[str]:
    """Lines of a text, with what the first and what the others begin with."""
    return textwrap.wrap(
        printable(as_typed(text)),
        _WIDTH,
        initial_indent=first,
        subsequent_indent=others,
        break_on_hyphens=False,
        break_long_words=False,
    )


def next_steps(
    calibration: Calibration, arguments: argparse.Namespace, snapshot: "Snapshot | None"
) -> list[str]:
    """What to do next, in sentences and commands; empty if the result may be used."""
    if calibration.verdict is Verdict.USE:
        return []
    steps = []
    if snapshot is not None and (motion := _motion_advice(calibration, snapshot)):
        steps.append(motion)
    extra = [
        typed_options([option])
        for reason in shown(calibration.reasons)
        for option in reason.options.items()
    ]
    if calibration.verdict is not Verdict.DO_NOT_USE:
        reach = calibration.out_of_reach
        hidden = [axis for axis in calibration.unobservable() if axis not in reach]
        extra += [f"--prior {axis}=VALUE+/-SIGMA" for axis in hidden[:3]]
    if not extra and not arguments.out and calibration.measured == "poses":
        extra = ["--out result"]  # figures that show where the disagreement comes from
    typed = getattr(arguments, "typed", [])
    if typed and extra:
        steps.append(f"hand_eye_calib {shlex.join(typed)} {' '.join(dict.fromkeys(extra))}")
    return steps


def _motion_advice(calibration: Calibration, snapshot: "Snapshot") -> str:
    """What the recording does not show, and the motion that would."""
    from hand_eye_calib.assessment.excitation import excitation, what_is_missing

    if calibration.status.failure or calibration.verdict is Verdict.DO_NOT_USE:
        return ""
    if calibration.measured != "poses":
        return ""
    return what_is_missing(excitation(snapshot.pose_pairs()), calibration)


def convergence_line(entry: Mapping[str, Any]) -> str:
    """An entry of the history that ``replay --every`` makes, in one line."""
    calibration, at = entry["calibration"], f"after {entry['bag_time_s']:g} s:"
    if calibration is None:
        return f"{at} no estimate yet, {entry['reason']}"
    transform = calibration["T_parent_child"]
    position = _values("xyz", transform["translation"], 3)
    angles = _values(_ROTATIONS, transform["rpy_deg"], 2)
    poses, verdict = calibration["n_poses"], calibration["verdict"]
    return f"{at} {position} m, {angles} deg, {poses} poses, {verdict}"


def _values(names: Sequence[str], values: Sequence[float | None], decimals: int) -> str:
    return " ".join(
        f"{name} unknown" if value is None else f"{name} {value:.{decimals}f}"
        for name, value in zip(names, values, strict=True)
    )


def transform_lines(
    transform: Mapping[str, Any], out_of_reach: tuple[str, ...] = ()
) -> Iterator[str]:
    """A row for each number that is printed, with one standard deviation."""
    if set(out_of_reach) & set("xyz"):
        yield "  x, y and z are not estimated"
    else:
        sigmas_m = transform["sigma_translation"]
        for name, value, sigma in zip("xyz", transform["translation"], sigmas_m, strict=True):
            yield f"  {name:<6} {with_sigma(value, sigma, 3):>24} m"
    if set(out_of_reach) & set(_ROTATIONS):
        yield "  roll, pitch and yaw are not estimated"
        return
    names, kind, note_on = _ROTATIONS, "rpy", ""
    if "rotation_vector_deg" in transform:
        names, kind = _ROTATION_VECTOR, "rotation_vector"
        note_on = "  rotation vector: pitch is near +/-90 deg, where roll and yaw mean nothing"
        yield note_on
    angles, sigmas = transform[f"{kind}_deg"], transform[f"sigma_{kind}_deg"]
    for name, value, sigma in zip(names, angles, sigmas, strict=True):
        yield f"  {name:<6} {with_sigma(value, sigma, 2):>24} deg"
    quaternion = transform["quat_xyzw"]
    yield f"  quaternion {_values('xyzw', quaternion, 6) if quaternion else 'unknown'}"


def _observability(calibration: Calibration) -> str:
    """Axes by verdict: ``x, y and yaw observed; z unobservable``."""
    texts = []
    for verdict, words in _VERDICTS.items():
        names = [
            dof.name
            for dof in calibration.observability
            if dof.verdict is verdict and dof.name not in calibration.out_of_reach
        ]
        if names:
            texts.append(f"{listing(names)} {words}")
    if calibration.out_of_reach:
        texts.append(f"{listing(calibration.out_of_reach)} out of reach")
    return "; ".join(texts)


def _floor_lines(calibration: Calibration) -> Iterator[str]:
    """Errors that nothing in the recording shows."""
    if calibration.floor is not None and np.isfinite(calibration.sigmas).any():
        from hand_eye_calib.assessment.floor import FLOOR_ROTATION, FLOOR_SCALE, FLOOR_TILT

        sigmas = zip(calibration.observability, calibration.sigmas_of_floor, strict=True)
        told = [
            f"{axes_in_words([dof.name])} by {amount(dof.name, sigma)}"
            for dof, sigma in sigmas
            if np.isfinite(dof.sigma)
        ]
        yield (
            f"not in these standard deviations: a constant odometry error ({100 * FLOOR_SCALE:g} % "
            f"in scale, {angle(FLOOR_ROTATION)}, an axis of rotation tilted by "
            f"{angle(FLOOR_TILT)}) would change {', '.join(told)}"
        )


def _scatter_lines(cross_check: CrossCheck | None) -> Iterator[str]:
    """How far other answers to the same question scatter about the result."""
    for kind, title in _SCATTER.items() if cross_check else ():
        told = [
            f"{axis} {amount(axis, getattr(row, kind))}"
            for axis, row in (cross_check or {}).items()
            if getattr(row, kind) is not None
        ]
        if told:
            yield f"{title}: {', '.join(told)}"


def _comparison_lines(calibration: Calibration) -> Iterator[str]:
    """The goal of the session, and the comparison with what is installed."""
    if calibration.goal:
        yield f"the session: {calibration.goal.sentence}"
    if calibration.comparison:
        yield (
            f"compared with what is installed ({calibration.comparison.installed}): "
            f"{calibration.comparison.sentence}"
        )


def _solution_lines(calibration: Calibration) -> Iterator[str]:
    on = f"on reference {calibration.reference}"
    if not METHODS[calibration.method].uses_reference:
        on = "on all poses"
    yield (
        f"solved with {calibration.method} ({calibration.backend}) {on}: {calibration.n_inliers} "
        f"of {calibration.n_pairs} motion pairs are inliers, from {calibration.n_poses} poses; "
        f"objective {calibration.objective:.6g}{_PROOF.get(calibration.proved_global, '')}"
    )
    if calibration.method_reason:
        yield f"method {calibration.method_reason}"
    if calibration.reference_reason:
        yield f"reference {calibration.reference_reason}"
    yield from calibration.noise.in_words if calibration.noise else ()
    offset = (calibration.time_offset_s, calibration.time_offset_sigma_s)
    scale = (calibration.scale, calibration.scale_sigma)
    yield (
        f"time offset {given_or_estimated(*offset, 's')}; scale {given_or_estimated(*scale, '')}"
    )


def _publishing_lines(calibration: Calibration) -> Iterator[str]:
    """The command that publishes the result, under its verdict, if it is one to use."""
    if command := static_transform_command(calibration):
        yield f"To publish it ({_condition(calibration)})"
        yield f"  {command}"
        yield ""


def _condition(calibration: Calibration) -> str:
    numbers = calibration.usable_numbers().values()
    by_hand = [value for value in numbers if isinstance(value, str)]
    first = f", once you have put in {listing(by_hand)}" if by_hand else ""
    return f"{calibration.verdict.value}{first}"
