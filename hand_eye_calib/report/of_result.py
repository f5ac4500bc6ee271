"""The report of a result in memory."""

from dataclasses import replace
from pathlib import Path

from hand_eye_calib.engine.evidence import gather
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.errors import InputError
from hand_eye_calib.report.report import render
from hand_eye_calib.results.calibration import Calibration


def write_report(calibration: Calibration, path: Path) -> Path:
    """Cross-check a result and write its report; returns the file.

    Raises
    ------
    InputError
        If the result has no poses, or the file cannot be written.
    """
    snapshot = calibration.recording
    if not isinstance(snapshot, Snapshot):
        raise InputError("a result that was read from a file has no poses; calibrate again")
    # The time offset is settled; estimating it again would cost time.
    config = replace(snapshot.config, time_offset=calibration.time_offset_s)
    pose_pairs = replace(snapshot, config=config).pose_pairs()
    streams = dict(zip(("parent", "child"), snapshot.streams, strict=True))
    evidence = gather(calibration, snapshot.config, pose_pairs, streams)
    checked = replace(calibration, cross_check=evidence.cross_check)
    text = render(checked, snapshot.config, evidence, inputs={}, command="")
    path = path / "report.html" if path.is_dir() else path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    return path
