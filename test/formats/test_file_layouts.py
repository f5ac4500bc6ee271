"""Layouts of text files: the same poses are read from whatever text above the columns, separators,
forms of numbers and dates, and orders of columns a program writes them with.
"""

from datetime import UTC, datetime

import numpy as np
import pytest
from motions import (
    as_trajectory,
    geodetic,
    read_trajectory_file,
    wandering_poses,
)
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.trajectory_files.file_options import (
    AUTO,
    FileOptions,
)
from hand_eye_calib.formats.trajectory_files.reading import (
    read_trajectory_files,
)

N = 60
START_NS = 1_700_000_000_250_000_000
# Away from the identity, so that no column is 0 or 1 by chance.
AWAY = se3.exp(np.array([3.0, -2.0, 1.0, 0.4, -0.9, 0.7]))
TRUTH = as_trajectory(
    AWAY @ wandering_poses(N), rate_hz=20.0, start_ns=START_NS
)
STAMPS_NS = TRUTH.stamps_ns.tolist()


def parts_of(poses):
    """Positions, rotations, quaternions with the scalar last and first; rotations and poses row by
    row and column by column.
    """
    rotations = poses[:, :3, :3]
    quats_xyzw = se3.to_quat_xyzw(poses)
    quats_wxyz = np.roll(quats_xyzw, 1, axis=1)
    flat = [
        matrices.reshape(N, -1)
        for matrices in (
            rotations,
            np.swapaxes(rotations, 1, 2),
            poses,
            np.swapaxes(poses, 1, 2),
        )
    ]
    return poses[:, :3, 3], rotations, quats_xyzw, quats_wxyz, *flat


def weeks_and_seconds():
    """Week of GPS and second of the week of every pose."""
    week_ns = 604_800_000_000_000
    since_1980_ns = [
        stamp_ns - 315_964_800_000_000_000 for stamp_ns in STAMPS_NS
    ]
    weeks = [stamp_ns // week_ns for stamp_ns in since_1980_ns]
    return weeks, [
        f"{stamp_ns % week_ns / 1e9:.3f}" for stamp_ns in since_1980_ns
    ]


P, R, Q, WXYZ, ROWS, COLUMNS, MATRIX, TRANSPOSED = parts_of(TRUTH.poses)
VECTORS = se3.rotation_log(R)
RPY_DEG = Rotation.from_matrix(R).as_euler("xyz", degrees=True)
# A place south of the equator and west of Greenwich.
LAT, LON, HEIGHT = geodetic(P - P[0], (-33.5, -70.25, 600.0))
COVARIANCE = np.tile(np.linspace(0.0, 0.35, 36), (N, 1))
SECONDS = [
    f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}" for stamp_ns in STAMPS_NS
]
WEEKS, SOW = weeks_and_seconds()


