"""Read trajectories of other programs whose files are not tables of numbers.

The first bytes of a file select its format. A format is a function that returns a header and rows,
like those of a csv file. A format that cannot be read is a sentence instead: it names the content
of such files and what the user should do.
"""

import csv
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError, MissingDependencyError
from hand_eye_calib.core.base.text import shortened
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.sensors.nmea import places_of
from hand_eye_calib.extras.sensors.ulog import logged_poses
from hand_eye_calib.formats.files import LONGEST_LINE, LONGEST_NAME
from hand_eye_calib.formats.trajectory_files.columns import (
    MATRIX,
    POSITION,
    QUATERNION,
    ROTATION_VECTOR,
)
from hand_eye_calib.formats.trajectory_files.dates import (
    GPS_EPOCH_S,
    GPS_TIME,
    WEEK_S,
)
from hand_eye_calib.formats.trajectory_files.file_options import FileOptions
from hand_eye_calib.formats.trajectory_files.objects import columns_of_array
from hand_eye_calib.formats.trajectory_files.table import Table

# Names of the columns of a pose.
_POSE = (*POSITION, *QUATERNION)
# Names of the columns of a stamp and a position on the earth.
_PLACE = ("t [s]", "lat [deg]", "lon [deg]", "height [m]")
# Rotation from the axes forward, right, down to forward, left, up. It is also the rotation from the
# camera axes of OpenGL to those of OpenCV.
_FLIP = np.diag([1.0, -1.0, -1.0])
# Largest number of lines before the rows of a Motive file; 7 in format version 1.25.
_MOTIVE_HEADER_LINES = 20
# Units of length by their names in Motive files.
_MOTIVE_UNITS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm"}
# Note on a file without times.
_NUMBERED = "the file has no times: the numbers of its {} are used as seconds, to pair the poses"


class _Rows(NamedTuple):
    """Names of the columns, rows of cells, and notes for the user."""

    header: Sequence[str]
    rows: Iterable[Sequence[Any]]
    notes: Sequence[str] = ()


# ``read(content, choice)``: the content of a file, and the name of a body or None.
_Reader = Callable[[bytes, str | None], _Rows]


def table_of_program(
    path: str | Path, data: bytes, options: FileOptions
) -> Table | None:
    """Return the rows of a file in one of the formats of :data:`PROGRAMS`; None for other files.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    head = data[:LONGEST_LINE].removeprefix(b"\xef\xbb\xbf").lstrip()
    for pattern, read in PROGRAMS.items():
        if re.search(pattern, head):
            return foreign_table(
                path, data, read, options.columns, options.measures
            )
    return None


def foreign_table(
    path: str | Path,
    data: bytes,
    read: _Reader | str,
    choice: str | None,
    measures: str,
) -> Table:
    """Read a file by its value in :data:`PROGRAMS`.

    ``choice`` names the body to read from a file with several bodies.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    if isinstance(read, str):
        raise InputError(f"cannot read {path}: {read}")
    try:
        header, rows, notes = read(data, choice)
    except MissingDependencyError:
        raise
    # If a file does not continue as it begins, a reader raises errors of many kinds.
    except Exception as error:
        raise _unreadable(path, error) from None
    table = Table(path, (*header,), measures)
    table.guesses = [f"{path}: {note}" for note in notes]
    return table.fill(enumerate(_text_rows(path, rows), 1), list)


def _text_rows(
    path: str | Path, rows: Iterable[Sequence[Any]]
) -> Iterator[list[str]]:
    """Yield the cells of rows as text, one row at a time, because a file may have millions of rows.

    Raises
    ------
    InputError
        If there are no rows, or a row cannot be read.
    """
    is_empty = True
    try:
        for row in rows:
            yield [str(cell) for cell in row]
            is_empty = False
    # If a file does not continue as it begins, a reader raises errors of many kinds.
    except Exception as error:
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
    """Read the sentences of a GNSS receiver."""
    return _Rows(_PLACE, *places_of(_lines(data)))


