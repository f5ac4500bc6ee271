"""Trajectories in the formats of other programs that are no table of numbers: each becomes rows
under a header, which are read as any csv file.

A format is a function that is found by the first bytes of its files. What cannot be read gets one
sentence that says what it is and what to do.
"""

import csv
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import reduce
from itertools import chain, islice
from operator import xor
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import InputError, MissingDependencyError, required
from hand_eye_calib.core.base.text import shortened
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.files import LONGEST_LINE, LONGEST_NAME
from hand_eye_calib.formats.trajectory_files.columns import (
    MATRIX,
    POSITION,
    QUATERNION,
    ROTATION_VECTOR,
)
from hand_eye_calib.formats.trajectory_files.dates import GPS_TIME
from hand_eye_calib.formats.trajectory_files.reading import FileOptions
from hand_eye_calib.formats.trajectory_files.table import Table, columns_of_array

_POSE = (*POSITION, *QUATERNION)
_PLACE = ("t [s]", "lat [deg]", "lon [deg]", "height [m]")
# Of axes forward, right, down those forward, left, up; of OpenGL's camera that of OpenCV.
_FLIP = np.diag([1.0, -1.0, -1.0])
# Lines of a Motive file that may stand before the rows: it has 7 (format version 1.25).
_MOTIVE_HEADER_LINES = 20
_NUMBERED = "the file has no times: the numbers of its {} are taken for seconds, to pair by them"

# The names of the columns, the rows, and what a person should know.
_Rows = tuple[Sequence[str], Iterable[Sequence[Any]], Sequence[str]]
# Of the bytes of a file, and the body of several that is meant.
_Reader = Callable[[bytes, str | None], _Rows]


