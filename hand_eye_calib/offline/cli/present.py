"""A calibration on the screen: as text for people, as JSON for programs, and as an exit code."""

import argparse
import shlex
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.core.base.errors import ConfigError, printable
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.text import frame_name, listing
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict, Verdict
from hand_eye_calib.core.results.document import (
    allowance_in_words,
    extra_transforms,
    parts_of_sigmas,
    printed_numbers,
    summary,
    transforms_of,
    usable_numbers,
)
from hand_eye_calib.core.results.parts import part
from hand_eye_calib.core.results.records import ROTATIONS, TRANSLATIONS
from hand_eye_calib.core.results.verdict import shown
from hand_eye_calib.offline.cli.options import (
    Exit,
    as_typed,
    fail,
    note,
    print_result,
    typed_options,
    waiting_for,
)

if TYPE_CHECKING:
    from hand_eye_calib.core.engine.snapshot import Snapshot
    from hand_eye_calib.core.results.document import Notation

_WIDTH = 100

# Verdicts on an axis that more motion would change.
_OPEN = (DofVerdict.UNOBSERVABLE, DofVerdict.WEAK)


def deliver(
    calibration: Calibration,
    inputs: Document,
    arguments: argparse.Namespace,
    snapshot: "Snapshot | None" = None,
    bag: Path | None = None,
) -> int:
    """Print a calibration, save it if ``--out`` asks for that, and return the exit code.

    ``inputs`` say where the data came from, in plain values. The snapshot has the poses and options
    that gave it, unless they were stops; the bag may have the base frame among its transforms.
    """
    if (arguments.installed or arguments.base_frame) and not calibration.status.failure:
        calibration = _with_robot(calibration, arguments, bag)
    if arguments.label:
        inputs = inputs | {"labels": dict(arguments.label)}
    if arguments.out:
        from hand_eye_calib.formats.results import keep_earlier_results, save_result

        kept = keep_earlier_results(arguments.out)
        note(f"wrote {save_result(calibration, arguments.out, inputs)}{kept}")
    steps = () if arguments.json else next_steps(calibration, arguments, snapshot)
    document = calibration.to_dict() | {"inputs": inputs} if arguments.json else None
    try:
        print_result(as_lines(calibration, steps, arguments.verbose), document)
    finally:  # even if the reader of what is printed has gone
        if arguments.out and calibration.motion_residuals:
            from hand_eye_calib.offline.cli.reporting import write_report

            write_report(arguments.out, calibration, snapshot, inputs)
    for one in calibration.reasons[:1] if calibration.has_failed else ():
        fail(f"{one.sentence}; do not use this result, {one.what_to_do}")
    return exit_code(calibration)


def _with_robot(
    calibration: Calibration, arguments: argparse.Namespace, bag: Path | None
) -> Calibration:
    """The result with its comparison with what is installed, and its pose in the base frame, if
    they were asked for.
    """
    installed = arguments.installed
    base = frame_name(arguments.base_frame or "")
    from hand_eye_calib.core.assessment.comparison import with_comparison
    from hand_eye_calib.formats.installed import frames_of_bag, open_installed, read_urdf

    if installed:
        frames = calibration.parent_frame, calibration.child_frame
        with waiting_for(f"reading {installed}"):
            calibration = with_comparison(calibration, open_installed(installed)(*frames))
    if not base:
        return calibration
    if installed and Path(installed).suffix == ".urdf":
        tree = read_urdf(Path(installed))
    elif bag:
        tree = frames_of_bag(bag)
    else:
        raise ConfigError("--base-frame needs --installed ROBOT.urdf: a description with the frame")
    T_base_parent = tree.pose(base, calibration.parent_frame)
    return replace(calibration, base_frame=base, T_base_parent=T_base_parent)


def exit_code(calibration: Calibration) -> int:
    """0 good; 1 failed; 3 solved, but an axis is unobservable or the verdict is DO NOT USE."""
    if calibration.has_failed:
        return Exit.FAILED
    is_whole = not calibration.hidden and calibration.verdict is not Verdict.DO_NOT_USE
    return Exit.GOOD if is_whole else Exit.NOT_ALL