def _of_gpx(data: bytes, _: str | None) -> _Rows:
    """Read the points of a GPX track."""
    # Few files need this import, and it takes 3 ms.
    from xml.etree import ElementTree

    rows = []
    for point in ElementTree.fromstring(data).iterfind(".//{*}trkpt"):
        time = point.findtext("{*}time")
        height = point.findtext("{*}ele")
        if time is None:
            raise ValueError(
                "a point of the GPX track has no time; record it with times"
            )
        rows.append(
            (time, point.attrib["lat"], point.attrib["lon"], height or "0")
        )
    return _Rows(_PLACE, rows, ["heights of GPX are above the sea"])


def _of_rtklib(data: bytes, _: str | None) -> _Rows:
    """Read a position file of RTKLIB or Emlid with latitude, longitude and height."""
    if b"latitude(deg)" not in data and data.startswith(b"%"):
        raise ValueError(
            "RTKLIB without degrees: set out-solformat to llh, degrees"
        )
    rows = []
    for line in _lines(data):
        cells = line.replace(",", " ").split()
        if not cells or cells[0].startswith("%"):
            continue
        date = cells[0].replace("/", "-")
        stamp = (
            f"{date}T{cells[1]}Z"
            if "-" in date
            else _of_week(cells[0], cells[1])
        )
        rows.append((stamp, *cells[2:5]))
    is_utc = re.search(rb"(?m)^%\s+(UTC|JST)\b", data)
    return _Rows(_PLACE, rows, [] if is_utc else [GPS_TIME])


def _of_novatel(data: bytes, _: str | None) -> _Rows:
    """Read INSPVA and INSPVAX logs, with a long (#) or a short header (%)."""
    rows = []
    for line in _lines(data):
        head, _, body = line.partition(";")
        header = head.split(",")
        cells = body.split(",")
        # The latitude is 0 before there is a solution.
        if not header[0][1:].startswith("INSPVA") or not float(cells[2]):
            continue
        height = float(cells[4])
        angles = cells[8:11]
        if "INSPVAX" in header[0]:
            # Add the undulation of the geoid.
            height += float(cells[5])
            angles = cells[9:12]
        week = 5 if line[0] == "#" else 1
        rows.append(
            (
                _of_week(header[week], header[week + 1]),
                *cells[2:4],
                height,
                *angles,
            )
        )
    if not rows:
        raise ValueError(
            "the log of NovAtel contains neither INSPVA nor INSPVAX: log one of them"
        )
    return _Rows(
        (*_PLACE, "roll [deg]", "pitch [deg]", "heading [deg]"),
        rows,
        [GPS_TIME],
    )


def _of_week(week: str, second: str) -> str:
    """Return the stamp (s since 1970, GPS time) of a week of GPS and its second."""
    return repr(GPS_EPOCH_S + WEEK_S * int(week) + float(second))


# ---- poses


def _of_g2o(data: bytes, _: str | None) -> _Rows:
    """Read the vertices of a pose graph, in two or three dimensions."""
    vertices = [
        line.split()[1:9]
        for line in _lines(data)
        if line.startswith("VERTEX_SE")
    ]
    if not vertices:
        raise ValueError(
            "a g2o graph without vertices; save the optimised graph with its vertices"
        )
    vertices.sort(key=lambda row: int(row[0]))
    names = _POSE if len(vertices[0]) > len(_POSE) else ("x", "y", "yaw [rad]")
    return _Rows(("t [s]", *names), vertices, [_NUMBERED.format("vertices")])


def _of_colmap(data: bytes, _: str | None) -> _Rows:
    """Read poses of the world in the camera: a line of each image, and a line of its points."""
    lines = [line for line in _lines(data) if not line.startswith("#")]
    images = [line.split(maxsplit=9) for line in lines[::2] if line.strip()]
    if any(len(image) != 10 for image in images):
        raise ValueError(
            "COLMAP images.txt: expected an image and its points in turn, on two lines"
        )
    values = np.array([image[1:8] for image in images]).astype(float)
    Ts_camera_world = se3.from_quat_xyzw(values[:, 4:], values[:, [1, 2, 3, 0]])
    return _of_images(
        [image[9] for image in images], se3.inverse(Ts_camera_world), []
    )