def table_of_program(path: str | Path, data: bytes, options: FileOptions) -> Table | None:
    """Rows of a file in one of the formats of :data:`PROGRAMS`; None for other files.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    head = data[:LONGEST_LINE].removeprefix(b"\xef\xbb\xbf").lstrip()
    for pattern, read in PROGRAMS.items():
        if re.search(pattern, head):
            return foreign_table(path, data, read, options.columns, options.measures)
    return None


def foreign_table(
    path: str | Path, data: bytes, read: _Reader | str, choice: str | None, measures: str
) -> Table:
    """The rows of a file in one of these formats, with what :data:`PROGRAMS` has for it.
    ``choice`` says which of several bodies is meant. An InputError if it cannot be read.
    """
    if isinstance(read, str):
        raise InputError(f"cannot read {path}: {read}")
    try:
        header, rows, notes = read(data, choice)
    except MissingDependencyError:
        raise
    except Exception as error:  # of many kinds, in a file that is not what it begins like
        raise _unreadable(path, error) from None
    table = Table(path, (*header,), measures)
    table.guesses = [f"{path}: {note}" for note in notes]
    return table.fill(enumerate(_text_rows(path, rows), 1), list)


def _text_rows(path: str | Path, rows: Iterable[Sequence[Any]]) -> Iterator[list[str]]:
    """Yield the cells of rows as text, one row at a time: a file may have millions of them.

    Raises
    ------
    InputError
        If there is no row, or one cannot be read.
    """
    is_empty = True
    try:
        for row in rows:
            yield [str(cell) for cell in row]
            is_empty = False
    except Exception as error:  # of many kinds, in a file that is not what it begins like
        raise _unreadable(path, error) from None
    if is_empty:
        raise _unreadable(path, ValueError("no poses in it"))


def _unreadable(path: str | Path, error: Exception) -> InputError:
    reason = shortened(" ".join(str(error).split()), LONGEST_NAME)
    return InputError(f"cannot read {path}: {reason or type(error).__name__}")


def _lines(data: bytes) -> list[str]:
    return data.decode("utf-8-sig", "replace").splitlines()


# ---- positions on the earth


def _of_nmea(data: bytes, _: str | None) -> _Rows:
    """GGA sentences; the day is that of the last RMC sentence."""
    rows: list[Sequence[float]] = []
    day = None
    n_damaged = 0
    for line in _lines(data):
        text, _, check = line[line.find("$") + 1 :].partition("*")
        if check and f"{reduce(xor, text.encode(), 0):02X}" != check[:2].upper():
            n_damaged += 1
            continue
        cells = text.strip().split(",")
        if cells[0][-3:] == "RMC" and len(cells) > 9 and cells[9]:
            day = datetime.strptime(cells[9], "%d%m%y").replace(tzinfo=UTC).timestamp()
        elif day is None or cells[0][-3:] != "GGA" or len(cells) < 12:
            continue
        elif cells[6] not in ("", "0") and cells[9]:
            clock, lat, north, lon, east = cells[1:6]
            now = day + 3600 * int(clock[:2]) + 60 * int(clock[2:4]) + float(clock[4:])
            if rows and now < rows[-1][0] - 43_200:  # midnight, and the next date is still to come
                now += 86_400
            degrees = (
                (-1 if side in "SW" else 1) * (int(each[:n]) + float(each[n:]) / 60)
                for each, n, side in ((lat, 2, north), (lon, 3, east))
            )
            rows.append([now, *degrees, float(cells[9]) + float(cells[11] or 0)])
    if not rows:
        raise ValueError("NMEA: expected GGA sentences with a fix, and the date in RMC sentences")
    return _PLACE, rows, [f"{n_damaged} sentences with a wrong checksum left out"][:n_damaged]


def _of_gpx(data: bytes, _: str | None) -> _Rows:
    rows = []
    for point in ElementTree.fromstring(data).iterfind(".//{*}trkpt"):
        time = point.findtext("{*}time")
        height = point.findtext("{*}ele")
        if time is None:
            raise ValueError("a point of the GPX track has no time; record it with times")
        rows.append((time, point.attrib["lat"], point.attrib["lon"], height or "0"))
    return _PLACE, rows, ["heights of GPX are above the sea"]


def _of_rtklib(data: bytes, _: str | None) -> _Rows:
    if b"latitude(deg)" not in data and data.startswith(b"%"):
        raise ValueError("RTKLIB without degrees: set out-solformat to llh, degrees")
    rows = []
    for line in _lines(data):
        cells = line.replace(",", " ").split()
        if cells and not cells[0].startswith("%"):
            day = cells[0].replace("/", "-")
            stamp = f"{day}T{cells[1]}Z" if "-" in day else _of_week(*cells[:2])
            rows.append((stamp, *cells[2:5]))
    return _PLACE, rows, () if re.search(rb"(?m)^%\s+(UTC|JST)\b", data) else [GPS_TIME]


def _of_novatel(data: bytes, _: str | None) -> _Rows:
    """INSPVA and INSPVAX, with a long or a short header."""
    rows = []
    for line in _lines(data):
        head, _, body = line.partition(";")
        about = head.split(",")
        cells = body.split(",")
        if about[0][1:].startswith("INSPVA") and float(cells[2]):  # 0 before there is a solution
            has_undulation = "INSPVAX" in about[0]
            height = float(cells[4]) + has_undulation * float(cells[5])
            week = 5 if line[0] == "#" else 1
            turn = cells[9:12] if has_undulation else cells[8:11]
            rows.append((_of_week(*about[week : week + 2]), *cells[2:4], height, *turn))
    if not rows:
        raise ValueError("a log of NovAtel without INSPVA or INSPVAX: log one of them")
    return (*_PLACE, "roll [deg]", "pitch [deg]", "heading [deg]"), rows, [GPS_TIME]


def _of_week(week: str, second: str) -> str:
    """The stamp, s, of a second of a week of GPS."""
    return repr(315_964_800 + 604_800 * int(week) + float(second))


# ---- poses


def _of_g2o(data: bytes, _: str | None) -> _Rows:
    vertices = [line.split()[1:9] for line in _lines(data) if line.startswith("VERTEX_SE")]
    if not vertices:
        raise ValueError("a g2o graph without vertices; save it with them, optimised")
    rows = sorted(vertices, key=lambda row: int(row[0]))
    names = _POSE if len(rows[0]) > len(_POSE) else ("x", "y", "yaw [rad]")
    return ("t [s]", *names), rows, [_NUMBERED.format("vertices")]


def _of_colmap(data: bytes, _: str | None) -> _Rows:
    """Lines of images, each followed by one of points; poses of the world in the camera."""
    lines = [line for line in _lines(data) if not line.startswith("#")]
    images = [line.split(maxsplit=9) for line in lines[::2] if line.strip()]
    if any(len(image) != 10 for image in images):
        raise ValueError(
            "COLMAP images.txt: expected an image and its points in turn, on two lines"
        )
    values = np.array([[float(each) for each in image[1:8]] for image in images])
    Ts_camera_world = se3.from_quat_xyzw(values[:, 4:], values[:, [1, 2, 3, 0]])
    return _of_images([image[9] for image in images], se3.inverse(Ts_camera_world))


def _of_json(data: bytes, _: str | None) -> _Rows:
    document: Any = {}
    with suppress(ValueError, RecursionError):
        document = json.loads(data)
    frames: Any = document.get("frames") if isinstance(document, dict) else document
    is_list = isinstance(frames, list) and frames and isinstance(frames[0], dict)
    names = frames[0].keys() if is_list else ()
    if {"timestamp", "translation", "rotation"} <= {*names}:
        poses = ([each["timestamp"], *each["translation"], *each["rotation"]] for each in frames)
        return ("t [us]", *POSITION, "qw", "qx", "qy", "qz"), sorted(poses), ()
    if "transform_matrix" not in names:
        raise ValueError(
            "JSON that is not read; expected transforms.json of nerfstudio, ego_pose.json of "
            "nuScenes, or csv"
        )
    Ts_world_camera = np.array([each["transform_matrix"] for each in frames], dtype=float)
    Ts_world_camera[:, :3, :3] = Ts_world_camera[:, :3, :3] @ _FLIP
    turned = "axes of the camera: x right, y down, z forward, not those of OpenGL in the file"
    return _of_images([str(each["file_path"]) for each in frames], Ts_world_camera, turned)


def _of_images(names: Sequence[str], poses: FloatArray, *notes: str) -> _Rows:
    """Poses (N, 4, 4) of images, whose stamps are the last numbers in their names; none if one has
    no number.
    """
    images = [Path(name).stem for name in names]
    rows = [(*row, image) for row, image in zip(_as_rows(poses).tolist(), images, strict=True)]
    numbers = [re.findall(r"\d+\.\d+|\d+", image)[-1:] for image in images]
    if not all(numbers):
        return (*MATRIX, "image"), rows, notes
    stamped = [(stamp, *row) for (stamp,), row in zip(numbers, rows, strict=True)]
    stamped.sort(key=lambda row: float(row[0]))
    # Seconds since 1970 have ten digits before the point, and no recording has so many images.
    if min(len(stamp.partition(".")[0]) for (stamp,) in numbers) < 10:
        notes = (_NUMBERED.format("images"), *notes)
    return ("t", *MATRIX, "image"), stamped, notes


def _of_motive(data: bytes, choice: str | None) -> _Rows:
    """A take of OptiTrack's Motive with rigid bodies."""
    all_lines = csv.reader(_lines(data))
    lines = [*islice(all_lines, _MOTIVE_HEADER_LINES)]
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
    table = chain(lines[top + 1 :], all_lines)
    rows = ([row[place] for place in places] for row in table if len(row) > max(places))
    unit = units[about.get("Length Units", "Meters")]
    header = ("t [s]", *(f"{axis} [{unit}]" for axis in POSITION), *QUATERNION)
    return header, rows, [f"poses of rigid body {body}"]


