"""Output of a calibration: text for people, JSON for programs, and an exit code."""

import argparse
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hand_eye_calib.core.base.errors import ConfigError, printable
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.registry import RESULT_FILES
from hand_eye_calib.core.base.spelling import PLACEHOLDER, Interface
from hand_eye_calib.core.base.text import frame_name, listing, with_sigma
from hand_eye_calib.core.checks.findings import LIMITS
from hand_eye_calib.core.results.calibration import (
    Calibration,
    DofVerdict,
    Verdict,
)
from hand_eye_calib.core.results.document import (
    allowance_in_words,
    angles_in_words,
    extra_transforms,
    parts_of_sigmas,
    printed_numbers,
    summary,
    transforms_of,
    usable_numbers,
)
from hand_eye_calib.core.results.parts import advice_of, facts_of, part
from hand_eye_calib.core.results.records import (
    AXES,
    ROTATIONS,
    TRANSLATIONS,
    SolveStatus,
    has_error,
)
from hand_eye_calib.core.results.verdict import shown
from hand_eye_calib.offline.cli.options import (
    Exit,
    as_typed,
    command_with,
    fail,
    not_typed,
    note,
    print_result,
    typed_options,
    waiting_for,
)

if TYPE_CHECKING:
    from hand_eye_calib.core.engine.snapshot import Snapshot
    from hand_eye_calib.core.results.document import Notation

# Longest line of the text, in characters.
_WIDTH = 100

# Reasons why the streams determine neither translation nor rotation.
_WHY_NOT_ESTIMATED = {
    listing(
        TRANSLATIONS
    ): ": a stream of rotations or rates contains no positions",
    listing(ROTATIONS): ": a stream of positions contains no orientation",
}

# Ratio of two standard deviations of which the larger one needs an explanation.
_CLEARLY_LARGER = 1.2

# Verdicts on an axis that more motion may improve.
_IMPROVABLE = (DofVerdict.UNOBSERVABLE, DofVerdict.WEAK)


def deliver(
    calibration: Calibration,
    inputs: Document,
    arguments: argparse.Namespace,
    snapshot: "Snapshot | None" = None,
    bag: Path | None = None,
    pictures: Sequence[Callable[[Calibration], list[Any]]] = (),
) -> int:
    """Print a calibration, save it with ``--out``, and return the exit code.

    Parameters
    ----------
    calibration : Calibration
    inputs : dict
        Origin of the data, such as paths and topics, in plain values.
    arguments : argparse.Namespace
    snapshot : Snapshot, optional
        Poses and options of the calibration; None for the stops of an arm.
    bag : pathlib.Path, optional
        Bag whose transforms may contain the frame of ``--base-frame``.
    pictures : sequence of callable
        Functions that draw further figures of the report, given the calibration.
    """
    asks_for_robot = arguments.installed or arguments.base_frame
    if asks_for_robot and not calibration.status.failure:
        calibration = _with_robot(calibration, arguments, bag)
    if arguments.label:
        inputs = inputs | {"labels": dict(arguments.label)}
    note_about_files = ""
    if arguments.out:
        note_about_files = _saved(calibration, arguments.out, inputs)
    document = None
    steps: Sequence[str] = ()
    if arguments.json:
        document = calibration.to_dict() | {"inputs": inputs}
    else:
        steps = next_steps(calibration, arguments, snapshot)
    is_scale_free = snapshot is not None and snapshot.config.scale in (
        "estimate",
        "auto",
    )
    try:
        lines = as_lines(calibration, steps, arguments.verbose, is_scale_free)
        print_result(lines, document)
    # Write the report even if stdout was closed.
    finally:
        if arguments.out:
            note(note_about_files)
        if arguments.out and calibration.motion_residuals:
            from hand_eye_calib.offline.cli.reporting import write_report

            write_report(
                arguments.out, calibration, snapshot, inputs, pictures=pictures
            )
    _write_result_files(calibration, snapshot, arguments)
    return end([calibration])


def _write_result_files(
    calibration: Calibration,
    snapshot: "Snapshot | None",
    arguments: argparse.Namespace,
) -> None:
    """Write the files of extras that the user asked for."""
    for name, file in RESULT_FILES.items():
        if path := getattr(arguments, name, None):
            file.write(path, calibration, snapshot)
            note(f"wrote {path}")


