"""A calibration on the screen: as text for people, as JSON for programs, and as an exit code."""

import argparse
import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hand_eye_calib.calibration import Calibration, DofVerdict, SolveStatus
from hand_eye_calib.cli.console import fail, note, waiting_for
from hand_eye_calib.cli.publishing import static_transform_command
from hand_eye_calib.cli.reporting import with_cross_check, write_report
from hand_eye_calib.cli.robot import with_robot, write_description
from hand_eye_calib.cli.spelling import as_typed
from hand_eye_calib.errors import printable
from hand_eye_calib.report.words import given_or_estimated, listing, with_sigma

if TYPE_CHECKING:
    from hand_eye_calib.engine.snapshot import Snapshot

EXIT_CODES = {
    SolveStatus.OK: 0,
    SolveStatus.NOT_CONVERGED: 1,
    SolveStatus.CONTRADICTED: 1,
    SolveStatus.UNOBSERVABLE: 3,
}
_REMEDIES = {
    SolveStatus.NOT_CONVERGED: "record more varied motion",
    SolveStatus.CONTRADICTED: "check value, unit and sign of the prior",
}

_ROTATIONS = ("roll", "pitch", "yaw")
_ROTATION_VECTOR = ("rx", "ry", "rz")
_VERDICTS = {
    DofVerdict.OBSERVED: "observed",
    DofVerdict.WEAK: "weak",
    DofVerdict.PRIOR: "mostly from the prior",
    DofVerdict.UNOBSERVABLE: "unobservable",
}
_SCATTER = {
    "of_methods": "other methods and references",
    "of_halves": "the two halves of the recording",
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
    evidence = None
    calibration = with_robot(calibration, arguments)
    if arguments.out:
        from hand_eye_calib.io.results import keep_earlier_results, save_result

        if snapshot is not None:
            with waiting_for("cross-checks with other methods and halves of the recording"):
                calibration, evidence = with_cross_check(calibration, snapshot)
        keep_earlier_results(arguments.out)
        note(f"wrote {save_result(calibration, arguments.out, inputs)}")
    print(as_json(calibration, inputs=inputs, **more) if arguments.json else as_text(calibration))
    write_description(calibration, arguments)
    if evidence is not None and snapshot is not None:
        findings = more.get("findings", ())
        write_report(arguments.out, calibration, evidence, snapshot.config, inputs, findings)
    if failure := calibration.status.failure:
        fail(f"{failure}; do not use this result, {_REMEDIES[calibration.status]}", 1)
    return EXIT_CODES[calibration.status]


def as_json(calibration: Calibration, **more: Any) -> str:
    """One JSON document: Calibration.to_dict() and ``more``."""
    return json.dumps(calibration.to_dict() | more, indent=2, allow_nan=False)


def as_text(calibration: Calibration) -> str:
    """Everything a person needs to see, in several lines."""
    parent, child = (
        printable(frame) for frame in (calibration.parent_frame, calibration.child_frame)
    )
    document = calibration.to_dict()
    lines = [
        f"Status: {_status(calibration)}",
        *(f"Warning: {as_typed(warning)}" for warning in calibration.warnings),
        f"Pose of {child} (child) in {parent} (parent): maps coordinates of {child} into {parent}",
        *_transform_lines(document["T_parent_child"]),
        f"Pose of {parent} (parent) in {child} (child): maps coordinates of {parent} into {child}",
        *_transform_lines(document["T_child_parent"]),
        f"Along and about the axes of {parent}: {_observability(calibration)}",
        *_floor_lines(calibration),
        *_scatter_lines(calibration.cross_check),
        *_comparison_lines(calibration),
        *_solution_lines(calibration),
        *_publishing_lines(calibration),
    ]
    return "\n".join(printable(line) for line in lines)


def convergence_line(entry: Mapping[str, Any]) -> str:
    """An entry of the history that ``replay --every`` makes, in one line."""
    calibration, at = entry["calibration"], f"after {entry['bag_time_s']:g} s:"
    if calibration is None:
        return f"{at} no estimate yet, {entry['reason']}"
    transform = calibration["T_parent_child"]
    position = _values("xyz", transform["translation"], 3)
    angles = _values(_ROTATIONS, transform["rpy_deg"], 2)
    poses, status = calibration["n_poses"], calibration["status"]
    return f"{at} {position} m, {angles} deg, {poses} poses, {status}"


def _values(names: tuple[str, ...] | str, values: list[float], decimals: int) -> str:
    return " ".join(
        f"{name} {value:.{decimals}f}" for name, value in zip(names, values, strict=True)
    )


def _transform_lines(transform: Mapping[str, Any]) -> Iterator[str]:
    """A row for each number that is printed, with one standard deviation."""
    sigmas_m = transform["sigma_translation"]
    for name, value, sigma in zip("xyz", transform["translation"], sigmas_m, strict=True):
        yield f"  {name:<6} {with_sigma(value, sigma, 3):>24} m"
    names, kind, note_on = _ROTATIONS, "rpy", ""
    if "rotation_vector_deg" in transform:
        names, kind = _ROTATION_VECTOR, "rotation_vector"
        note_on = "  rotation vector: pitch is near +/-90 deg, where roll and yaw mean nothing"
        yield note_on
    angles, sigmas = transform[f"{kind}_deg"], transform[f"sigma_{kind}_deg"]
    for name, value, sigma in zip(names, angles, sigmas, strict=True):
        yield f"  {name:<6} {with_sigma(value, sigma, 2):>24} deg"
    yield f"  quaternion {_values(('x', 'y', 'z', 'w'), transform['quat_xyzw'], 6)}"


def _observability(calibration: Calibration) -> str:
    """Axes by verdict: ``x, y and yaw observed; z unobservable``."""
    texts = []
    for verdict, words in _VERDICTS.items():
        names = [dof.name for dof in calibration.observability if dof.verdict is verdict]
        if names:
            texts.append(f"{listing(names)} {words}")
    return "; ".join(texts)


def _floor_lines(calibration: Calibration) -> Iterator[str]:
    """Errors that nothing in the recording shows."""
    if calibration.floor is not None:
        from hand_eye_calib.assessment.floor import FLOOR_ROTATION, FLOOR_SCALE

        told = [
            f"{dof.name} {np.degrees(sigma):.2g} deg"
            if dof.name in _ROTATIONS
            else f"{dof.name} {sigma:.2g} m"
            for dof, sigma in zip(
                calibration.observability, calibration.sigmas_of_floor, strict=True
            )
            if np.isfinite(dof.sigma)
        ]
        yield (
            "Not in these standard deviations, because it is the same all the time: odometry that "
            f"is off by {FLOOR_SCALE:.0%} in scale and {np.degrees(FLOOR_ROTATION):.2g} deg: "
            f"{', '.join(told)}"
        )


def _scatter_lines(cross_check: Mapping[str, Mapping[str, Any]] | None) -> Iterator[str]:
    """How far other answers to the same question scatter about the result."""
    for kind, title in _SCATTER.items() if cross_check else ():
        told = [
            f"{axis} {np.degrees(row[kind]):.2g} deg"
            if axis in _ROTATIONS
            else f"{axis} {row[kind]:.2g} m"
            for axis, row in (cross_check or {}).items()
            if row[kind] is not None
        ]
        if told:
            yield f"Scatter of {title} (one standard deviation): {', '.join(told)}"


_PROOF = {
    "yes": ", proved to be the global minimum over them",
    "no": ", not proved to be the global minimum over them",
}


def _comparison_lines(calibration: Calibration) -> Iterator[str]:
    """The comparison with what is installed, and the pose in the base frame."""
    if calibration.comparison:
        yield (
            f"Compared with what is installed ({calibration.comparison.get('installed', '')}): "
            f"{calibration.comparison['sentence']}"
        )
    if calibration.T_base_child is not None:
        base = printable(calibration.base_frame)
        yield f"Pose of {printable(calibration.child_frame)} (child) in {base}:"
        yield from _transform_lines(calibration.to_dict()["T_base_child"])


def _solution_lines(calibration: Calibration) -> Iterator[str]:
    yield (
        f"Solved with {calibration.method} ({calibration.backend}) on reference "
        f"{calibration.reference}: {calibration.n_inliers} of {calibration.n_pairs} motion pairs "
        f"are inliers, from {calibration.n_poses} poses; objective {calibration.objective:.6g}"
        f"{_PROOF.get(calibration.proved_global, '')}"
    )
    if calibration.method_reason:
        yield f"  method {calibration.method_reason}"
    if calibration.reference_reason:
        yield f"  reference {calibration.reference_reason}"
    for line in (calibration.noise or {}).get("in_words", ()):
        yield f"  {line}"
    offset = (calibration.time_offset_s, calibration.time_offset_sigma_s)
    scale = (calibration.scale, calibration.scale_sigma)
    yield (
        f"  time offset {given_or_estimated(*offset, 's')}; scale {given_or_estimated(*scale, '')}"
    )


def _publishing_lines(calibration: Calibration) -> Iterator[str]:
    """The command that publishes the result, if it is one to use."""
    if calibration.status is SolveStatus.OK:
        yield "To publish it:"
        yield f"  {static_transform_command(calibration)}"
    elif unknown := calibration.unobservable():
        yield (
            f"No command to publish it, because {listing(unknown)} "
            f"{'is' if len(unknown) == 1 else 'are'} unknown. Record motion with rotations about "
            f"other axes, or measure by hand and give --prior {unknown[0]}=VALUE+/-SIGMA"
        )


def _status(calibration: Calibration) -> str:
    if calibration.status is SolveStatus.UNOBSERVABLE:
        names = calibration.unobservable()
        values = "its value" if len(names) == 1 else "their values"
        return f"unobservable: this motion does not determine {listing(names)}; do not use {values}"
    words = calibration.status.value.replace("_", " ")
    return f"{words}: do not use this result" if calibration.status.failure else words
