"""A calibration on the screen: as text for people, as JSON for programs, and as an exit code."""

import json

import numpy as np

from hand_eye_calib.calibration import DofVerdict, SolveStatus
from hand_eye_calib.cli.console import fail, note, waiting_for
from hand_eye_calib.cli.publishing import static_transform_command
from hand_eye_calib.cli.reporting import with_consistency, write_report

EXIT_CODES = {SolveStatus.OK: 0, SolveStatus.NOT_CONVERGED: 1, SolveStatus.UNOBSERVABLE: 3}

_ROTATIONS = ("roll", "pitch", "yaw")


def deliver(calibration, arguments, inputs, snapshot=None, **more):
    """Print a calibration, save it where ``--out`` asks for that, and return the exit code.

    Parameters
    ----------
    calibration : Calibration
    arguments : argparse.Namespace
        With ``json`` and ``out``.
    inputs : dict
        Where the data came from, in plain values: part of the JSON document and of the saved file's
        provenance.
    snapshot : Snapshot, optional
        The poses and options that gave it: with them, ``--out`` also asks other methods and writes
        the report.
    **more
        What else the JSON document holds.
    """
    evidence = None
    if arguments.out:
        from hand_eye_calib.io.results import save_result

        if snapshot is not None:
            with waiting_for("asking other methods and the drive's halves"):
                calibration, evidence = with_consistency(calibration, snapshot)
        note(f"wrote {save_result(calibration, arguments.out, inputs)}")
    print(as_json(calibration, inputs=inputs, **more) if arguments.json else as_text(calibration))
    if evidence is not None:
        write_report(
            arguments.out, calibration, evidence, snapshot.config, inputs, more.get("findings", ())
        )
    if calibration.status is SolveStatus.NOT_CONVERGED:
        fail("the solver did not converge; do not use this result, record more varied motion", 1)
    return EXIT_CODES[calibration.status]


def as_json(calibration, **more):
    """One JSON document: Calibration.to_dict() and ``more``."""
    return json.dumps(calibration.to_dict() | more, indent=2, allow_nan=False)


def as_text(calibration):
    """Everything a person needs to see, in several lines."""
    parent, child = calibration.parent_frame, calibration.child_frame
    document = calibration.to_dict()
    lines = [
        f"Pose of {child} (child) in {parent} (parent)",
        *_transform_lines(document["T_parent_child"]),
        f"Pose of {parent} (parent) in {child} (child)",
        *_transform_lines(document["T_child_parent"]),
        f"One standard deviation of the pose of {child}, along and about the axes of {parent}",
        *(_observability_line(dof) for dof in calibration.observability),
        *_consistency_lines(calibration.consistency),
        f"Solved with {calibration.method} ({calibration.backend}) on reference {calibration.reference}: "
        f"{calibration.n_inliers} of {calibration.n_pairs} motion pairs are inliers, from {calibration.n_poses} poses; "
        f"objective {calibration.objective:.6g}",
        *([f"  reference {calibration.reference_reason}"] if calibration.reference_reason else []),
        *(f"  {line}" for line in (calibration.noise or {}).get("in_words", ())),
        f"  time offset {_with_sigma(calibration.time_offset_s, calibration.time_offset_sigma_s, 4)} s, "
        f"scale {_with_sigma(calibration.scale, calibration.scale_sigma, 4)}",
        f"Status: {_status(calibration)}",
        *(f"Warning: {warning}" for warning in calibration.warnings),
        "To publish it:",
        f"  {static_transform_command(calibration)}",
    ]
    return "\n".join(lines)


def convergence_line(entry):
    """One line of what ``replay --every`` found on the way: an entry of its history."""
    calibration, at = entry["calibration"], f"after {entry['bag_time_s']:g} s:"
    if calibration is None:
        return f"{at} no estimate yet, {entry['reason']}"
    transform = calibration["T_parent_child"]
    values = [
        f"{name} {value:.3f}" for name, value in zip("xyz", transform["translation"], strict=True)
    ]
    values += [
        f"{name} {value:.2f}" for name, value in zip(_ROTATIONS, transform["rpy_deg"], strict=True)
    ]
    return f"{at} {' '.join(values[:3])} m, {' '.join(values[3:])} deg, {calibration['n_poses']} poses, {calibration['status']}"


def _transform_lines(transform):
    return [
        f"  {transform['maps']}",
        "  translation " + _row(("x", "y", "z"), transform["translation"]) + "  m",
        "  quaternion  " + _row(("x", "y", "z", "w"), transform["quat_xyzw"]),
        "  rotation    "
        + _row(_ROTATIONS, transform["rpy_deg"], digits=4)
        + "  deg, about fixed axes",
    ]


def _row(names, values, digits=6):
    return "  ".join(
        f"{name} {value:{digits + 6}.{digits}f}" for name, value in zip(names, values, strict=True)
    )


def _with_sigma(value, sigma, digits):
    """A number that was given as it is, one that was estimated with its standard deviation."""
    return f"{value:.{digits}f} +/- {sigma:.{digits}f}" if sigma else f"{value:g}"


def _observability_line(dof):
    is_rotation = dof.name in _ROTATIONS
    if dof.verdict is DofVerdict.UNOBSERVABLE or not np.isfinite(dof.sigma):
        return f"  {dof.name:<6}          -      {dof.verdict.value}"
    sigma, unit = (np.degrees(dof.sigma), "deg") if is_rotation else (dof.sigma, "m")
    return f"  {dof.name:<6} {sigma:10.4f} {unit:<4} {dof.verdict.value}"


def _consistency_lines(consistency):
    """The same as other methods and references, and the drive's halves, suggest it."""
    titles = {
        "of_methods": "Other methods and references suggest",
        "of_halves": "The two halves of the drive suggest",
    }
    for kind, title in titles.items() if consistency else ():
        told = [
            f"{axis} {np.degrees(row[kind]):.3f} deg"
            if axis in _ROTATIONS
            else f"{axis} {row[kind]:.4f} m"
            for axis, row in consistency.items()
            if row[kind] is not None
        ]
        if told:
            yield f"  {title}: {', '.join(told)}"


def _status(calibration):
    if calibration.status is SolveStatus.UNOBSERVABLE:
        names = ", ".join(calibration.unobservable())
        return f"unobservable: this motion does not reveal {names}; do not use their values"
    if calibration.status is SolveStatus.NOT_CONVERGED:
        return "not converged: do not use this result"
    return calibration.status.value