def _saved(calibration: Calibration, directory: Path, inputs: Document) -> str:
    """Save a calibration, and return a note about the files."""
    from hand_eye_calib.formats import results

    kept = results.keep_earlier_results(directory)
    path = results.save_result(calibration, directory, inputs)
    names = [results.XACRO_NAME, results.LAUNCH_NAME]
    names += [
        file for name in calibration.parts for file in part(name).file_names
    ]
    beside = [name for name in names if path.with_name(name).exists()]
    for_robots = f", {listing(beside)}" if beside else ""
    return f"wrote {path}{for_robots}{kept}"


def _with_robot(
    calibration: Calibration, arguments: argparse.Namespace, bag: Path | None
) -> Calibration:
    """Return the calibration with the requested comparison and base frame.

    Raises
    ------
    ConfigError
        If the base frame is in none of the sources.
    """
    from hand_eye_calib.core.assessment.comparison import with_comparison
    from hand_eye_calib.formats.installed import (
        frames_of_bag,
        open_installed,
        read_urdf,
    )

    installed = arguments.installed
    base = frame_name(arguments.base_frame or "")
    if installed:
        frames = calibration.parent_frame, calibration.child_frame
        with waiting_for(f"reading {installed}"):
            calibration = with_comparison(
                calibration, open_installed(installed)(*frames)
            )
    if not base:
        return calibration
    if installed and Path(installed).suffix == ".urdf":
        tree = read_urdf(Path(installed))
    elif bag:
        tree = frames_of_bag(bag)
    else:
        raise ConfigError(
            "--base-frame needs --installed ROBOT.urdf: a description of the robot that has this "
            "frame"
        )
    T_base_parent = tree.pose(base, calibration.parent_frame)
    return replace(calibration, base_frame=base, T_base_parent=T_base_parent)


def end(calibrations: Sequence[Calibration]) -> int:
    """Print an error for each failed solve, and return the exit code of all results."""
    for calibration in calibrations:
        if calibration.has_failed:
            reason = calibration.reasons[0]
            sensor = (
                f"{calibration.child_frame}: " if len(calibrations) > 1 else ""
            )
            fail(
                f"{sensor}{reason.sentence}; do not use this result, {reason.advice}"
            )
    return gravest_code(map(exit_code, calibrations))


def gravest_code(codes: Iterable[int]) -> int:
    """Return the gravest of exit codes, in the order FAILED, NOT_ALL, GOOD."""
    distinct = {*codes}
    return Exit.FAILED if Exit.FAILED in distinct else max(distinct)


def exit_code(calibration: Calibration) -> int:
    """Return the exit code of a calibration: GOOD, FAILED or NOT_ALL, see :class:`Exit`."""
    if calibration.has_failed:
        return Exit.FAILED
    if calibration.hidden or calibration.verdict is Verdict.DO_NOT_USE:
        return Exit.NOT_ALL
    return Exit.GOOD


def as_lines(
    calibration: Calibration,
    steps: Sequence[str] = (),
    with_details: bool = False,
    is_scale_free: bool = False,
) -> list[str]:
    """Return the lines of a calibration for a person.

    The lines are, in this order: verdict and reasons, the extrinsic in both directions, the next
    steps, the command that publishes the extrinsic, and details such as the comparison with the
    installed extrinsic. ``with_details`` adds quaternions and facts about the solution.
    ``is_scale_free`` states that the scale was estimated at the user's request.
    """
    lines = [
        *verdict_lines(calibration),
        *_extrinsic_lines(calibration, with_details),
    ]
    lines += _clock_and_scale_lines(calibration, is_scale_free)
    if steps:
        lines += ["Next", *(f"  {step}" for step in steps)]
    lines += publish_lines(calibration)
    details = []
    for name, value in calibration.parts.items():
        details += part(name).details(value, calibration)
    if comparison := calibration.comparison:
        details.append(
            f"compared with the installed transform ({comparison.installed}): {comparison.sentence}"
        )
    if with_details:
        details += [
            f"{name}: {value}" for name, value in summary(calibration).items()
        ]
        details += facts_of(calibration)
    if details:
        lines.append("Details")
    for detail in details:
        lines += wrapped(detail, "  ", "    ")
    return lines


def publish_lines(calibration: Calibration) -> list[str]:
    """Return the command that publishes an extrinsic, or no lines if it must not be used."""
    command = calibration.static_transform_command()
    if not command:
        return []
    # An unknown number in the command is a text, such as X, for the user to replace.
    by_hand = [
        number
        for number in usable_numbers(calibration).values()
        if isinstance(number, str)
    ]
    condition = (
        f", after you have replaced {listing(by_hand)}" if by_hand else ""
    )
    return [
        f"To publish it ({calibration.verdict.value}{condition})",
        f"  {command}",
    ]


