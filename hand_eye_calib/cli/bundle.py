"""``info RESULT --bundle``: what a report of a wrong answer needs, in one small file, and nothing
else.
"""

import platform
import zipfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hand_eye_calib.cli.options import STREAMS
from hand_eye_calib.cli.reading import journal_in, read_journal_of
from hand_eye_calib.errors import HandEyeCalibError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.results import FILE_NAME, load_result
from hand_eye_calib.io.yaml_files import read_yaml
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.version import package_version

# Bytes of poses in both files together, before they are compressed.
MOST_BYTES = 200_000
_LONGEST_LINE = 125
_LIBRARIES = ("numpy", "scipy", "casadi", "rosbags", "matplotlib")
_ABOUT = """\
For the report of a wrong answer of hand_eye_calib. In here:
  bundle.yaml             versions, findings, the result without names of files
  options.yaml            the options that gave it
  parent.tum, child.tum   poses, downsampled, relative to the first one: no places on Earth
Repeat it with: hand_eye_calib calibrate parent.tum child.tum --config options.yaml
"""


def write_bundle(result: str | Path, target: Path) -> list[str]:
    """Write the bundle of a saved result into a zip file; returns what a person should know of it.

    Parameters
    ----------
    result : str or path-like
        ``extrinsic.yaml``, or the directory that holds it.
    target : pathlib.Path

    Raises
    ------
    InputError
        If the result cannot be read, or the file cannot be written.
    """
    file = Path(result)
    file = file / FILE_NAME if file.is_dir() else file
    calibration, provenance = load_result(file), read_yaml(file).get("provenance", {})
    inputs = provenance.get("inputs", {})
    streams: dict[str, Trajectory] = {}
    reason = ""
    try:
        streams = dict(zip(STREAMS, _streams(inputs, file.parent), strict=True))
    except (HandEyeCalibError, KeyError, TypeError) as error:
        reason = f"the poses are not in the bundle, as they could not be read again: {error}"
    about = _about(calibration, provenance, reason)
    texts = {
        "README.txt": _ABOUT,
        "options.yaml": _yaml(provenance.get("parameters", {})),
        "bundle.yaml": _yaml(_without(about, _names_of_files(inputs))),
        **{f"{name}.tum": tum_text(poses) for name, poses in streams.items()},
    }
    try:
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as bundle:
            for name, text in texts.items():
                bundle.writestr(name, text)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror}") from None
    return [reason] if reason else []


def _about(calibration: Calibration, provenance: Mapping[str, Any], reason: str) -> dict[str, Any]:
    """Versions, poses and result in plain values."""
    versions = {"hand_eye_calib": package_version(), "python": platform.python_version()}
    installed = {each.name: each.version for each in metadata.distributions()}
    versions |= {name: installed.get(name, "not installed") for name in _LIBRARIES}
    return {
        "made_on": f"{platform.system()} {platform.machine()}",
        "versions_here": versions,
        "versions_of_the_result": {
            "hand_eye_calib": provenance.get("package_version"),
            **provenance.get("versions", {}),
        },
        "poses": reason or "in parent.tum and child.tum",
        "result": calibration.to_dict(),
    }


def _streams(inputs: Mapping[str, Any], folder: Path) -> tuple[Trajectory, ...]:
    journal = journal_in([Path(inputs.get("journal", folder))])
    if journal is not None:
        return read_journal_of(journal, {}).snapshot.streams
    if "bag" in inputs:
        from hand_eye_calib.io.bags import read_bag_trajectory

        sources = [str(inputs[stream]["topic"]) for stream in STREAMS]
        named = [
            (None, source.partition(" ")[2]) if " " in source else (source, None)
            for source in sources
        ]
        return tuple(read_bag_trajectory(inputs["bag"], *names)[0] for names in named)
    from hand_eye_calib.io.trajectory_files import AUTO, FileOptions, read_trajectory_files

    options = FileOptions(format=AUTO, repair=True)
    files = [(inputs[stream]["file"], options) for stream in STREAMS]
    return tuple(reading.trajectory for reading in read_trajectory_files(files))


def tum_text(trajectory: Trajectory) -> str:
    """Poses relative to the first one as a TUM file of at most half of MOST_BYTES."""
    step = -(-len(trajectory) * _LONGEST_LINE // (MOST_BYTES // 2))
    part = trajectory[::step]
    poses = se3.inverse(part.poses[0]) @ part.poses
    rows = np.hstack([poses[:, :3, 3], se3.to_quat_xyzw(poses)]).tolist()
    stamps = (divmod(stamp, 1_000_000_000) for stamp in part.stamps_ns.tolist())
    return "".join(
        f"{s}.{ns:09d} {' '.join(f'{value:.9f}' for value in row)}\n"
        for (s, ns), row in zip(stamps, rows, strict=True)
    )


def _names_of_files(inputs: Mapping[str, Any]) -> dict[str, str]:
    """Every path among the inputs, and what stands for it."""
    paths = {str(inputs[name]): name.upper() for name in ("bag", "journal") if name in inputs}
    for stream in STREAMS:
        file = inputs.get(stream, {}).get("file")
        paths |= {str(file): f"{stream.upper()} FILE"} if file else {}
    paths |= {str(each.get("file")): "FILE" for each in inputs.get("files", [])}
    return paths


def _without(value: Any, paths: Mapping[str, str]) -> Any:
    """Plain values in which something stands for every path."""
    if isinstance(value, Mapping):
        return {name: _without(each, paths) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_without(each, paths) for each in value]
    if isinstance(value, str):
        for path in sorted(paths, key=len, reverse=True):
            value = value.replace(path, paths[path])
    return value


def _yaml(document: Any) -> str:
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