def as_lines(
    calibration: Calibration, steps: Sequence[str] = (), with_details: bool = False
) -> list[str]:
    """What a person needs to see: verdict and reasons, the extrinsic in both directions, the steps
    to take next, the recordings, the goal of the session and the comparison with what is
    installed; with details also quaternions, and how it was solved.
    """
    parent = calibration.parent_frame
    child = calibration.child_frame
    transforms = transforms_of(calibration)
    lines = [*verdict_lines(calibration)]
    shown = [
        (child, parent, "T_parent_child"),
        (parent, child, "T_child_parent"),
        (child, calibration.base_frame, "T_base_child"),
    ]
    extra = extra_transforms(calibration)
    shown += [(added.source, added.target, name) for name, added in extra.items()]
    for source, target, name in shown:
        if name in transforms:
            reach = () if name in extra else calibration.out_of_reach
            lines.append(f"{source} in {target}: maps coordinates of {source} into {target}")
            lines += transform_lines(transforms[name], reach, with_details)
            if name == "T_parent_child":
                lines += allowance_lines(calibration)
    lines += ["Next", *(f"  {step}" for step in steps)] if steps else []
    if command := calibration.static_transform_command():
        by_hand = [each for each in usable_numbers(calibration).values() if isinstance(each, str)]
        condition = f", once you have put in {listing(by_hand)}" if by_hand else ""
        lines += [f"To publish it ({calibration.verdict.value}{condition})", f"  {command}"]
    details = []
    for name, value in calibration.parts.items():
        details += part(name).details(value, calibration.headline)
    if found := calibration.comparison:
        details.append(f"compared with what is installed ({found.installed}): {found.sentence}")
    if with_details:
        details += [f"{name}: {value}" for name, value in summary(calibration).items()]
    lines += ["Details"] * bool(details)
    return lines + [line for detail in details for line in wrapped(detail, "  ", "    ")]


def verdict_lines(calibration: Calibration) -> Iterator[str]:
    """Headline, reasons with what to do, and notes."""
    yield calibration.headline
    for number, reason in enumerate(shown(calibration.reasons)):
        # What to do about the first one may follow the headline, which says why, at once.
        if number or reason.sentence not in calibration.headline:
            yield from wrapped(reason.sentence, "- ", "  ")
        options = typed_options(reason.options.items())
        yield from wrapped(reason.what_to_do + (options and f": {options}"), "  -> ", "     ")
    for warning in calibration.warnings:
        yield from wrapped(f"Note: {warning}", "", "  ")


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
    options = [each for one in shown(calibration.reasons) for each in one.options.items()]
    extra = [typed_options([each]) for each in options]
    steps = []
    if calibration.verdict is not Verdict.DO_NOT_USE:
        is_open = any(dof.verdict in _OPEN for dof in calibration.observability)
        if is_open and snapshot is not None and calibration.measured == "poses":
            from hand_eye_calib.core.assessment.excitation import excitation, what_is_missing

            motion = what_is_missing(excitation(snapshot.pose_pairs), calibration)
            steps += [motion] if motion else []
        extra += [f"--prior {axis}=VALUE+/-SIGMA" for axis in calibration.hidden[:3]]
    if extra:
        typed = shlex.join(arguments.typed)
        steps.append(f"hand_eye_calib {typed} {' '.join(dict.fromkeys(extra))}")
    return steps


def allowance_lines(calibration: Calibration) -> list[str]:
    """What the printed standard deviations contain beside what the recording shows."""
    words = allowance_in_words(calibration)
    return [f"  +/- is 1 sigma; it {words}"] if words else []


def transform_lines(
    transform: "Notation", out_of_reach: Sequence[str] = (), with_details: bool = False
) -> Iterator[str]:
    """A row for each axis: the translation along it and an angle, with one standard deviation; with
    details a row for each number with the parts of its standard deviation, and the quaternion.
    """
    numbers = printed_numbers(transform, out_of_reach)
    if with_details:
        yield from _detailed_lines(transform, numbers)
        return
    columns = []
    for axes, width in ((TRANSLATIONS, 1), (ROTATIONS, 5)):
        told = numbers.get(listing(axes))
        rows = ["", f"{listing(axes)} are {told}", ""]
        columns.append(rows if told else [f"{each:<{width}} {numbers[each]:>24}" for each in axes])
    for metres, degrees in zip(*columns, strict=True):
        yield f"  {metres:<30}  {degrees}".rstrip()


def _detailed_lines(transform: "Notation", numbers: Mapping[str, str]) -> Iterator[str]:
    """A row for each number with the parts of its standard deviation, and the quaternion."""
    parts = parts_of_sigmas(transform)
    for axis, number in numbers.items():
        told = f" ({parts[axis]})" if axis in parts else ""
        verb = " are" if "," in axis else ""
        yield f"  {axis}{verb} {number}{told}"
    words = ["unknown"]
    if transform.quat_xyzw is not None:
        quaternion = zip("xyzw", transform.quat_xyzw, strict=True)
        words = [f"{name} {value:.6f}" for name, value in quaternion]
    yield f"  quaternion {' '.join(words)}"
