"""Trajectories in the formats of other programs that are no table of numbers: each becomes rows
under a header, which are read as any csv file.

A format is a function that knows its files by their first bytes. What cannot be read gets one
sentence that says what it is and what to do.
"""

import csv
import json
import re
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError, MissingDependencyError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.files import open_regular, read_text
from hand_eye_calib.io.limits import LARGEST_TEXT
from hand_eye_calib.io.trajectory_files.columns import MATRIX, POSITION, QUATERNION

_POSE = (*POSITION, *QUATERNION)
_PLACE = ("t [s]", "lat [deg]", "lon [deg]", "height [m]")
_HEAD_BYTES = 4096
# Binary files by their first bytes: what they are, and what to do.
_NOT_READ = {
    b"MATLAB 5.0 MAT-file": "a binary file of MATLAB; save the poses as text, "
    "save('poses.txt', 'poses', '-ascii', '-double')",
    b"PK\x03\x04": "a spreadsheet or another zip file; save the sheet as csv",
    b"\x89HDF": "an HDF5 file; save the poses as csv or .npy",
    b"\x80\x04": "a pickle of Python, which is not read as it could run anything; save .npy or csv",
}
# Of axes forward, right, down those forward, left, up; of OpenGL's camera that of OpenCV.
_FLIP = np.diag([1.0, -1.0, -1.0])
# From north, east, down to east, north, up.
_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class Rows(NamedTuple):
    """The rows of a file under names of columns, what a person should know, and the names of the
    images whose poses they are.
    """

    header: Sequence[str]
    rows: Iterable[Sequence[Any]]
    notes: tuple[str, ...] = ()
    images: Sequence[str] = ()


