"""A calibration on the screen: as text for people, as JSON for programs, and as an exit code."""

import json
import shlex

import numpy as np

from hand_eye_calib.calibration import DofVerdict, SolveStatus
from hand_eye_calib.cli.console import fail, note

EXIT_CODES = {SolveStatus.OK: 0, SolveStatus.NOT_CONVERGED: 1, SolveStatus.UNOBSERVABLE: 3}

_ROTATIONS = ("roll", "pitch", "yaw")


def deliver(calibration, arguments, inputs):
    """Print a calibration, save it where ``--out`` asks for that, and return the exit code.

    Parameters
    ----------
    calibration : Calibration
    arguments : argparse.Namespace
        With ``json`` and ``out``.
    inputs : dict
        Where the data came from, in plain values: part of the JSON document and of the saved file's provenance.
    """
    if arguments.out:
        from hand_eye_calib.io.results import save_result

        note(f"wrote {save_result(calibration, arguments.out, inputs)}")
    print(as_json(calibration, inputs=inputs) if arguments.json else as_text(calibration))
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
        f"Solved with {calibration.method} ({calibration.backend}) on reference {calibration.reference}: "
        f"{calibration.n_inliers} of {calibration.n_pairs} motion pairs are inliers, from {calibration.n_poses} poses; "
        f"objective {calibration.objective:.6g}",
        f"  time offset {calibration.time_offset_s:g} s, scale {calibration.scale:g}",
        f"Status: {_status(calibration)}",
        *(f"Warning: {warning}" for warning in calibration.warnings),
        "To publish it:",
        f"  {static_transform_command(calibration)}",
    ]
    return "\n".join(lines)


def static_transform_command(calibration):
    """The shell command that publishes the calibration as a static transform from parent to child."""
    transform = calibration.to_dict()["T_parent_child"]
    values = dict(zip(("x", "y", "z"), transform["translation"], strict=True))
    values |= dict(zip(("qx", "qy", "qz", "qw"), transform["quat_xyzw"], strict=True))
    numbers = " ".join(f"--{name} {round(value, 9) + 0.0:.9f}" for name, value in values.items())
    return (
        f"ros2 run tf2_ros static_transform_publisher {numbers} "
        f"--frame-id {shlex.quote(calibration.parent_frame)} --child-frame-id {shlex.quote(calibration.child_frame)}"
    )


def _transform_lines(transform):
    return [
        f"  {transform['maps']}",
        "  translation " + _row(("x", "y", "z"), transform["translation"]) + "  m",
        "  quaternion  " + _row(("x", "y", "z", "w"), transform["quat_xyzw"]),
        "  rotation    " + _row(_ROTATIONS, transform["rpy_deg"], digits=4) + "  deg, about fixed axes",
    ]


def _row(names, values, digits=6):
    return "  ".join(f"{name} {value:{digits + 6}.{digits}f}" for name, value in zip(names, values, strict=True))


def _observability_line(dof):
    is_rotation = dof.name in _ROTATIONS
    if dof.verdict is DofVerdict.UNOBSERVABLE or not np.isfinite(dof.sigma):
        return f"  {dof.name:<6}          -      {dof.verdict.value}"
    sigma, unit = (np.degrees(dof.sigma), "deg") if is_rotation else (dof.sigma, "m")
    return f"  {dof.name:<6} {sigma:10.4f} {unit:<4} {dof.verdict.value}"


def _status(calibration):
    if calibration.status is SolveStatus.UNOBSERVABLE:
        names = ", ".join(calibration.unobservable())
        return f"unobservable: this motion does not reveal {names}; do not use their values"
    if calibration.status is SolveStatus.NOT_CONVERGED:
        return "not converged: do not use this result"
    return calibration.status.value