def _of_vicon(data: bytes, choice: str | None) -> _Rows:
    """Segments of Vicon Nexus or Tracker, whose rotations are rotation vectors."""
    all_lines = csv.reader(_lines(data))
    _, (rate, *_), names, columns, units = islice(all_lines, 5)
    rate_hz = float(rate)
    if "RX" not in columns:
        raise ValueError("Vicon without segments: export Segments or Objects (global), not markers")
    starts = {names[at] or "object": at for at, name in enumerate(columns) if name == "RX"}
    body = _chosen(starts, choice, "segments")
    at = starts[body]
    place = columns.index("TX", starts[body])
    rows = (
        [int(cells[0]) / rate_hz, *cells[at : place + 3]]
        for cells in all_lines
        if len(cells) >= place + 3 and all(cells[at : place + 3])
    )
    kind = "rotation vectors"
    turns = [f"{name} [{units[at]}]" for name in ROTATION_VECTOR]
    if "RW" in columns[at:place]:
        kind = "quaternions"
        turns = [*QUATERNION]
    header = ("t [s]", *turns, *(f"{axis} [{units[place]}]" for axis in POSITION))
    return header, rows, [f"poses of {body}; rotations read as {kind}"]


def _of_numpy(data: bytes, _: str | None) -> _Rows:
    return columns_of_array(np.load(io.BytesIO(data), allow_pickle=False))