def rows_of(path: str | Path, choice: str | None = None) -> Rows | None:
    """The rows of a file in one of these formats; None for any other. ``choice`` says which of
    several bodies is meant.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    path = Path(path)
    with open_regular(path) as file:
        head = file.read(_HEAD_BYTES)
    for start, sentence in _NOT_READ.items():
        if head.startswith(start):
            raise InputError(f"{path}: {sentence}")
    text = head.decode("utf-8-sig", "replace").lstrip()
    of_bytes = next((read for start, read in _BINARY.items() if head.startswith(start)), None)
    of_text = next((read for pattern, read in _TEXT.items() if re.search(pattern, text)), None)
    try:
        if of_bytes is not None:
            return of_bytes(path)
        if of_text is not None:
            return of_text(read_text(path, "a trajectory", LARGEST_TEXT), choice)
    except MissingDependencyError:
        raise
    except Exception as error:  # of many kinds, in a file that is not what it begins like
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: {reason or type(error).__name__}") from None
    return None


# ---- positions on the earth


def _of_nmea(text: str, _: str | None) -> Rows:
    """GGA sentences; the day is that of the last RMC sentence."""
    rows: list[Sequence[float]] = []
    day = None
    for line in text.splitlines():
        cells = line.partition("*")[0].strip().split(",")
        if cells[0][-3:] == "RMC" and len(cells) > 9 and cells[9]:
            day = datetime.strptime(cells[9], "%d%m%y").replace(tzinfo=UTC).timestamp()
        elif day is None or cells[0][-3:] != "GGA" or len(cells) < 12:
            continue
        elif cells[6] not in ("", "0") and cells[9]:
            clock, lat, north, lon, east = cells[1:6]
            now = 3600 * int(clock[:2]) + 60 * int(clock[2:4]) + float(clock[4:])
            degrees = (
                (-1 if side in "SW" else 1) * (int(each[:n]) + float(each[n:]) / 60)
                for each, n, side in ((lat, 2, north), (lon, 3, east))
            )
            rows.append([day + now, *degrees, float(cells[9]) + float(cells[11] or 0)])
    if not rows:
        raise ValueError("NMEA: expected GGA sentences with a fix, and the date in RMC sentences")
    return Rows(_PLACE, rows)


def _of_gpx(text: str, _: str | None) -> Rows:
    rows = []
    for point in ElementTree.fromstring(text).iterfind(".//{*}trkpt"):
        time, height = point.findtext("{*}time"), point.findtext("{*}ele")
        if time is None:
            raise ValueError("a point of the GPX track has no time; record it with times")
        rows.append((time, point.attrib["lat"], point.attrib["lon"], height or "0"))
    return Rows(_PLACE, rows, ("heights of GPX are above the sea",))


def _of_rtklib(text: str, _: str | None) -> Rows:
    if "latitude(deg)" not in text:
        raise ValueError("RTKLIB without degrees: set out-solformat to llh, degrees")
    gps_epoch, rows = 315_964_800, []
    for line in text.splitlines():
        cells = line.replace(",", " ").split()
        if cells and not cells[0].startswith("%"):
            if "/" in cells[0]:
                stamp = f"{cells[0].replace('/', '-')}T{cells[1]}Z"
            else:
                stamp = repr(gps_epoch + 604_800 * int(cells[0]) + float(cells[1]))
            rows.append((stamp, *cells[2:5]))
    note = "stamps are of GPS time, 18 s ahead of UTC since 2017"
    return Rows(_PLACE, rows, (note,) if "GPST" in text else ())


# ---- poses


def _of_g2o(text: str, _: str | None) -> Rows:
    vertices = (line.split() for line in text.splitlines() if line.startswith("VERTEX_SE3:QUAT "))
    rows = sorted((cells[1:9] for cells in vertices), key=lambda row: int(row[0]))
    return Rows(("t [s]", *_POSE), rows, (_NUMBERED.format("vertices"),))


def _of_colmap(text: str, _: str | None) -> Rows:
    """Lines of images, each followed by one of points; poses of the world in the camera."""
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    images = [line.split(maxsplit=9) for line in lines[::2] if line.strip()]
    if any(len(image) != 10 for image in images):
        raise ValueError(
            "COLMAP images.txt: expected an image and its points in turn, on two lines"
        )
    values = np.array([[float(each) for each in image[1:8]] for image in images])
    Ts_camera_world = se3.from_quat_xyzw(values[:, 4:], values[:, [1, 2, 3, 0]])
    return _of_images([image[9] for image in images], se3.inverse(Ts_camera_world))


def _of_json(text: str, _: str | None) -> Rows:
    document = json.loads(text)
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not frames or "transform_matrix" not in frames[0]:
        raise ValueError("JSON that is not read; expected transforms.json of nerfstudio, or csv")
    Ts_world_camera = np.array([each["transform_matrix"] for each in frames], dtype=float)
    Ts_world_camera[:, :3, :3] = Ts_world_camera[:, :3, :3] @ _FLIP
    turned = "axes of the camera: x right, y down, z forward, not those of OpenGL in the file"
    return _of_images([str(each["file_path"]) for each in frames], Ts_world_camera, turned)


def _of_motive(text: str, choice: str | None) -> Rows:
    """A take of OptiTrack's Motive with rigid bodies."""
    lines = [*csv.reader(text.splitlines())]
    top = next((row for row, cells in enumerate(lines) if "Time (Seconds)" in cells), 0)
    kinds = next((row for row in range(1, top) if "Rigid Body" in lines[row]), None)
    if kinds is None:
        raise ValueError("Motive without rigid bodies: export them")
    found: dict[str, dict[str, int]] = {}
    heads = zip(lines[kinds], lines[kinds + 1], lines[top - 1], lines[top], strict=False)
    for at, (kind, name, part, axis) in enumerate(heads):
        if kind == "Rigid Body" and part in ("Rotation", "Position"):
            key = axis.lower() if part == "Position" else f"q{axis.lower()}"
            found.setdefault(name, {})[key] = at
    body = _chosen(found, choice, "rigid bodies")
    if {*_POSE} - found[body].keys():
        raise ValueError("Motive with Euler angles: export with rotation type Quaternion")
    about = dict(zip(lines[0][::2], lines[0][1::2], strict=False))
    units = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm"}
    places = [lines[top].index("Time (Seconds)"), *(found[body][name] for name in _POSE)]
    rows = [[row[k] for k in places] for row in lines[top + 1 :] if len(row) > max(places)]
    unit = units[about.get("Length Units", "Meters")]
    header = ("t [s]", *(f"{axis} [{unit}]" for axis in POSITION), *QUATERNION)
    return Rows(header, [row for row in rows if all(row)], (f"poses of rigid body {body}",))


def _of_vicon(text: str, choice: str | None) -> Rows:
    """Segments of Vicon Nexus or Tracker, whose rotations are rotation vectors."""
    lines = [*csv.reader(text.splitlines())]
    rate_hz, names, columns, units = float(lines[1][0]), lines[2], lines[3], lines[4]
    if "RX" not in columns:
        raise ValueError("Vicon without segments: export Segments or Objects (global), not markers")
    starts = {names[at] or "object": at for at, name in enumerate(columns) if name == "RX"}
    body = _chosen(starts, choice, "segments")
    at = starts[body]
    rows = [cells for cells in lines[5:] if len(cells) >= at + 6 and all(cells[at : at + 6])]
    values = np.array([[float(each) for each in cells[at : at + 6]] for cells in rows])
    angles = values[:, :3] * (np.pi / 180 if units[at].startswith("deg") else 1.0)
    positions = values[:, 3:] * {"m": 1.0, "cm": 0.01, "mm": 0.001}[units[at + 3]]
    poses = se3.from_rotation_translation(se3.rotation_exp(angles), positions)
    seconds = [int(cells[0]) / rate_hz for cells in rows]
    note = f"poses of {body}; rotations read as rotation vectors"
    return Rows(("t [s]", *MATRIX), np.c_[seconds, _as_rows(poses)].tolist(), (note,))