def _extrinsic_lines(calibration: Calibration, with_details: bool) -> list[str]:
    """Return the lines of the extrinsic in both directions, and of further transforms."""
    parent = calibration.parent_frame
    child = calibration.child_frame
    frames = {
        "T_parent_child": (child, parent),
        "T_child_parent": (parent, child),
        "T_base_child": (child, calibration.base_frame),
    }
    extra = extra_transforms(calibration)
    frames |= {
        name: (transform.source, transform.target)
        for name, transform in extra.items()
    }
    transforms = transforms_of(calibration)
    lines = []
    for name, (source, target) in frames.items():
        if name not in transforms:
            continue
        if name in extra and {*calibration.hidden} == {*AXES}:
            continue
        out_of_reach = () if name in extra else calibration.out_of_reach
        lines.append(
            f"{source} in {target}: maps coordinates of {source} into {target}"
        )
        if name == "T_parent_child" or with_details:
            lines += transform_lines(
                transforms[name], out_of_reach, with_details
            )
        else:
            lines += compact_lines(transforms[name], out_of_reach)
            lines += wrapped(_mixed_axes(transforms, name), "  ", "  ")
        if words := angles_in_words(transforms[name], calibration):
            lines += wrapped(words, "  ", "  ")
        if name == "T_parent_child":
            lines += allowance_lines(calibration)
    return lines


def _mixed_axes(transforms: "Mapping[str, Notation]", name: str) -> str:
    """Explain translations of the inverse that contain a part of an unknown axis; empty if none.

    The sensors are tilted against each other, so that an axis of the inverse mixes axes of the
    extrinsic.
    """
    if name != "T_child_parent":
        return ""
    sigmas_m = transforms["T_parent_child"].sigma_translation
    are_known = np.isfinite(sigmas_m)
    if are_known.all() or not are_known.any():
        return ""
    of_inverse_m = transforms[name].sigma_translation
    limit_m = _CLEARLY_LARGER * float(sigmas_m[are_known].max())
    mixed = []
    for axis, sigma_m in zip(TRANSLATIONS, of_inverse_m, strict=True):
        if limit_m < sigma_m < np.inf:
            mixed.append(axis)
    if not mixed:
        return ""
    unknown = [
        axis
        for axis, is_known in zip(TRANSLATIONS, are_known, strict=True)
        if not is_known
    ]
    verb = "depends" if len(mixed) == 1 else "depend"
    return (
        f"in this frame, {listing(mixed)} also {verb} on the unknown {listing(unknown)}: the "
        "frames are tilted against each other"
    )


def _clock_and_scale_lines(
    calibration: Calibration, is_scale_free: bool
) -> list[str]:
    """Return the lines about time offset and scale, which users of the child's data need.

    A scale near 1 is left out, unless it was estimated at the user's request.
    """
    lines = []
    child = calibration.child_frame
    if sigma_s := calibration.time_offset_sigma_s:
        offset = with_sigma(calibration.time_offset_s, sigma_s, 4)
        lines += wrapped(
            f"time offset {offset} s: applied here; other programs must add it to the stamps of "
            f"{child}",
            "",
            "  ",
        )
    is_far = abs(calibration.scale - 1.0) > LIMITS["model_scale"].note
    if calibration.scale_sigma and (is_far or is_scale_free):
        scale = with_sigma(calibration.scale, calibration.scale_sigma, 4)
        lines += wrapped(
            f"lengths of {child} times {scale}: applied here; other programs must do the same",
            "",
            "  ",
        )
    return lines


def verdict_lines(calibration: Calibration) -> Iterator[str]:
    """Yield the headline, the reasons with their advice, and the warnings."""
    yield calibration.headline
    in_headline = calibration.reasons_in_headline
    for number, reason in enumerate(shown(calibration.reasons)):
        # The headline may contain the sentence of the first reason. Then only its advice follows.
        if number or reason not in in_headline:
            yield from wrapped(reason.sentence, "- ", "  ")
        yield from wrapped(
            reason.advice_on(Interface.TERMINAL), "  -> ", "     "
        )
    for warning in calibration.warnings:
        yield from wrapped(f"Note: {warning}", "", "  ")


def wrapped(text: str, first: str, others: str) -> list[str]:
    """Return the lines of a wrapped text. ``first`` and ``others`` begin its lines."""
    return textwrap.wrap(
        printable(as_typed(text)),
        _WIDTH,
        initial_indent=first,
        subsequent_indent=others,
        break_on_hyphens=False,
        break_long_words=False,
    )