def _of_json(data: bytes, _: str | None) -> _Rows:
    """Read ego_pose.json of nuScenes, or transforms.json of nerfstudio."""
    document: Any = {}
    with suppress(ValueError, RecursionError):
        document = json.loads(data)
    frames: Any = (
        document.get("frames") if isinstance(document, dict) else document
    )
    names = set()
    if isinstance(frames, list) and frames and isinstance(frames[0], dict):
        names = set(frames[0])
    if names >= {"timestamp", "translation", "rotation"}:
        rows = [
            (item["timestamp"], *item["translation"], *item["rotation"])
            for item in frames
        ]
        return _Rows(
            ("t [us]", *POSITION, "qw", "qx", "qy", "qz"), sorted(rows)
        )
    if "transform_matrix" not in names:
        raise ValueError(
            "it is JSON of an unsupported kind; expected transforms.json of "
            "nerfstudio, ego_pose.json of nuScenes, or csv"
        )
    Ts_world_camera = np.array(
        [item["transform_matrix"] for item in frames], dtype=float
    )
    Ts_world_camera[:, :3, :3] = se3.rotation_of(Ts_world_camera) @ _FLIP
    note = "axes of the camera: x right, y down, z forward, not those of OpenGL in the file"
    return _of_images(
        [str(item["file_path"]) for item in frames], Ts_world_camera, [note]
    )


def _of_images(
    names: Sequence[str], poses: FloatArray, notes: list[str]
) -> _Rows:
    """Return rows of poses (N, 4, 4) with the names of their images.

    The last number in the name of an image is its stamp. There are no stamps unless every name has
    a number.
    """
    images = [Path(name).stem for name in names]
    matrices = _as_rows(poses).tolist()
    rows = [
        (*matrix, image) for matrix, image in zip(matrices, images, strict=True)
    ]
    stamps = []
    for image in images:
        numbers = re.findall(r"\d+\.\d+|\d+", image)
        stamps += numbers[-1:]
    if len(stamps) < len(images):
        return _Rows((*MATRIX, "image"), rows, notes)
    # Seconds since 1970 have ten digits before the point; numbers of images have fewer.
    if min(len(stamp.partition(".")[0]) for stamp in stamps) < 10:
        notes = [_NUMBERED.format("images"), *notes]
    stamped = [(stamp, *row) for stamp, row in zip(stamps, rows, strict=True)]
    stamped.sort(key=lambda row: float(row[0]))
    return _Rows(("t", *MATRIX, "image"), stamped, notes)


def _of_motive(data: bytes, choice: str | None) -> _Rows:
    """Read a rigid body in a take of OptiTrack's Motive."""
    lines = csv.reader(_lines(data))
    head = [*islice(lines, _MOTIVE_HEADER_LINES)]
    # Number of the last line of the header; 0 without such a line, so that there are no bodies.
    last = next(
        (row for row, cells in enumerate(head) if "Time (Seconds)" in cells), 0
    )
    # Number of the line with the kind of each column.
    kinds = next(
        (row for row in range(1, last) if "Rigid Body" in head[row]), None
    )
    if kinds is None:
        raise ValueError("it contains no rigid bodies of Motive: export them")
    columns = zip(
        head[kinds], head[kinds + 1], head[last - 1], head[last], strict=False
    )
    places_of_bodies = _places_of_bodies(columns)
    body = _chosen(places_of_bodies, choice, "rigid bodies")
    place_of = places_of_bodies[body]
    if not place_of.keys() >= {*_POSE}:
        raise ValueError(
            "it contains Euler angles of Motive: export with rotation type Quaternion"
        )
    # The first line contains names and values in turn.
    properties = dict(zip(head[0][::2], head[0][1::2], strict=False))
    unit = _MOTIVE_UNITS[properties.get("Length Units", "Meters")]
    places = [head[last].index("Time (Seconds)")]
    places += [place_of[name] for name in _POSE]
    table = chain(head[last + 1 :], lines)
    complete = (cells for cells in table if len(cells) > max(places))
    rows = ([cells[place] for place in places] for cells in complete)
    positions = [f"{axis} [{unit}]" for axis in POSITION]
    header = ("t [s]", *positions, *QUATERNION)
    return _Rows(header, rows, [f"poses of rigid body {body}"])