def _of_pcd(data: bytes, _: str | None) -> _Rows:
    """Key poses as LIO-SAM saves them: points with angles and a time."""
    head, form, body = re.split(rb"(?m)^DATA (\w+)\r?\n", data, maxsplit=1)
    about = {name: values for name, *values in map(str.split, _lines(head))}
    names = about["FIELDS"]
    sizes = zip(about["TYPE"], about["SIZE"], strict=True)
    if form == b"ascii":
        return names, map(str.split, _lines(body)), ()
    if form != b"binary":
        raise ValueError(
            "its points are compressed; unpack them: pcl_convert_pcd_ascii_binary IN.pcd OUT.pcd 1"
        )
    kinds = zip(names, [f"<{kind.lower()}{size}" for kind, size in sizes], strict=True)
    return names, np.frombuffer(body, [*kinds], int(about["POINTS"][0])).tolist(), ()


def _of_ulog(data: bytes, _: str | None) -> _Rows:
    """A log of PX4: the odometry of its estimator, or local positions with attitudes."""
    reading = required("pyulog", "a log of PX4", "px4")
    quaternion = [f"q[{k}]" for k in (1, 2, 3, 0)]
    try:
        topics = ["vehicle_odometry", "vehicle_local_position", "vehicle_attitude"]
        logged = reading.ULog(io.BytesIO(data), topics).data_list
        of = {each.name: each.data for each in logged if each.multi_id == 0}
        if "vehicle_odometry" in of:
            place = "xyz" if "x" in of["vehicle_odometry"] else [f"position[{k}]" for k in range(3)]
            stamps, values = _logged(of["vehicle_odometry"], *place, *quaternion)
            Ts = se3.from_quat_xyzw(values[:, :3], values[:, 3:])
        else:
            stamps, places = _logged(of["vehicle_local_position"], *"xyz")
            times, turns = _logged(of["vehicle_attitude"], *quaternion)
            attitudes = Trajectory.from_quat_xyzw(1000 * times, 0.0 * turns[:, :3], turns)
            inside = (stamps >= times[0]) & (stamps <= times[-1])
            stamps, Ts = stamps[inside], attitudes.at(1000 * stamps[inside])
            Ts[:, :3, 3] = places[inside]
    except Exception as error:  # of many kinds, at damaged logs
        reason = "" if isinstance(error, KeyError) else f", {type(error).__name__}: {error}"
        raise ValueError(f"a log of PX4 without {' or '.join(topics[:2])}{reason}") from None
    flip = np.diag([*np.diag(_FLIP), 1.0])
    rows = np.c_[stamps, _as_rows(flip @ Ts @ flip)].tolist()
    note = "axes: x forward, y left, z up, in north, west, up; PX4 has forward, right, down"
    return ("t [us]", *MATRIX), [(int(row[0]), *row[1:]) for row in rows], [note]


def _logged(data: Mapping[str, Any], *names: str) -> tuple[IntArray, FloatArray]:
    """Increasing stamps (us) and the values of a topic in a log of PX4, where all are known."""
    values = np.stack([data[name] for name in names], axis=1).astype(float)
    good = np.isfinite(values).all(axis=1)
    for valid in {"xy_valid", "z_valid"} & data.keys():  # of local positions
        good &= data[valid] > 0
    if not good.any():
        raise ValueError(f"none of {', '.join(names)} is valid")
    stamps = data.get("timestamp_sample", data["timestamp"])[good].astype(np.int64)
    stamps, first = np.unique(stamps, return_index=True)
    return stamps, values[good][first]


