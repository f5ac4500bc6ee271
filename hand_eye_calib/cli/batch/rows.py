"""One row of plain values for each recording, for tables of other programs."""

import hashlib
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import PurePath
from typing import Any

from hand_eye_calib.cli.batch.calibrating import Outcome

Row = dict[str, Any]

_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_LENGTHS, _ANGLES = _AXES[:3], _AXES[3:]
# Of the calibration, as they are.
_TAKEN = (
    *("verdict", "headline", "status", "parent_frame", "child_frame", "method", "reference"),
    *("n_poses", "n_pairs", "n_inliers", "time_offset_s", "time_offset_sigma_s"),
    *("scale", "scale_sigma"),
)
# Every column with the type of its values.
COLUMNS: dict[str, type] = (
    dict.fromkeys(("name", "vehicle", "bags", "start", "sha256"), str)
    | {"start_ns": int, "duration_s": float, "bytes": int}
    | dict.fromkeys(("verdict", "headline", "status", "parent_frame", "child_frame"), str)
    | {f"{axis}_m": float for axis in _LENGTHS}
    | {f"sigma_{axis}_m": float for axis in _LENGTHS}
    | {f"{axis}_deg": float for axis in _ANGLES}
    | {f"sigma_{axis}_deg": float for axis in _ANGLES}
    | {f"{axis}_is": str for axis in _AXES}
    | dict.fromkeys(("method", "reference"), str)
    | dict.fromkeys(("n_poses", "n_pairs", "n_inliers"), int)
    | dict.fromkeys(("time_offset_s", "time_offset_sigma_s", "scale", "scale_sigma"), float)
    | {"findings": str, "warnings": str, "error": str}
)


def row_of(outcome: Outcome) -> Row:
    """The row of an outcome; what is not known is None.

    Nothing in it depends on when or where the work was done.
    """
    row: Row = dict.fromkeys(COLUMNS)
    row |= {"name": outcome["name"], "vehicle": outcome["vehicle"]}
    row |= {"bags": " ".join(outcome["bags"]), "error": outcome["error"]}
    row |= _recording(outcome["inputs"])
    row["findings"] = " ".join(finding["code"] for finding in outcome["findings"])
    if calibration := outcome["calibration"]:
        row |= {name: calibration[name] for name in _TAKEN} | _extrinsic(calibration)
        row["warnings"] = "; ".join(calibration["warnings"])
    return row


def _recording(inputs: Mapping[str, Any]) -> Row:
    """When a recording was made, for how long, and the digest of its content."""
    row: Row = {}
    starts = [
        inputs[stream]["first_stamp_ns"] for stream in ("parent", "child") if stream in inputs
    ]
    if starts and None not in starts:
        ends = [inputs[stream]["last_stamp_ns"] for stream in ("parent", "child")]
        row |= {"start_ns": max(starts), "duration_s": (min(ends) - max(starts)) * 1e-9}
        row["start"] = _date(max(starts))
    if files := inputs.get("files"):
        row |= {"sha256": content_hash(files), "bytes": sum(file["bytes"] for file in files)}
    return row


def _date(stamp_ns: int) -> str:
    """A stamp as a date in UTC, to the second."""
    return datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).isoformat(timespec="seconds")


def content_hash(files: list[Mapping[str, Any]]) -> str:
    """Digest of the files of a recording.

    That of a single file is its SHA-256; that of several is what ``sha256sum FILE ... | sha256sum``
    prints in their folder, for the files in the order of their names.
    """
    if len(files) == 1:
        return str(files[0]["sha256"])
    lines = sorted((PurePath(file["file"]).name, file["sha256"]) for file in files)
    text = "".join(f"{digest}  {name}\n" for name, digest in lines)
    return hashlib.sha256(text.encode()).hexdigest()


def _extrinsic(calibration: Mapping[str, Any]) -> Row:
    """The pose of the child in the parent with its standard deviations, axis by axis."""
    transform = calibration["T_parent_child"]
    row: Row = {}
    for names, values, sigmas, unit in (
        (_LENGTHS, transform["translation"], transform["sigma_translation"], "m"),
        (_ANGLES, transform["rpy_deg"], transform["sigma_rpy_deg"], "deg"),
    ):
        for name, value, sigma in zip(names, values, sigmas, strict=True):
            is_known = sigma is not None and math.isfinite(sigma)
            row |= {f"{name}_{unit}": value, f"sigma_{name}_{unit}": sigma if is_known else None}
    return row | {f"{dof['name']}_is": dof["verdict"] for dof in calibration["observability"]}
