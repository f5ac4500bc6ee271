"""``report.html`` beside the other files of ``--out``."""

import dataclasses

from hand_eye_calib.cli.console import note, waiting_for
from hand_eye_calib.cli.present import static_transform_command
from hand_eye_calib.errors import InputError
from hand_eye_calib.estimation import estimate_extrinsic

_OPTIONAL = ("jinja2", "markupsafe", "matplotlib")


def write_report(directory, calibration, snapshot, inputs, findings=()):
    """Write the report; without the libraries that it takes, say so and go on.

    Parameters
    ----------
    directory : path-like
        One that exists.
    calibration : Calibration
    snapshot : Snapshot
        The poses and options that gave it.
    inputs : dict
        Where the data came from, in plain values.
    findings : sequence of dict
        What the stream checks found.

    Raises
    ------
    InputError
        Where it cannot be written.
    """
    try:
        from hand_eye_calib.report import report
    except ModuleNotFoundError as error:
        library = error.name.partition(".")[0]
        if library not in _OPTIONAL:
            raise
        note(f"no report.html: {library} is missing; pip install 'hand_eye_calib[plot]'")
        return
    # The clock is settled; estimating it again would cost time.
    config = dataclasses.replace(snapshot.config, time_offset=calibration.time_offset_s)
    pose_pairs = dataclasses.replace(snapshot, config=config).pose_pairs()
    streams = {} if len(snapshot.kept) else {"parent": snapshot.parent, "child": snapshot.child}
    try:
        with waiting_for("writing the report"):
            path = report.write_report(
                directory,
                calibration,
                snapshot.config,
                pose_pairs,
                estimate_extrinsic,
                inputs=inputs,
                findings=findings,
                streams=streams,
                command=static_transform_command(calibration),
            )
    except OSError as error:
        raise InputError(f"cannot write {error.filename or directory}: {error.strerror}; choose another directory") from None
    note(f"wrote {path}")