def _as_rows(poses: FloatArray) -> FloatArray:
    """The first three rows of each pose (N, 4, 4) as one of (N, 12)."""
    return poses[:, :3].reshape(-1, 12)


def _chosen(found: Mapping[str, Any], choice: str | None, what: str) -> str:
    """The only body, or the one that is named."""
    if choice in found:
        return str(choice)
    if len(found) != 1:
        listed = shortened(", ".join(found), LONGEST_NAME)
        raise ValueError(f"several {what}: {listed}; name one with `columns`")
    return next(iter(found))


# Cells of a message, and the one where its pose begins: PoseStamped, with covariance, Odometry,
# TransformStamped.
_POSE_OF_CELLS = {10: 3, 46: 3, 89: 4, 11: 4}


def _of_echo(data: bytes, _: str | None) -> _Rows:
    """Messages with a header as ``ros2 topic echo --csv`` writes them."""
    rows = [line.split(",") for line in _lines(data) if line]
    at = _POSE_OF_CELLS.get(len(rows[0]))
    if at is None:
        raise ValueError("messages without poses, as of ros2 topic echo --csv; record a bag")
    return ("secs", "nsecs", *_POSE), ([*row[:2], *row[at : at + 7]] for row in rows), ()


#: How files begin that are no text with a row of numbers on each line, and what reads them, or what
#: to do instead.
PROGRAMS: dict[bytes, _Reader | str] = {
    rb"\Asource_timestamp,destination_timestamp": "motions between images, no poses; chain them",
    rb"<gpx[\s>]": _of_gpx,
    rb"\A<": "XML, no trajectory that is read; export the track as GPX, or poses as csv",
    rb"\AFMT, \d": "a log of ArduPilot; export positions and attitudes as csv, or record a bag",
    rb"\A\w+ \{\s": "messages as text; record them as a bag",
    rb"\A[^\n]*RINEX VERSION": "observations of satellites; compute positions with RTKLIB",
    rb"\ASQLite format 3": "a database; a bag ends in .db3, and COLMAP exports its model as text",
    rb"\A(#.*\n)+#\s+(FRAME_ID, RIG|CAMERA_ID, MOD|POINT3D)": "no poses; give images.txt of COLMAP",
    rb"\A(# \.PCD|VERSION 0?\.7)[^\0]*?\nFIELDS .*\broll\b": _of_pcd,
    rb"\A(ply\r?\n|# \.PCD|VERSION 0?\.7)": "points, no trajectory; record the odometry as a bag",
    rb"\A[#%][A-Z\d]+A,[^;\n]*;": _of_novatel,
    rb"\A(%YAML|---\s|[A-Za-z]\w*: *\n[ -])": "YAML, no trajectory; record messages as a bag; "
    "samples of an arm are a recording of their own",
    rb"\A\x93NUMPY": _of_numpy,
    rb"\AULog\x01\x12\x35": _of_ulog,
    rb"\A(\{|\[\s*[\[{\"\d-])": _of_json,
    rb"\$[A-Z]{2}(GGA|RMC),": _of_nmea,
    rb"\A\d{9,10},\d{1,9},(?=[^,\n]*[A-Za-z/])[^,\n]*,": _of_echo,
    rb"(?m)^%\s+(GPST|UTC|JST)\b.*(latitude|ecef|baseline)": _of_rtklib,
    # As of Emlid, without a header; metres have fewer digits.
    rb"\A\d{4}/\d\d/\d\d +\S+( +-?\d+\.\d{9,}){2} ": _of_rtklib,
    rb"\A\d{4}/\d\d/\d\d +\S+ +-?\d+\.\d{4} ": "RTKLIB without degrees: set its format to llh",
    rb"\A#.*\n(#.*\n)*#\s+IMAGE_ID, QW": _of_colmap,
    rb"(?m)^(VERTEX|EDGE)_SE(2|3:QUAT) ": _of_g2o,
    rb"\AFormat Version,": _of_motive,
    rb"\A(Segments|Objects|Trajectories)\b.*\r?\n\d+": _of_vicon,
}