def _places_of_bodies(
    columns: Iterable[tuple[str, ...]],
) -> dict[str, dict[str, int]]:
    """Return the columns of x, y, z, qx, qy, qz and qw of each rigid body of Motive.

    ``columns`` are the kind, the body, the quantity and the axis of each column.
    """
    places: dict[str, dict[str, int]] = {}
    for place, (kind, body, quantity, axis) in enumerate(columns):
        prefix = {"Position": "", "Rotation": "q"}.get(quantity)
        if kind == "Rigid Body" and prefix is not None:
            places.setdefault(body, {})[f"{prefix}{axis.lower()}"] = place
    return places


def _of_vicon(data: bytes, choice: str | None) -> _Rows:
    """Read a segment of Vicon Nexus, or an object of Vicon Tracker.

    Its rotations are rotation vectors, or quaternions if there is a column RW.
    """
    lines = csv.reader(_lines(data))
    _, rates, names, columns, units = islice(lines, 5)
    rate_hz = float(rates[0])
    if "RX" not in columns:
        raise ValueError(
            "it contains no segments of Vicon: export Segments or Objects (global), not markers"
        )
    # Columns of each body: its rotation from RX on, then its position from TX on.
    starts = {
        names[at] or "object": at
        for at, name in enumerate(columns)
        if name == "RX"
    }
    body = _chosen(starts, choice, "segments")
    start = starts[body]
    place = columns.index("TX", start)
    end = place + len(POSITION)
    rows = (
        [int(cells[0]) / rate_hz, *cells[start:end]]
        for cells in lines
        if len(cells) >= end and all(cells[start:end])
    )
    if "RW" in columns[start:place]:
        kind = "quaternions"
        rotation = [*QUATERNION]
    else:
        kind = "rotation vectors"
        rotation = [f"{name} [{units[start]}]" for name in ROTATION_VECTOR]
    header = (
        "t [s]",
        *rotation,
        *(f"{axis} [{units[place]}]" for axis in POSITION),
    )
    return _Rows(header, rows, [f"poses of {body}; rotations read as {kind}"])


def _of_numpy(data: bytes, _: str | None) -> _Rows:
    array = np.load(io.BytesIO(data), allow_pickle=False)
    return _Rows(*columns_of_array(array))


def _of_pcd(data: bytes, _: str | None) -> _Rows:
    """Read the key poses of LIO-SAM, which are points with angles and a time."""
    head, encoding, body = re.split(rb"(?m)^DATA (\w+)\r?\n", data, maxsplit=1)
    fields = {name: values for name, *values in map(str.split, _lines(head))}
    names = fields["FIELDS"]
    if encoding == b"ascii":
        return _Rows(names, map(str.split, _lines(body)))
    if encoding != b"binary":
        raise ValueError(
            "its points are compressed; unpack them: pcl_convert_pcd_ascii_binary IN.pcd OUT.pcd 1"
        )
    columns = zip(names, fields["TYPE"], fields["SIZE"], strict=True)
    dtype = [(name, f"<{kind.lower()}{size}") for name, kind, size in columns]
    return _Rows(
        names, np.frombuffer(body, dtype, int(fields["POINTS"][0])).tolist()
    )


def _of_ulog(data: bytes, _: str | None) -> _Rows:
    """Read a log of PX4: the odometry of its estimator, or local positions with attitudes."""
    stamps_us, Ts = logged_poses(data)
    flip = np.diag([*np.diag(_FLIP), 1.0])
    poses = _as_rows(flip @ Ts @ flip).tolist()
    rows = [
        (stamp_us, *pose)
        for stamp_us, pose in zip(stamps_us.tolist(), poses, strict=True)
    ]
    note = "axes: x forward, y left, z up, in north, west, up; PX4 has forward, right, down"
    return _Rows(("t [us]", *MATRIX), rows, [note])


def _as_rows(poses: FloatArray) -> FloatArray:
    """Return the first three rows of each pose (N, 4, 4) as one row of (N, 12)."""
    return poses[:, :3].reshape(-1, 12)


def _chosen(bodies: Mapping[str, Any], choice: str | None, noun: str) -> str:
    """Return the body ``choice`` or the only body; raise ValueError if there are several."""
    if choice in bodies:
        return str(choice)
    if len(bodies) != 1:
        listed = shortened(", ".join(bodies), LONGEST_NAME)
        raise ValueError(f"several {noun}: {listed}; name one with `columns`")
    return next(iter(bodies))