def dates(form):
    moments = [
        datetime.fromtimestamp(stamp_ns // 10**9, UTC) for stamp_ns in STAMPS_NS
    ]
    texts = [moment.strftime(form) for moment in moments]
    return [
        text.replace("mmm", f"{stamp_ns % 10**9 // 10**6:03d}")
        for text, stamp_ns in zip(texts, STAMPS_NS, strict=True)
    ]


def text_of(*columns, head="", separator=" ", decimals="{:.12g}"):
    """A text with one line per pose; columns are texts, or numbers (N,) or (N, k)."""
    cells = [[] for _ in range(N)]
    for column in columns:
        for row, value in zip(cells, column, strict=True):
            if isinstance(value, str | int):
                row.append(str(value))
            else:
                row += [
                    decimals.format(number)
                    for number in np.atleast_1d(value).ravel()
                ]
    return head + "".join(separator.join(row) + "\n" for row in cells)


def sexagesimal(degrees, sides, form="{d} {m} {s:.9f}"):
    """Degrees, minutes and seconds, with a sign or with the letter of a hemisphere."""
    texts = []
    for value in degrees:
        size = abs(value)
        whole = int(size)
        minutes = int((size - whole) * 60)
        seconds = (size - whole) * 3600 - 60 * minutes
        text = form.format(d=whole, m=minutes, s=seconds)
        if sides:
            text += sides[int(value < 0)]
        elif value < 0:
            text = "-" + text
        texts.append(text)
    return texts


def with_comma(text):
    return text.replace(".", ",")


NAMES = "t,x,y,z,qx,qy,qz,qw\n"
POSE_NAMES = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
ROS_NAMES = (
    "__time,/odom/header/stamp,/odom/pose/covariance[0;0],/odom/pose/covariance[1;1],"
    + ",".join(f"/odom/pose/pose/position/{axis}" for axis in "xyz")
    + ","
    + ",".join(f"/odom/pose/pose/orientation/{axis}" for axis in "xyzw")
    + "\n"
)
QUOTED = '"t","x, east","pos_y","z","qx","qy","qz","qw"\n'
PROSE = "Project:     demo\nProgram:     Version 8.90.2428\n\nDatum:       WGS84, ITRF\n\n"
INS_NAMES = (
    "Remarks: 2023 11 14\n\n   Time  Easting  Northing  H-Ell  qx  qy  qz  qw\n"
)
WITH_UNITS = (
    f"{INS_NAMES}  (sec)   (mm)   (mm)   (mm)   (-)   (-)   (-)   (-)\n"
)
ZERO_BASED = [f"T_{row}{column}" for row in range(3) for column in range(4)]
IN_BRACKETS = [f"T[{row}][{column}]" for row in range(4) for column in range(4)]
ONE_BASED = [f"r{row}{column}" for row in "123" for column in "123"]

LAYOUTS = {
    # Text above the columns, names and comments.
    "text above": text_of(SECONDS, P, Q, head=PROSE + INS_NAMES),
    "text and units": text_of(SECONDS, P * 1e3, Q, head=PROSE + WITH_UNITS),
    "text above csv": text_of(SECONDS, P, Q, head=f"Log of 3 sensors\nrate, 20, Hz\n{NAMES}",
                              separator=","),
    "names behind #": text_of(SECONDS, ["cam 1"] * N, WXYZ, P, separator=", ",
                              head="# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz\n"),
    "names behind %": text_of(SECONDS, P, Q, head="% t x y z qx qy qz qw\n"),
    "names behind # and units": text_of(SECONDS, P * 100, Q, separator=",",
                                        head="#t,x,y,z,qx,qy,qz,qw\n#s,cm,cm,cm,-,-,-,-\n"),
    "semicolons in names": text_of(SECONDS, SECONDS, P[:, :2], P, Q, head=ROS_NAMES, separator=","),
    "commas in names": text_of(SECONDS, COVARIANCE[:, :1], P, Q, separator=",",
                               head=NAMES.replace("x,", "cov[0,1],x,", 1)),
    "quoted names": text_of(SECONDS, P, Q, head=QUOTED.replace("x, east", "x"), separator=","),
    "all quoted": text_of(*([f'"{number:.12g}"' for number in column] for column in
                            [*P.T, *Q.T]), SECONDS, head="x,y,z,qx,qy,qz,qw,t\n", separator=","),
    "byte order mark and CRLF": ("\ufeff" + text_of(SECONDS, P, Q, head=NAMES, separator=","))
    .replace("\n", "\r\n"),
    "separator at the end": text_of(SECONDS, P, Q, [""] * N, head=NAMES, separator=","),
    "separator at the end of the names": text_of(SECONDS, P, Q, separator=",",
                                                 head="t,x,y,z,qx,qy,qz,qw,\n"),
    "text cells": text_of(SECONDS, ["map"] * N, ["base"] * N, P, Q, separator="\t",
                          head="stamp\tframe\tchild\tx\ty\tz\tqx\tqy\tqz\tqw\n"),
    "names of frames without header": text_of(SECONDS, ["cam0"] * N, P, Q),
    # Separators and numbers.
    "tabs with empty cells": text_of(SECONDS, [""] * N, P, Q, separator="\t",
                                     head="t\tnote\tx\ty\tz\tqx\tqy\tqz\tqw\n"),
    "bars": text_of(SECONDS, P, Q, head=NAMES.replace(",", "|"), separator=" | "),
    "decimal commas and blanks": with_comma(text_of(SECONDS, P, Q)),
    "decimal commas and tabs": with_comma(text_of(SECONDS, P, Q, separator="\t")),
    "decimal commas and semicolons": with_comma(text_of(SECONDS, P, Q, separator=";",
                                                        head=NAMES.replace(",", ";"))),
    "decimal commas in quotes": text_of(*([f'"{with_comma(f"{number:.12g}")}"' for number in column]
                                          for column in [*P.T, *Q.T]), SECONDS, separator=",",
                                        head="x,y,z,qx,qy,qz,qw,t\n"),
    # More columns behind.
    "covariance behind": text_of(SECONDS, P, Q, COVARIANCE),
    "half a covariance behind": text_of(SECONDS, P, Q, COVARIANCE[:, :21], separator=","),
    "matrix and covariance": text_of(SECONDS, MATRIX[:, :12], COVARIANCE),
    # Dates.
    "date and time": text_of(dates("%Y-%m-%d %H:%M:%S.mmm"), P, Q, head=NAMES, separator=","),
    "date and time, no names": text_of(dates("%Y-%m-%d %H:%M:%S.mmm"), P, Q),
    "date and time, zone": text_of(dates("%Y-%m-%dT%H:%M:%S.mmm+00:00"), P, Q, separator=","),
    "date and time in one name": text_of(dates("%Y/%m/%d %H:%M:%S.mmm"), P, Q,
                                         head=NAMES.replace(",", " ")),
    "date and time, two names": text_of(dates("%d.%m.%Y"), dates("%H:%M:%S,mmm"), P, Q,
                                        separator=";", head="Date;Time;x;y;z;qx;qy;qz;qw\n"),
    "date with dashes": text_of(dates("%Y-%m-%d-%H-%M-%S-mmm"), P, Q),
    "date with underscores": text_of(dates("%Y_%m_%d_%H_%M_%S_mmm"), MATRIX[:, :12]),
    "packed date": text_of(dates("%Y%m%d_%H%M%S.mmm"), P, Q),
    "packed number": text_of(dates("%Y%m%d%H%M%S.mmm"), P, Q),
    "name of the month": text_of(dates("%d-%b-%Y %H:%M:%S.mmm"), P, Q, head=NAMES, separator=","),
    "twelve hours": text_of(dates("%m/%d/%Y %I:%M:%S.mmm %p"), P, Q, head=NAMES, separator=","),
    # Rotations and translations.
    "rotation, then translation": text_of(SECONDS, ROWS, P),
    "translation, then rotation": text_of(SECONDS, P, ROWS, separator=","),
    "quaternion, then translation": text_of(SECONDS, Q, P),
    "matrix of 16": text_of(SECONDS, MATRIX),
    "transposed matrix of 16": text_of(SECONDS, TRANSPOSED),
    "transposed matrix of 16, csv": text_of(STAMPS_NS, TRANSPOSED, separator=","),
    "named from 0": text_of(SECONDS, MATRIX[:, :12], separator=",",
                            head=",".join(["t", *ZERO_BASED]) + "\n"),
    "named in brackets": text_of(SECONDS, MATRIX, separator=",",
                                 head=",".join(["t", *IN_BRACKETS]) + "\n"),
    "named from 1, translation by axes": text_of(SECONDS, P, ROWS, separator=",",
                                                 head=",".join(["t", *"xyz", *ONE_BASED]) + "\n"),
    "columns of a matrix by name": text_of(SECONDS, COLUMNS, P, separator=",",
                                           head=",".join(["t", *(f"r{c}{r}" for r in "123"
                                                                 for c in "123"), *"xyz"]) + "\n"),
    "covariance by one name": text_of(
        SECONDS, ["cam_1"] * N, WXYZ, P, COVARIANCE, separator=", ",
        head="# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz, *covar\n",
    ),
    "no covariance by its name": text_of(
        SECONDS, ["cam_1"] * N, WXYZ, P, separator=", ",
        head="# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz, *covar\n",
    ),
    "seconds and nanoseconds": text_of(
        [stamp_ns // 10**9 for stamp_ns in STAMPS_NS],
        [stamp_ns % 10**9 for stamp_ns in STAMPS_NS], P, Q,
    ),
    "paths that end in short names": text_of(
        SECONDS, P, Q, separator=",",
        head="t," + ",".join(f"rig_{name}" for name in POSE_NAMES) + "\n",
    ),
    "state of FAST-LIO": text_of(SECONDS, VECTORS, P, np.zeros((N, 15)),
                                 np.tile([0.0, 0.0, -9.81], (N, 1))),
    "angles": text_of(SECONDS, P, RPY_DEG, separator=",",
                      head="time [s],x [m],y [m],z [m],roll [deg],pitch [deg],yaw [deg]\n"),
}  # fmt: skip


def written(path, text):
    path.write_bytes(text.encode())
    return path


def read(path, **options):
    return read_trajectory_file(path, AUTO, repair=True, **options)


def assert_is_the_truth(trajectory, atol=1e-9):
    assert_allclose(trajectory.stamps_ns, TRUTH.stamps_ns, rtol=0, atol=1000)
    assert_allclose(trajectory.poses, TRUTH.poses, rtol=0, atol=atol)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_same_poses_are_read_from_every_layout(tmp_path, layout):
    reading = read(written(tmp_path / "poses.txt", LAYOUTS[layout]))
    assert_is_the_truth(reading.trajectory)
    assert reading.repairs == []
    assert reading.warnings == []


ENCODINGS = ["utf-8", "utf-16", "latin-1"]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_text_is_read_in_every_usual_encoding(tmp_path, encoding):
    head = "t,x,y,z,roll (°),pitch (°),yaw (°)\n"
    path = tmp_path / "poses.csv"
    path.write_bytes(
        text_of(SECONDS, P, RPY_DEG, head=head, separator=",").encode(encoding)
    )
    assert_is_the_truth(read(path).trajectory)


IN_WORDS = "Time  Latitude  Longitude  H-Ell  Roll  Pitch  Yaw\n"
UNITS = "(s)  (+/-D M S)  (+/-D M S)  (m)  (deg)  (deg)  (deg)\n"
PLACES = {
    "degrees": text_of(SECONDS, LAT, LON, HEIGHT, RPY_DEG, head=PROSE + IN_WORDS),
    "paths of messages": text_of(SECONDS, LAT, LON, HEIGHT, RPY_DEG, separator=",",
                                 head="__time,/gps/fix/latitude,/gps/fix/longitude,"
                                 "/gps/fix/altitude,roll,pitch,yaw\n"),
    "D M S in three cells": text_of(SECONDS, sexagesimal(LAT, ""), sexagesimal(LON, ""), HEIGHT,
                                    RPY_DEG, head=PROSE + IN_WORDS + UNITS),
    "hemispheres in the cells": text_of(SECONDS, sexagesimal(LAT, "NS"), sexagesimal(LON, "EW"),
                                        HEIGHT, RPY_DEG, separator=",",
                                        head=IN_WORDS.replace("  ", ",")),
    "signs of degrees": text_of(SECONDS, sexagesimal(LAT, "NS", "{d}°{m:02d}'{s:.9f}\""),
                                sexagesimal(LON, "EW", "{d}°{m:02d}'{s:.9f}\""), HEIGHT, RPY_DEG,
                                separator=",", head=IN_WORDS.replace("  ", ",")),
    "colons": text_of(SECONDS, sexagesimal(LAT, "", "{d}:{m:02d}:{s:.9f}"),
                      sexagesimal(LON, "", "{d}:{m:02d}:{s:.9f}"), HEIGHT, RPY_DEG,
                      separator=";", head=IN_WORDS.replace("  ", ";")),
    "hemispheres in columns": text_of(SECONDS, abs(LAT), ["S"] * N, abs(LON), ["W"] * N, HEIGHT,
                                      RPY_DEG, separator=",",
                                      head="Time,Lat,N/S,Lon,E/W,Height,Roll,Pitch,Yaw\n"),
    "hemispheres without names": text_of(SECONDS, abs(LAT), ["S"] * N, abs(LON), ["W"] * N, HEIGHT,
                                         RPY_DEG, head=IN_WORDS),
}  # fmt: skip


@pytest.mark.parametrize("form", PLACES)
def test_latitudes_are_read_in_every_form(tmp_path, form):
    path = written(tmp_path / "ins.txt", PLACES[form])

    trajectory = read(path).trajectory

    positions = trajectory.poses[:, :3, 3]
    rotations = trajectory.poses[:, :3, :3]
    assert_array_equal(trajectory.stamps_ns, TRUTH.stamps_ns)
    # Of the metres, 12 digits of a latitude leave 1e-5, and the axes of the first position 1e-4.
    assert_allclose(positions, P - P[0], atol=5e-4)
    assert_allclose(rotations, R, atol=1e-5)


MS_OF_WEEK = [f"{1e3 * float(second):.0f}" for second in SOW]
GPS = {
    "week and second of it": ("GPSWeek,GPSTime", WEEKS, SOW),
    "other names": ("week,sow", WEEKS, SOW),
    "time of week": ("GPS Week,TOW (s)", WEEKS, SOW),
    "milliseconds": ("GPS Week,TOW [ms]", WEEKS, MS_OF_WEEK),
    "unit behind the name": ("week,tow_s", WEEKS, SOW),
    "milliseconds behind the name": ("gps_week,tow_ms", WEEKS, MS_OF_WEEK),
    "in other order": ("gps_tow_ms,gps_week", MS_OF_WEEK, WEEKS),
    "numbers": ("gps_wn,gps_sow_s", WEEKS, SOW),
    "one word": ("gpsWeek,timeOfWeek", WEEKS, SOW),
    "ublox": ("wn,iTOW", WEEKS, MS_OF_WEEK),
    "ublox with its unit": ("week,itow_ms", WEEKS, MS_OF_WEEK),
    "septentrio": ("WNc,TOW", WEEKS, MS_OF_WEEK),
    "ardupilot": ("GWk,GMS", WEEKS, MS_OF_WEEK),
    "novatel": ("gps_week_number,gps_week_milliseconds", WEEKS, MS_OF_WEEK),
    "milliseconds without a word": ("gps_week,gps_tow", WEEKS, MS_OF_WEEK),
    "milliseconds of the week": ("week,ms_of_week", WEEKS, MS_OF_WEEK),
}


@pytest.mark.parametrize("form", GPS)
def test_a_week_of_gps_and_its_second_are_stamps(tmp_path, form):
    names, *columns = GPS[form]
    text = text_of(
        *columns, P, Q, head=f"{names},x,y,z,qx,qy,qz,qw\n", separator=","
    )
    reading = read(written(tmp_path / "ins.csv", text))
    assert_is_the_truth(reading.trajectory)
    assert any("18 s ahead of UTC" in guess for guess in reading.guesses)


@pytest.mark.parametrize(
    "name", ["itow", "tow_ms", "ms_of_week", ".navpvt.iTOW"]
)
def test_milliseconds_of_a_week_are_stamps_without_the_week(tmp_path, name):
    head = f"{name},x,y,z,qx,qy,qz,qw\n"
    path = written(
        tmp_path / "ins.csv",
        text_of(MS_OF_WEEK, P, Q, head=head, separator=","),
    )
    week_ns = 604_800_000_000_000
    of_week_ns = (TRUTH.stamps_ns - 315_964_800_000_000_000) % week_ns
    assert_array_equal(read(path).trajectory.stamps_ns, of_week_ns)


def test_a_table_keeps_the_unit_of_the_second_of_a_week():
    pd = pytest.importorskip("pandas")
    table = pd.DataFrame(
        {"gps_week": WEEKS, "tow_ms": [int(text) for text in MS_OF_WEEK]}
    )
    for column, name in enumerate(("x", "y", "z")):
        table[name] = P[:, column]
    for column, name in enumerate(("qx", "qy", "qz", "qw")):
        table[name] = Q[:, column]
    trajectory = hec.read_trajectory(table)
    assert_array_equal(trajectory.stamps_ns, TRUTH.stamps_ns)


@pytest.mark.parametrize(
    ("period_s", "name"), [(604_800, "sow"), (86_400, "time")]
)
def test_stamps_go_on_where_a_week_or_a_day_begins_again(
    tmp_path, period_s, name
):
    since_start = np.arange(N) * 0.05
    stamps = np.mod(period_s - 1.0 + since_start, period_s)
    text = text_of(stamps, P, Q, head=f"{name},{NAMES[2:]}", separator=",")
    trajectory = read(written(tmp_path / "ins.csv", text)).trajectory
    assert np.diff(trajectory.stamps_ns).tolist() == pytest.approx(
        [50_000_000] * (N - 1), abs=2
    )


def test_times_of_day_are_stamps_in_seconds_of_the_day(tmp_path):
    text = text_of(dates("%H:%M:%S.mmm"), P, Q, head=NAMES, separator=",")
    stamps_ns = read(written(tmp_path / "a.csv", text)).trajectory.stamps_ns
    midnight_ns = START_NS // 86_400_000_000_000 * 86_400_000_000_000
    assert_array_equal(stamps_ns, TRUTH.stamps_ns - midnight_ns)


# ---- rows without a pose

NO_POSE = {
    "nan": "nan nan nan nan nan nan nan",
    "NaN alone": "1 2 nan 0 0 0 1",
    "infinite": "inf 0 0 0 0 0 1",
    "null": "null null null null null null null",
    "N/A": "N/A N/A N/A N/A N/A N/A N/A",
    "no orientation": "0 0 0 0 0 0 0",
    "empty": "       ",
    "nothing but a stamp": "",
}


@pytest.mark.parametrize("kind", NO_POSE)
@pytest.mark.parametrize("separator", [" ", ",", ";"])
def test_rows_without_a_pose_are_left_out_and_counted(
    tmp_path, kind, separator
):
    if kind == "empty" and separator == " ":
        pytest.skip("blanks separate no empty cells")
    lines = text_of(SECONDS, P, Q, separator=separator).splitlines()
    lost = (0, 7, 8)
    for row in lost:
        cells = (
            [SECONDS[row], *NO_POSE[kind].split(" ")]
            if NO_POSE[kind]
            else [SECONDS[row]]
        )
        lines[row] = separator.join(cells[:8])
    head = "" if separator == " " else NAMES.replace(",", separator)
    path = written(tmp_path / "poses.txt", head + "\n".join(lines))
    reading = read(path)
    kept = np.delete(np.arange(N), lost)
    assert_allclose(reading.trajectory.poses, TRUTH.poses[kept], atol=1e-9)
    assert reading.warnings == []
    (repair,) = reading.repairs
    assert f"3 of {N} poses (5.0%) were left out" in repair
    assert repair.endswith(f"the first is on line {1 + bool(head)}")


def test_many_rows_without_a_pose_are_warned_of(tmp_path, capsys):
    from hand_eye_calib.offline.cli.main import main

    lines = text_of(SECONDS, P, Q).splitlines()
    for row in range(0, N, 8):
        lines[row] = f"{SECONDS[row]} nan nan nan nan nan nan nan"
    lost = written(tmp_path / "lost.tum", "\n".join(lines))
    whole = written(tmp_path / "whole.tum", text_of(SECONDS, P, Q))
    main(["calibrate", str(whole), str(lost), "--method", "park"])
    printed = "".join(capsys.readouterr())
    assert "lost.tum: 8 of 60 poses (13%) were left out" in printed
    assert (
        "This is a large share: check whether the source loses track"
        in " ".join(printed.split())
    )


def test_a_file_without_any_pose_is_one_line(tmp_path):
    path = written(
        tmp_path / "a.tum",
        "\n".join(f"{k} nan nan nan 0 0 0 1" for k in range(9)),
    )
    with pytest.raises(
        InputError,
        match="the file contains no poses: all 9 rows are empty, zero or not fin",
    ):
        read(path)


def test_rows_that_are_paired_are_left_out_of_both_files(tmp_path):
    mount = se3.exp(np.array([0.3, -0.2, 0.1, 0.5, -1.0, 0.7]))
    child = TRUTH.poses @ mount
    lines = [
        text_of(P, Q).splitlines(),
        text_of(child[:, :3, 3], se3.to_quat_xyzw(child)).splitlines(),
    ]
    lines[0][3] = "nan nan nan nan nan nan nan"
    lines[1][20] = "0 0 0 0 0 0 0"
    files = [
        written(tmp_path / f"{k}.txt", "\n".join(rows))
        for k, rows in enumerate(lines)
    ]
    options = FileOptions(format=AUTO, pair_by="row")
    readings = read_trajectory_files([(file, options) for file in files])
    first, second = (reading.trajectory for reading in readings)
    assert len(first) == len(second) == N - 2
    assert_allclose(first.poses @ mount, second.poses, atol=1e-9)


def test_arrays_with_nan_and_transposed_matrices():
    poses = TRUTH.poses.copy()
    poses[5] = np.nan
    times = TRUTH.stamps_ns / 1e9
    with pytest.warns(UserWarning, match="1 of 60 poses"):
        trajectory = hec.read_trajectory(poses, times=times)
    assert_allclose(
        trajectory.poses, np.delete(TRUTH.poses, 5, axis=0), atol=1e-12
    )
    with pytest.warns(UserWarning, match="matrices are transposed"):
        trajectory = hec.read_trajectory(
            np.swapaxes(TRUTH.poses, 1, 2), times=times
        )
    assert_allclose(trajectory.poses, TRUTH.poses, atol=1e-12)
    poses = TRUTH.poses.copy()
    poses[:, 3, 3] = 2.0
    with pytest.raises(
        InputError, match="the last row of a matrix is not 0 0 0 1"
    ):
        hec.read_trajectory(poses, times=times)


# ---- stamps without their last digits

COARSE = {
    "%.9e": "have whole seconds only",
    "%.6g": "of all .* poses are the same",
    "%.0f": "have whole seconds only",
    "%.1f": "have steps of 0.1 s",
}


@pytest.mark.parametrize("form", COARSE)
def test_stamps_without_their_last_digits_are_refused(tmp_path, form):
    stamps = [form % (stamp_ns * 1e-9) for stamp_ns in STAMPS_NS]
    path = written(tmp_path / "sci.tum", text_of(stamps, P, Q))
    with pytest.raises(
        InputError, match=f"sci.tum: the timestamps {COARSE[form]}"
    ) as caught:
        read(path)
    assert "write all digits" in str(caught.value)


def test_whole_seconds_of_a_slow_stream_and_repeated_lines_are_right(tmp_path):
    slow = [str(START_NS // 10**9 + k) for k in range(N)]
    assert (
        len(
            read(written(tmp_path / "slow.tum", text_of(slow, P, Q))).trajectory
        )
        == N
    )
    twice = "".join(
        line + line for line in text_of(SECONDS, P, Q).splitlines(keepends=True)
    )
    reading = read(written(tmp_path / "twice.tum", twice))
    assert_is_the_truth(reading.trajectory)
    assert "dropped 60 with a repeated stamp" in reading.repairs[0]


# ---- one line with the cause

REFUSED = {
    "names that do not fit": (
        text_of(SECONDS, P, Q, head="t,x,y,z,qx,qy,qz,qw,vx\n", separator=","),
        "line 1: names 9 columns, but the rows have 8 cells",
    ),
    "angles without names": (
        text_of(SECONDS, P, RPY_DEG),
        "Otherwise name the 7",
    ),
    "a row in between with another number": (
        text_of(SECONDS, P, Q).replace("\n", "\n1 2 3\n", 1),
        "line 2: expected 8 numbers, timestamp .* found 3",
    ),
    "several sensors": (
        text_of(SECONDS, ["left", "right"] * (N // 2), P, Q, separator=",",
                head="t,device_id,x,y,z,qx,qy,qz,qw\n"),
        "poses of several sensors, device_id left, right; write one file for each",
    ),
    "nmea degrees": (
        text_of(SECONDS, [3330.5] * N, [7015.2] * N, HEIGHT, head="t lat lon height\n"),
        "line 2: found latitude 3330.5 deg",
    ),
    "sixty minutes": (
        text_of(SECONDS, ["33 61 0 S"] * N, ["70 1 0 W"] * N, HEIGHT, separator=",",
                head="t,lat,lon,height\n"),
        "could not convert string to float: '33 61 0 S'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_be_read_gets_one_line(tmp_path, kind):
    text, message = REFUSED[kind]
    with pytest.raises(InputError, match=message) as caught:
        read(written(tmp_path / "poses.txt", text))
    assert "\n" not in str(caught.value)