def next_steps(
    calibration: Calibration,
    arguments: argparse.Namespace,
    snapshot: "Snapshot | None",
) -> list[str]:
    """Return sentences and commands that improve the result; empty if the verdict is USE."""
    if calibration.verdict is Verdict.USE:
        return []
    steps = []
    if calibration.verdict is not Verdict.DO_NOT_USE:
        if motion := _missing_motion(calibration, snapshot):
            steps.append(motion)
        if axes := calibration.hidden:
            priors = typed_options(
                (f"prior.{axis}", PLACEHOLDER) for axis in axes
            )
            steps.append(
                f"measure {listing(axes)} by hand, then add {priors} with your values"
            )
    # If streams contradict each other or a prior, more of the same data does not help.
    is_contradicted = calibration.status is SolveStatus.CONTRADICTED
    if not is_contradicted and not has_error(calibration.findings):
        steps += advice_of(calibration)
    if options := _options_of_next_command(calibration, arguments, snapshot):
        steps.append(command_with(arguments.typed, options))
    return steps


def _options_of_next_command(
    calibration: Calibration,
    arguments: argparse.Namespace,
    snapshot: "Snapshot | None",
) -> dict[str, object]:
    """Return the options, by name, that the reasons propose and that are not set already."""
    from hand_eye_calib.core.engine.run import options_to_solve

    options: dict[str, object] = {}
    for reason in shown(calibration.reasons):
        options |= reason.options
    # An estimated scale has an uncertainty. The value of a time offset is kept, because its
    # estimate may fail.
    for found in calibration.findings:
        if "scale" in options and "scale" in found.options:
            options["scale"] = options_to_solve(found)["scale"]
    # An option that is set already has not repaired the streams. A command with a value that the
    # user must still measure would not run.
    current = snapshot.config.to_options() if snapshot else {}
    return {
        name: value
        for name, value in not_typed(arguments.typed, options).items()
        if value not in (PLACEHOLDER, current.get(name))
    }


def _missing_motion(
    calibration: Calibration, snapshot: "Snapshot | None"
) -> str:
    """Return the motion that would improve an axis; empty if there is none."""
    is_improvable = any(
        dof.verdict in _IMPROVABLE for dof in calibration.observability
    )
    if not is_improvable or snapshot is None or calibration.measured != "poses":
        return ""
    from hand_eye_calib.core.assessment.excitation import (
        excitation,
        what_is_missing,
    )

    return what_is_missing(excitation(snapshot.pose_pairs), calibration)


def allowance_lines(calibration: Calibration) -> list[str]:
    """Return lines about the allowance in the printed standard deviations, if there is one."""
    words = allowance_in_words(calibration)
    return wrapped(f"+/- is 1 sigma; {words}", "  ", "  ") if words else []


def transform_lines(
    transform: "Notation",
    out_of_reach: Sequence[str] = (),
    with_quaternion: bool = False,
) -> Iterator[str]:
    """Yield a row for each number of a transform, with the parts of its standard deviation."""
    parts = parts_of_sigmas(transform)
    for axis, number in printed_numbers(transform, out_of_reach).items():
        # A row for three axes, such as "x, y, z", has a text instead of a number.
        if "," in axis:
            yield f"  {axis} are {number}{_WHY_NOT_ESTIMATED[axis]}"
        else:
            sigma_parts = f"  ({parts[axis]})" if axis in parts else ""
            yield f"  {axis:<5} {number:>22}{sigma_parts}"
    if with_quaternion:
        quaternion = "unknown"
        if transform.quat_xyzw is not None:
            coefficients = zip("xyzw", transform.quat_xyzw, strict=True)
            quaternion = " ".join(
                f"{name} {value:.6f}" for name, value in coefficients
            )
        yield f"  quaternion {quaternion}"


def compact_lines(
    transform: "Notation", out_of_reach: Sequence[str] = ()
) -> Iterator[str]:
    """Yield three rows with two columns: x, y, z and roll, pitch, yaw."""
    numbers = printed_numbers(transform, out_of_reach)
    translations = _column(numbers, TRANSLATIONS, 1)
    rotations = _column(numbers, ROTATIONS, 5)
    for translation, rotation in zip(translations, rotations, strict=True):
        yield f"  {translation:<30}  {rotation}".rstrip()


def _column(
    numbers: Mapping[str, str], axes: Sequence[str], width: int
) -> list[str]:
    """Return three rows for three axes. A text about all three axes is in the second row."""
    if text := numbers.get(listing(axes)):
        return ["", f"{listing(axes)} are {text}", ""]
    return [f"{axis:<{width}} {numbers[axis]:>24}" for axis in axes]