# Number of the first cell of the pose in a message, by the number of cells of the message.
_POSE_CELL = {
    10: 3,  # PoseStamped
    46: 3,  # PoseWithCovarianceStamped
    89: 4,  # Odometry
    11: 4,  # TransformStamped
}


def _of_echo(data: bytes, _: str | None) -> _Rows:
    """Read messages with a header as ``ros2 topic echo --csv`` writes them."""
    messages = [line.split(",") for line in _lines(data) if line]
    start = _POSE_CELL.get(len(messages[0]))
    if start is None:
        raise ValueError(
            "messages of ros2 topic echo --csv without poses; record a bag"
        )
    rows = ([*cells[:2], *cells[start : start + 7]] for cells in messages)
    return _Rows(("secs", "nsecs", *_POSE), rows)


#: Formats by a pattern of the beginning of a file: the function that reads the file, or a sentence
#: about files that cannot be read. Files with a row of numbers on each line are not among them.
PROGRAMS: dict[bytes, _Reader | str] = {
    rb"\Asource_timestamp,destination_timestamp": "motions between images, no poses; chain them",
    rb"<gpx[\s>]": _of_gpx,
    rb"(?i)\A\s*<(!doctype html|html)": "it is a web page, perhaps of a sign-in or an error; "
    "download the file itself",
    rb"\A\{\\rtf": "it is a document of a word processor; save it as plain text",
    rb"\APK\x03\x04": "it is a .zip archive or a spreadsheet; unpack it, or save it as csv",
    rb"\A\x1f\x8b": "it is compressed; unpack it with gunzip",
    rb"\A<": "it is XML of an unsupported kind; export the track as GPX, or poses as csv",
    rb"\AFMT, \d": "it is a log of ArduPilot; export positions and attitudes as "
    "csv, or record a bag",
    rb"\A\w+ \{\s": "it contains messages as text; record them as a bag",
    rb"\A[^\n]*RINEX VERSION": "it contains observations of satellites; compute positions "
    "with RTKLIB",
    rb"\ASQLite format 3": "it is a database; a bag must end in .db3, and COLMAP can "
    "export its model as text",
    rb"\A(#.*\n)+#\s+(FRAME_ID, RIG|CAMERA_ID, MOD|POINT3D)": "no poses; pass images.txt of COLMAP",
    rb"\A(# \.PCD|VERSION 0?\.7)[^\0]*?\nFIELDS .*\broll\b": _of_pcd,
    rb"\A(ply\r?\n|# \.PCD|VERSION 0?\.7)": "points, no trajectory; record the odometry as a bag",
    rb"\A[#%][A-Z\d]+A,[^;\n]*;": _of_novatel,
    rb"\A(%YAML|---\s|[A-Za-z]\w*: *\n[ -])": "YAML without a trajectory; record a bag, or "
    "pass samples of an arm as the only file",
    rb"\A\x93NUMPY": _of_numpy,
    rb"\AULog\x01\x12\x35": _of_ulog,
    rb"\A(\{|\[\s*[\[{\"\d-])": _of_json,
    rb"\$[A-Z]{2}(GGA|RMC),": _of_nmea,
    rb"\A\d{9,10},\d{1,9},(?=[^,\n]*[A-Za-z/])[^,\n]*,": _of_echo,
    rb"(?m)^%\s+(GPST|UTC|JST)\b.*(latitude|ecef|baseline)": _of_rtklib,
    # Emlid writes no header. Degrees have nine or more decimals; metres have four.
    rb"\A\d{4}/\d\d/\d\d +\S+( +-?\d+\.\d{9,}){2} ": _of_rtklib,
    rb"\A\d{4}/\d\d/\d\d +\S+ +-?\d+\.\d{4} ": "RTKLIB without degrees: set its format to llh",
    rb"\A#.*\n(#.*\n)*#\s+IMAGE_ID, QW": _of_colmap,
    rb"(?m)^(VERTEX|EDGE)_SE(2|3:QUAT) ": _of_g2o,
    rb"\AFormat Version,": _of_motive,
    rb"\A(Segments|Objects|Trajectories)\b.*\r?\n\d+": _of_vicon,
}