def _of_numpy(path: Path) -> Rows:
    try:
        values = np.array(np.load(path, allow_pickle=False, mmap_mode="r"))
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"cannot read the array: {error}") from None
    if values.ndim != 2 or values.shape[1] not in (4, 8) or values.dtype.kind not in "fiu":
        raise ValueError(
            f"an array {values.shape} of {values.dtype}; expected rows (N, 8) of t, x, y, z, qx, "
            "qy, qz, qw, or (N, 4) of t, x, y, z"
        )
    return Rows(("t", *_POSE)[: values.shape[1]], values.tolist())


def _of_ulog(path: Path) -> Rows:
    """A log of PX4: the odometry of its estimator."""
    try:
        from pyulog import ULog
    except ImportError:
        raise MissingDependencyError(
            f"{path} is a log of PX4; to read it needs pyulog: pip install 'hand_eye_calib[px4]'"
        ) from None
    try:
        log = ULog(str(path), ["vehicle_odometry"]).data_list[0]
        names = "xyz" if "x" in log.data else [f"position[{k}]" for k in range(3)]
        names = [*names, *(f"q[{k}]" for k in (1, 2, 3, 0))]
        stamps = log.data["timestamp_sample" if "timestamp_sample" in log.data else "timestamp"]
        values = np.stack([log.data[name] for name in names], axis=1).astype(float)
    except Exception as error:  # of many kinds, at damaged logs
        reason = f"{type(error).__name__} {error}"
        raise ValueError(f"a log of PX4 without vehicle_odometry ({reason})") from None
    good = np.isfinite(values).all(axis=1)
    positions, quats = values[good, :3], values[good, 3:]
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    rotations = _ENU_NED @ se3.from_quat_xyzw(positions, quats)[:, :3, :3] @ _FLIP
    poses = _as_rows(se3.from_rotation_translation(rotations, positions @ _ENU_NED.T)).tolist()
    rows = [(int(stamp), *pose) for stamp, pose in zip(stamps[good], poses, strict=True)]
    note = "axes: x forward, y left, z up, in east, north, up; PX4 has forward, right, down"
    return Rows(("t [us]", *MATRIX), rows, (note,))


# ---- parts of several

_NUMBERED = "the file has no times: the numbers of its {} are taken for seconds, to pair by them"


def _as_rows(poses: FloatArray) -> FloatArray:
    """The first three rows of each pose (N, 4, 4) as one of (N, 12)."""
    return poses[:, :3].reshape(-1, 12)


def _of_images(names: Sequence[str], poses: FloatArray, *notes: str) -> Rows:
    """Poses (N, 4, 4) of images, whose stamps are the last numbers in their names; none if one has
    no number.
    """
    values, images = _as_rows(poses).tolist(), [Path(name).stem for name in names]
    numbers = [re.findall(r"\d+\.\d+|\d+", image) for image in images]
    if not all(numbers):
        return Rows(MATRIX, values, notes, images)
    stamps = [each[-1] for each in numbers]
    order = sorted(range(len(stamps)), key=lambda row: float(stamps[row]))
    rows = [(stamps[row], *values[row]) for row in order]
    # Seconds since 1970 have ten digits before the point, and no recording has so many images.
    if min(len(each.partition(".")[0]) for each in stamps) < 10:
        notes = (_NUMBERED.format("images"), *notes)
    return Rows(("t", *MATRIX), rows, notes, [images[row] for row in order])


def _chosen(found: Any, choice: str | None, what: str) -> str:
    """The only body, or the one that is named."""
    names = [*found]
    if choice in names:
        return str(choice)
    if len(names) != 1:
        listed = ", ".join(names[:20])
        raise ValueError(f"several {what}: {listed}; name one with `columns`")
    return str(names[0])


# Files that begin so.
_BINARY: dict[bytes, Callable[[Path], Rows]] = {
    b"\x93NUMPY": _of_numpy,
    b"ULog\x01\x12\x35": _of_ulog,
}
_TEXT: dict[str, Callable[[str, str | None], Rows]] = {
    r"\A(<\?xml[^>]*>\s*)?<gpx": _of_gpx,
    r"\A\{": _of_json,
    r"\A\$[A-Z]{5},": _of_nmea,
    r"(?m)^%\s+(GPST|UTC|JST)\b.*(latitude|ecef|baseline)": _of_rtklib,
    r"\A#.*\n(#.*\n)*#\s+IMAGE_ID, QW": _of_colmap,
    r"(?m)^VERTEX_SE3:QUAT ": _of_g2o,
    r"\AFormat Version,": _of_motive,
    r"\A(Segments|Objects|Trajectories)\b.*\r?\n\d+": _of_vicon,
}
