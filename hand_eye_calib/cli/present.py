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
from hand_eye_calib.cli.reporting import static_transform_command, with_cross_check, write_report
from hand_eye_calib.cli.robot import with_robot, write_description
from hand_eye_calib.errors import printable
from hand_eye_calib.methods import METHODS
from hand_eye_calib.plain import json_text
from hand_eye_calib.results.calibration import Calibration, Verdict
from hand_eye_calib.results.verdict import shown
from hand_eye_calib.text import (
    amount,
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
_OBSERVED = {"prior": "mostly from the prior"}
_PROOF = {
    "yes": ", proved to be the global minimum over them",
    "no": ", not proved to be the global minimum over them",
}
_SCATTER = {
    "of_methods": "scatter of other methods and references about it",
    "of_halves": "scatter of the two halves of the recording about it",
}


def deliver(
    calibration: Calibration,
    arguments: argparse.Namespace,
    inputs: dict[str, Any],
    snapshot: "Snapshot | None",
) -> int:
    """Print a calibration, save it if ``--out`` asks for that, and return the exit code.

    Parameters
    ----------
    calibration : Calibration
    arguments : argparse.Namespace
        With ``json``, ``out`` and ``verbose``.
    inputs : dict
        Where the data came from, in plain values: part of the JSON document and of the saved file's
        provenance.
    snapshot : Snapshot or None
        The poses and options that gave it. With them, ``--out`` also runs the cross-checks and
        writes the report. None for stops.
    """
    calibration = with_robot(calibration, arguments)
    if arguments.label:
        inputs = inputs | {"labels": dict(arguments.label)}
    evidence: Evidence | None = None
    if arguments.out and snapshot:
        with waiting_for("cross-checks with other methods and halves of the recording"):
            calibration, evidence = with_cross_check(calibration, snapshot)

    def save() -> Path:
        from hand_eye_calib.io.results import keep_earlier_results, save_result

        keep_earlier_results(arguments.out)
        return save_result(calibration, arguments.out, inputs)

    def finish() -> None:
        write_description(calibration, arguments)
        if evidence is not None and snapshot:
            write_report(arguments.out, calibration, evidence, snapshot.config, inputs)

    code = exit_code(calibration)
    reasons = calibration.reasons[:1] if code == _EXIT_FAILED else ()
    return show(
        arguments,
        lambda: calibration.to_dict() | {"inputs": inputs},
        lambda: as_text(
            calibration, next_steps(calibration, arguments, snapshot), arguments.verbose
        ),
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


def as_text(calibration: Calibration, steps: Sequence[str] = (), with_details: bool = False) -> str:
    """Everything a person needs to see: verdict and reasons, the extrinsic in both directions, what
    to do next.

    Parameters
    ----------
    calibration : Calibration
    steps : sequence of str
        What to do next: sentences, and commands that are indented.
    with_details : bool
        Also how it was solved.
    """
    parent, child = calibration.parent_frame, calibration.child_frame
    document, reach = calibration.to_dict(), calibration.out_of_reach
    lines = [calibration.headline]
    for number, reason in enumerate(shown(calibration.reasons)):
        # What to do about the first one may follow the headline, which says why, at once.
        if number or not calibration.headline.endswith(reason.sentence):
            lines += wrapped(reason.sentence, "- ", "  ")
        options = typed_options(reason.options.items())
        lines += wrapped(reason.what_to_do + (options and f": {options}"), "  -> ", "     ")
    for warning in calibration.warnings:
        lines += wrapped(f"Note: {warning}", "", "  ")
    for source, target, key in ((child, parent, "child"), (parent, child, "parent")):
        lines += ["", f"{source} in {target}: maps coordinates of {source} into {target}"]
        transform = document["T_parent_child" if key == "child" else "T_child_parent"]
        lines += transform_lines(transform, reach)
    if calibration.T_world_world is not None:
        worlds = f"{calibration.child_world_frame} in {calibration.parent_world_frame}"
        lines += ["", worlds, *transform_lines(document["T_world_world"])]
    if calibration.T_base_child is not None:
        lines += ["", f"{child} in {calibration.base_frame}"]
        lines += transform_lines(document["T_base_child"], reach)
    if steps:
        lines += ["", "Next", *(f"  {step}" for step in steps)]
    if command := static_transform_command(calibration):
        by_hand = [each for each in calibration.usable_numbers().values() if isinstance(each, str)]
        condition = f", once you have put in {listing(by_hand)}" if by_hand else ""
        lines += ["", f"To publish it ({calibration.verdict.value}{condition})", f"  {command}"]
    details = _details(calibration) if with_details else _comparisons(calibration)
    texts = [line for detail in details for line in wrapped(detail, "  ", "    ")]
    lines += ["", "Details", *texts] if texts else []
    return "\n".join(printable(line) for line in lines)


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
    is_poor = calibration.verdict is Verdict.DO_NOT_USE
    is_of_poses = calibration.measured == "poses"
    if calibration.verdict is Verdict.USE:
        return []
    steps = []
    if snapshot and is_of_poses and not is_poor and not calibration.status.failure:
        from hand_eye_calib.assessment.excitation import excitation, what_is_missing

        motion = what_is_missing(excitation(snapshot.pose_pairs()), calibration)
        steps += [motion] if motion else []
    extra = [
        typed_options([option])
        for reason in shown(calibration.reasons)
        for option in reason.options.items()
    ]
    if not is_poor:
        reach = calibration.out_of_reach
        hidden = [axis for axis in calibration.unobservable() if axis not in reach]
        extra += [f"--prior {axis}=VALUE+/-SIGMA" for axis in hidden[:3]]
        if not extra and not arguments.out and is_of_poses and snapshot:
            extra = ["--out result"]  # figures that show where the disagreement comes from
    if extra:
        typed = shlex.join(arguments.typed)
        steps.append(f"hand_eye_calib {typed} {' '.join(dict.fromkeys(extra))}")
    return steps


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
    names, kind = _ROTATIONS, "rpy"
    if "rotation_vector_deg" in transform:
        names, kind = ("rx", "ry", "rz"), "rotation_vector"
        yield "  rotation vector: pitch is near +/-90 deg, where roll and yaw mean nothing"
    angles, sigmas = transform[f"{kind}_deg"], transform[f"sigma_{kind}_deg"]
    for name, value, sigma in zip(names, angles, sigmas, strict=True):
        yield f"  {name:<6} {with_sigma(value, sigma, 2):>24} deg"
    quaternion = transform["quat_xyzw"] or ()
    told = " ".join(f"{name} {value:.6f}" for name, value in zip("xyzw", quaternion, strict=False))
    yield f"  quaternion {told or 'unknown'}"


# --------------------------------------------------------------------- details


def _details(calibration: Calibration) -> Iterator[str]:
    yield f"along and about the axes of {calibration.parent_frame}: {_observability(calibration)}"
    yield from _floor(calibration)
    for kind, title in _SCATTER.items() if calibration.cross_check else ():
        told = [
            f"{axis} {amount(axis, getattr(row, kind))}"
            for axis, row in (calibration.cross_check or {}).items()
            if getattr(row, kind) is not None
        ]
        if told:
            yield f"{title}: {', '.join(told)}"
    yield from _comparisons(calibration)
    yield from _solution(calibration)


def _observability(calibration: Calibration) -> str:
    """Axes by verdict: ``x, y and yaw observed; z unobservable``."""
    groups: dict[str, list[str]] = {}
    for dof in calibration.observability:
        if dof.name not in calibration.out_of_reach:
            word = _OBSERVED.get(dof.verdict.value, dof.verdict.value)
            groups.setdefault(word, []).append(dof.name)
    if calibration.out_of_reach:
        groups["out of reach"] = [*calibration.out_of_reach]
    return "; ".join(f"{listing(names)} {words}" for words, names in groups.items())


def _floor(calibration: Calibration) -> Iterator[str]:
    """Errors that nothing in the recording shows."""
    if calibration.floor is not None and np.isfinite(calibration.sigmas).any():
        sigmas = zip(calibration.observability, calibration.sigmas_with_floor, strict=True)
        told = [
            f"{axes_in_words([dof.name])} {amount(dof.name, sigma)}"
            for dof, sigma in sigmas
            if np.isfinite(dof.sigma)
        ]
        yield (
            "standard deviations with constant odometry errors, which no recording shows: "
            f"{', '.join(told)}"
        )


def _comparisons(calibration: Calibration) -> Iterator[str]:
    """The recordings, the goal of the session, and the comparison with what is installed."""
    if calibration.together:
        yield calibration.together.sentence
        for one in calibration.together.recordings:
            told = f"left out, {one.left_out}" if one.left_out else one.headline
            yield f"{one.name}: {told}"
    if calibration.goal:
        yield f"the session: {calibration.goal.sentence}"
    if calibration.comparison:
        yield (
            f"compared with what is installed ({calibration.comparison.installed}): "
            f"{calibration.comparison.sentence}"
        )


def _solution(calibration: Calibration) -> Iterator[str]:
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
    yield f"time offset {given_or_estimated(*offset, 's')}; scale {given_or_estimated(*scale, '')}"
    if (rate := calibration.clock_rate) and rate.is_used:
        yield f"the child's clock is {rate}: the time offset holds at {rate.at_ns * 1e-9:.3f} s"
