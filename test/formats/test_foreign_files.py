"""Trajectories in the formats of other programs: each reads as the table of the same poses, and
what cannot be read is told in one sentence.
"""

import json
import re
import tracemalloc
from datetime import UTC, datetime
from functools import reduce
from operator import xor

import numpy as np
import pytest
from motions import (
    as_trajectory,
    geodetic,
    read_trajectory_file,
    wandering_poses,
)
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.trajectory_files.file_options import AUTO
from hand_eye_calib.offline.cli.main import main

N = 40
TRUTH = as_trajectory(
    wandering_poses(N), rate_hz=10.0, start_ns=1_700_000_000_000_000_000
)
SECONDS = TRUTH.stamps_ns / 1e9
P = TRUTH.poses[:, :3, 3]
Q = se3.to_quat_xyzw(TRUTH.poses)
VECTORS = se3.rotation_log(TRUTH.poses[:, :3, :3])
LAT, LON, HEIGHT = geodetic(P - P[0], (48.1, 11.5, 550.0))
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def dates(form):
    return [
        datetime.fromtimestamp(seconds, UTC).strftime(form)
        for seconds in SECONDS
    ]


def joined(rows, separator=" "):
    return "".join(separator.join(map(str, row)) + "\n" for row in rows)


def of_nmea(damaged=3):
    """After a logger's own stamps, one sentence with a wrong checksum."""
    lat, lon = (
        [100 * (angle // 1) + angle % 1 * 60 for angle in deg]
        for deg in (LAT, LON)
    )
    texts = [
        f"GPRMC,{clock[:-4]},A,,,,,,,{day},,|GNGGA,{clock[:-4]},{lat[k]:014.9f},N,"
        f"{lon[k]:015.9f},E,4,12,0.8,{HEIGHT[k] - 45.0:.6f},M,45.0,M,,"
        for k, (clock, day) in enumerate(
            zip(dates("%H%M%S.%f"), dates("%d%m%y"), strict=True)
        )
    ]
    texts.insert(damaged, texts[damaged].replace(".", ".9"))
    lines = [sentence for text in texts for sentence in text.split("|")]
    checks = [reduce(xor, sentence.encode()) for sentence in lines]
    checks[2 * damaged + 1] ^= 1
    rows = zip(lines, checks, strict=True)
    return "".join(
        f"12:00:00 ${sentence}*{check:02X}\r\n" for sentence, check in rows
    )


def of_gpx():
    points = "".join(
        f'<trkpt lat="{lat:.12f}" lon="{lon:.12f}"><ele>{h:.6f}</ele><time>{t}Z</time></trkpt>\n'
        for t, lat, lon, h in zip(
            dates("%Y-%m-%dT%H:%M:%S.%f"), LAT, LON, HEIGHT, strict=True
        )
    )
    space = 'xmlns="http://www.topografix.com/GPX/1/1"'
    track = f"<trk><trkseg>{points}</trkseg></trk>"
    return f'<?xml version="1.0"?>\n<gpx version="1.1" {space}>{track}</gpx>'


def of_rtklib(weeks=False):
    times = dates("%Y/%m/%d %H:%M:%S.%f")
    if weeks:
        since = SECONDS - 315_964_800
        times = [
            f"{int(second // 604_800)} {second % 604_800:.3f}"
            for second in since
        ]
    head = "% program   : RTKPOST\n%  GPST   latitude(deg) longitude(deg)  height(m)   Q  ns\n"
    degrees = ([f"{value:.12f}" for value in values] for values in (LAT, LON))
    rows = zip(times, *degrees, HEIGHT, [1] * N, [9] * N, strict=True)
    return head + joined(rows)


def of_colmap():
    rows = se3.to_rows(se3.inverse(TRUTH.poses))[::-1, [6, 3, 4, 5, 0, 1, 2]]
    names = [
        f"cam 0/{stamp}.png\n1.5 2.5 -1 3.5 4.5 7"
        for stamp in TRUTH.stamps_ns[::-1]
    ]
    head = (
        "# Image list with two lines of data per image:\n"
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        "# POINTS2D[] as (X, Y, POINT3D_ID)\n"
    )
    return of_rows(head, range(1, N + 1), rows, [1] * N, names, separator=" ")


def of_nerfstudio(names=TRUTH.stamps_ns, poses=TRUTH.poses):
    frames = [
        {
            "file_path": f"images/{name}.png",
            "transform_matrix": (pose @ OPENGL).tolist(),
        }
        for name, pose in zip(names, poses, strict=True)
    ]
    return json.dumps({"camera_model": "OPENCV", "frames": frames})


def of_motive():
    head = (
        "Format Version,1.23,Take Name,a,Export Frame Rate,100.0,Rotation Type,Quaternion,"
        f"Length Units,Millimeters\n\n,Type{',Rigid Body' * 8},Marker\n,Name{',drone' * 8},"
        f"drone:1\n,{',1' * 8},2\n,{',Rotation' * 4}{',Position' * 3},Mean Marker Error,Position\n"
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X\n"
    )
    rows = of_rows(head, range(N), SECONDS, Q, P * 1e3, [0.1] * N, [1] * N)
    return f"{rows}{N},{SECONDS[-1] + 1}{',' * 9}\n"


def of_vicon(turn="RX,RY,RZ", units="rad,rad,rad", bodies=("drone:drone",)):
    """The second body has twice the positions of the first."""
    names = ("," * (turn.count(",") + 4)).join(bodies)
    n = len(bodies)
    head = f"Objects\n10\n,,{names}\nFrame,Sub Frame{f',{turn},TX,TY,TZ' * n}\n"
    poses = [
        component
        for k in range(n)
        for component in (Q if "RW" in turn else VECTORS, P * 1e3 * (k + 1))
    ]
    return of_rows(
        f"{head},{f',{units},mm,mm,mm' * n}\n", range(N), [0] * N, *poses
    )


def of_novatel(short=False):
    """INSPVAX with a long header, or INSPVA with a short one, among other logs."""
    head = "%INSPVASA,{0},{1:.3f};{0},{1:.3f},"
    body = "{:.12f},{:.12f},{:.9f},1,2,3,"
    log = ""
    if not short:
        head = "#INSPVAXA,COM1,0,7.5,FINESTEERING,{0},{1:.3f},0,4e77,4;INS_SOLUTION_GOOD,INS_PSRSP,"
        body = "{:.12f},{:.12f},{:.9f},45.0,1,2,3,"
    angles = Rotation.from_quat(Q).as_euler("ZYX", degrees=True) * [
        -1,
        -1,
        1,
    ] + [
        90,
        0,
        0,
    ]
    for second, lat, lon, height, turn in zip(
        SECONDS, LAT, LON, HEIGHT, angles, strict=True
    ):
        log += head.format(*divmod(second - 315_964_800, 604_800)).replace(
            ".0,", ",", 1
        )
        log += body.format(lat, lon, height - (0 if short else 45.0))
        log += (
            "{2:.9f},{1:.9f},{0:.9f},3*e877c178\n#TIMEA,COM1;VALID*1\n".format(
                *turn
            )
        )
    return log


def of_lio_sam():
    names = "x y z intensity roll pitch yaw time"
    head = f"# .PCD v0.7\nFIELDS {names}\nSIZE 4 4 4 4 4 4 4 8\nTYPE{' F' * 8}\nPOINTS {N}\n"
    angles = Rotation.from_quat(Q).as_euler("xyz")
    zeros = np.zeros(N)
    return of_rows(
        f"{head}DATA ascii\n", P, zeros, angles, SECONDS, separator=" "
    )


def of_rows(header, *values, separator=","):
    """Numbers below a header, each value (N, ...) one or several columns."""
    columns = [np.reshape(array, (N, -1)).tolist() for array in values]
    rows = (
        [cell for cells in row for cell in cells]
        for row in zip(*columns, strict=True)
    )
    return header + joined(rows, separator)


def of_echo(frames="odom,base"):
    """As ros2 topic echo --csv writes TransformStamped, or PoseStamped."""
    stamps = (
        f"{stamp_ns // 10**9},{stamp_ns % 10**9}"
        for stamp_ns in TRUTH.stamps_ns.tolist()
    )
    return joined(
        (
            [stamp, frames, *p, *q]
            for stamp, p, q in zip(stamps, P, Q, strict=True)
        ),
        ",",
    )


def of_nuscenes():
    values = zip(
        (STAMPS // 1000).tolist(), WXYZ.tolist(), P.tolist(), strict=True
    )
    keys = ("timestamp", "rotation", "translation")
    return json.dumps(
        [dict(zip(keys, row, strict=True)) for row in values][::-1], indent=1
    )


STAMPS = TRUTH.stamps_ns
WXYZ = Q[:, [3, 0, 1, 2]]
POSE = "tx,ty,tz,qx,qy,qz,qw\n"
DATES = [f"{date}Z" for date in dates("%Y-%m-%dT%H:%M:%S.%f")]
MATRICES = TRUTH.poses.reshape(N, 16)
WITH_UNITS = "# by hand\n# time [{0}],x [{1}],y [{1}],z [{1}],q_w,q_x,q_y,q_z\n"
EUROC = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y,p_RS_R_z,q_RS_w [],q_RS_x,q_RS_y,q_RS_z\n"
ROT = "Stamp [ns],Pos_X [m],Pos_Y,Pos_Z,rot_w,rot_x,rot_y,rot_z\n"
OKVIS = "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_WS_W_x\n"
ULOG2CSV = "timestamp,position[0],position[1],position[2],q[0],q[1],q[2],q[3]\n"
ARM = "t,x_ft,y_ft,z_ft,rotvec_x,rotvec_y,rotvec_z\n"
ARIA = "graph_uid,tracking_timestamp_us,utc_timestamp_ns," + ",".join(
    f"{name}_world_device" for name in POSE.strip().split(",")
)
HEADER = f"__time,/odom/header/stamp,{POSE}".replace(
    ",t", ",/odom/pose/pose/position/"
)
TCP = " ".join(["timestamp", *(f"actual_TCP_pose_{k}" for k in range(6))])
UNITS = (
    "Device Time,Easting,Northing,H-Ell,qw,qx,qy,qz\n(ns),(mm),(mm),(mm),,,,\n"
)
GNSS_POSES = (
    "# frame_id (timestamp in ns), translation (t_x, t_y, "
    "t_z), rotation (q_x, q_y, q_z, q_w)"
)
FORMATS = {
    "tum": (
        of_rows(
            "# of a program of eight words or so\n",
            SECONDS,
            P,
            Q,
            separator=" ",
        ),
        "",
    ),
    "ids": (
        of_rows(
            f"id timestamp {POSE}".replace(",", " "),
            range(N),
            SECONDS,
            P,
            Q,
            separator=" ",
        ),
        "",
    ),
    "comments": (of_rows(f"// of Xsens\nt,{POSE}", SECONDS, P, Q), ""),
    "seconds_and_nanoseconds": (
        of_rows(f"#sec,nsec,{POSE}", *divmod(STAMPS, 10**9), P, Q),
        "",
    ),
    "units_below": (of_rows(UNITS, STAMPS, P * 1e3, WXYZ), ""),
    "order_in_words": (
        of_rows("# as: t x y z qw qx qy qz\n", SECONDS, P, WXYZ, separator=" "),
        "",
    ),
    "order_in_a_comment": (
        of_rows(f"{GNSS_POSES}\n", STAMPS, P, Q),
        "is read as format csv",
    ),
    "lio_sam": (of_lio_sam(), "read in rad"),
    "iso": (of_rows(f"time,{POSE}", DATES, P, Q), ""),
    "decimal_comma": (
        of_rows(f"t,{POSE}", SECONDS, P, Q).replace(",", ";").replace(".", ","),
        "",
    ),
    "csv_mm_ms": (
        of_rows(WITH_UNITS.format("ms", "mm"), STAMPS // 10**6, P * 1e3, WXYZ),
        "",
    ),
    "csv_cm_us": (
        of_rows(WITH_UNITS.format("us", "cm"), STAMPS // 10**3, P * 1e2, WXYZ),
        "",
    ),
    "rotation_vectors_and_feet": (
        of_rows(ARM, SECONDS, P / 0.3048, VECTORS),
        "read in rad",
    ),
    "universal_robots": (
        of_rows(f"{TCP}\n", SECONDS, P, VECTORS, separator=" "),
        "read in rad",
    ),
    "aria": (
        of_rows(f"{ARIA}\n", ["ea72"] * N, STAMPS // 1000, STAMPS + 9, P, Q),
        "",
    ),
    "stamp_of_the_header": (of_rows(HEADER, SECONDS + 0.1, SECONDS, P, Q), ""),
    "ulog2csv": (of_rows(ULOG2CSV, STAMPS // 1000, P, WXYZ), ""),
    "okvis": (of_rows(OKVIS, STAMPS, P, Q, P[:, :1], separator=", "), ""),
    "euroc_names": (of_rows(EUROC, STAMPS, P, WXYZ), "is read as format csv"),
    "rot": (of_rows(ROT, STAMPS, P, WXYZ), ""),
    "euroc_scalar_last": (
        of_rows("", STAMPS, P, Q),
        "the scalar last, t x y z qx qy qz qw",
    ),
    "euroc": (
        of_rows("", STAMPS, P, WXYZ, P, separator=", "),
        "is read as format euroc",
    ),
    "kitti": (of_rows("", MATRICES[:, :12], separator=" "), "stamps read from"),
    "stamp_and_rows": (
        of_rows("", STAMPS, MATRICES[:, :12]),
        "is read as format csv",
    ),
    "stamp_and_matrix": (of_rows("", SECONDS, MATRICES, separator=" "), ""),
    "echo": (of_echo(), ""),
    "echo_of_poses": (of_echo("map"), ""),
    "nuscenes": (of_nuscenes(), ""),
    "vicon_quaternions": (
        of_vicon("RX,RY,RZ,RW", ",,,"),
        "read as quaternions",
    ),
    "colmap": (of_colmap(), ""),
    "nerfstudio": (of_nerfstudio(), "not those of OpenGL"),
    "motive": (of_motive(), "rigid body drone"),
    "vicon": (of_vicon(), "rotation vectors"),
    "nmea": (of_nmea(), "1 sentences with a wrong checksum left out"),
    "gpx": (of_gpx(), "above the sea"),
    "rtklib": (of_rtklib(), "18 s ahead of UTC"),
    "rtklib_weeks": (of_rtklib(weeks=True), "18 s ahead of UTC"),
    "emlid": (of_rtklib().partition("ns\n")[2], "18 s ahead of UTC"),
}
MOUNT = se3.exp(np.array([0.3, -0.2, 0.1, 0.5, -1.0, 0.7]))


def calibrated(parent, child):
    return hec.calibrate(
        parent, child, method="dnlo", reference="B5", checks=False
    ).T_parent_child


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_and_unit_gives_the_same_poses_and_the_same_answer(
    tmp_path, name
):
    text, note = FORMATS[name]
    path = tmp_path / "anything.txt"
    path.write_bytes(text.encode())
    (tmp_path / "times.txt").write_text("\n".join(map(repr, SECONDS.tolist())))
    file = read_trajectory_file(path, AUTO)
    trajectory = file.trajectory
    start_ns = TRUTH.stamps_ns[0] if name.startswith("vicon") else 0
    assert_allclose(
        trajectory.stamps_ns, TRUTH.stamps_ns - start_ns, atol=2000, rtol=0
    )
    expected = TRUTH.poses.copy()
    if trajectory.measures == "positions":
        expected[:, :3, :3] = np.eye(3)
        expected[:, :3, 3] = P - P[0]
    assert_allclose(trajectory.poses, expected, atol=2e-6)
    assert note in " ".join(file.guesses)
    assert trajectory.measures == (
        "positions" if name in [*FORMATS][-5:] else "poses"
    )
    if trajectory.measures == "poses":
        child = Trajectory(trajectory.stamps_ns, TRUTH.poses @ MOUNT)
        assert_allclose(calibrated(trajectory, child), MOUNT, atol=1e-6)


def test_arrays_and_graphs(tmp_path):
    np.save(tmp_path / "a.npy", np.c_[SECONDS, P, Q])
    rows = of_rows("", ["VERTEX_SE3:QUAT"] * N, range(N), P, Q, separator=" ")
    (tmp_path / "a.g2o").write_text(f"{rows}EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1\n")
    for name in ("a.npy", "a.g2o"):
        file = read_trajectory_file(tmp_path / name, AUTO)
        assert_allclose(file.trajectory.poses, TRUTH.poses, atol=1e-12)
    assert file.trajectory.stamps_ns[1] == 1_000_000_000
    assert "numbers of its vertices are used as seconds" in file.guesses[0]


def test_poses_without_stamps_are_paired_by_row_or_by_the_names_of_images(
    tmp_path, capsys
):
    names = [f"{chr(97 + k // 26)}{chr(97 + k % 26)}" for k in range(N)]
    (tmp_path / "a.json").write_text(of_nerfstudio(names))
    (tmp_path / "b.json").write_text(
        of_nerfstudio(names[:4:-1], (TRUTH.poses @ MOUNT)[:4:-1])
    )
    for name, poses in (("a", TRUTH.poses), ("b", TRUTH.poses @ MOUNT)):
        rows = {
            "kitti": poses[:, :3].reshape(-1, 12),
            "all": poses.reshape(-1, 16),
        }
        for kind, values in (rows | {"seven": se3.to_rows(poses)}).items():
            (tmp_path / f"{name}.{kind}").write_text(joined(values))
        np.save(tmp_path / f"{name}.npy", poses)
    for kind in ("json", "kitti", "all", "seven", "npy"):
        by = "name" if kind == "json" else "row"
        command = [
            "calibrate",
            *(str(tmp_path / f"{name}.{kind}") for name in "ab"),
        ]
        assert main([*command, "--pair-by", by, "--json"]) in (0, 3)
        document = json.loads(capsys.readouterr().out)
        assert (document["parent_frame"], document["child_frame"]) == ("a", "b")
        assert_allclose(document["T_parent_child"]["matrix"], MOUNT, atol=1e-6)
        assert main(command) == 1
        assert "the poses have no stamps" in capsys.readouterr().err
    mixed = [
        "calibrate",
        str(tmp_path / "a.json"),
        str(tmp_path / "b.json"),
        "--pair-by",
        "row",
    ]
    assert main(mixed) == 1
    err = capsys.readouterr().err
    assert re.search(r"found 40 in \S+ and 35 in \S+: write a row", err)
    kitti = [
        "calibrate",
        *(str(tmp_path / f"{name}.kitti") for name in "ab"),
        "--pair-by",
        "name",
    ]
    assert main(kitti) == 1
    err = capsys.readouterr().err
    assert "no name of an image is in all files" in err
    assert re.search(
        r"names found: 0 in \S+ and 0 in \S+; pair by time or row", err
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b"\x89HDF\r\n\x1a\n" + bytes(40),
            "not a text file.* save the poses of .*HDF5",
        ),
        (b"PAR1" + bytes(40), "not a text file"),
        (b"\x93NUMPY\x01\x00" + bytes(10), "cannot read"),
        (b"<gpx><trkpt lat='1' lon='2'/></gpx>", "has no time"),
        (b"<gpx><trkpt", "no element found|not well-formed|unclosed token"),
        (b'{"type": "FeatureCollection"}', "transforms.json of nerfstudio"),
        (b"[1, 2]", "ego_pose.json of nuScenes"),
        (
            b"2023-11-14T22:13:20Z" + b" 1e999" * 15,
            "expected 8 numbers, .* found 16",
        ),
        (
            b"1e999" + b",1" * 15 + b"\n",
            "so their order is unknown; name the 16",
        ),
        (b"EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1\n", "a g2o graph without vertices"),
        (
            b"t,x,y,z,roll,pitch,yaw\n0,1,2,3,0,0,1e200\n",
            "line 2: found angle 1e.200",
        ),
        (
            b"source_timestamp,destination_timestamp,x,y,z,yaw\n1,2,0,0,0,0\n",
            "chain",
        ),
        (b'<?xml version="1.0"?>\n<kml></kml>', "export the track as GPX"),
        (b"FMT, 128, 89, FMT, BBnNZ, Type\n", "a log of ArduPilot; export"),
        (
            b"#BESTPOSA,COM1,0,9.5,FINE,1,2,0,0,0;SOL_COMPUTED,1,2*1\n",
            "neither INSPVA",
        ),
        (b"header {\n  stamp {\n", "messages as text; record"),
        (
            b"3.04           OBSERVATION DATA    RINEX VERSION / TYPE\n",
            "positions with RTKLIB",
        ),
        (b"SQLite format 3\0", "a bag must end in .db3"),
        (
            b"# Frame list\n#   FRAME_ID, RIG_ID, RIG_FROM_WORLD\n1 1 1 0 0 0 0 0\n",
            "images.txt",
        ),
        (
            b"# Cameras\n# Number\n#   CAMERA_ID, MODEL, WIDTH\n1 PINHOLE 9\n",
            "images.txt",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\n",
            "points, no trajectory; record the odom",
        ),
        (
            b"# .PCD v0.7\nFIELDS x y z\nSIZE 4\nDATA ascii\n1 2 3\n",
            "points, no trajectory",
        ),
        (
            b"header:\n  stamp:\n    sec: 1\n",
            "YAML without a trajectory; record",
        ),
        (of_echo("a,b,c").encode(), "--csv without poses"),
        (
            b"$GPRMC,123519,A,,,,,,,230394,,*6A\n",
            "expected GGA sentences with a fix",
        ),
        (
            re.sub(r"\*..", "", of_nmea()).replace("RMC", "ZDA").encode(),
            "the date in RMC",
        ),
        (
            b"%  GPST  latitude(d'\") longitude(d'\")\n1 2 3\n",
            "set out-solformat to llh, degrees",
        ),
        (
            of_motive().replace("X,Y,Z,W", "X,Y,Z,").encode(),
            "rotation type Quaternion",
        ),
        (
            b"Trajectories\n100\n,,a:b\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n",
            "not markers",
        ),
        (b'{"frames":' * 100_000, "JSON of an unsupported kind"),
        (b"Format Version,1\nTime (Seconds)\n", "Motive|list index"),
    ],
)
def test_what_cannot_be_read_is_told_in_one_sentence(
    tmp_path, content, message
):
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        read_trajectory_file(path, AUTO)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("is_short", [True, False])
def test_poses_of_an_ins_turn_with_the_heading(tmp_path, is_short):
    (tmp_path / "log").write_text(of_novatel(is_short))
    trajectory = read_trajectory_file(tmp_path / "log", AUTO).trajectory
    assert_allclose(trajectory.stamps_ns, STAMPS, atol=1_000_000)
    assert_allclose(trajectory.poses[:, :3, 3], P - P[0], atol=1e-4)
    assert_allclose(
        trajectory.poses[:, :3, :3], TRUTH.poses[:, :3, :3], atol=1e-4
    )


def test_of_several_bodies_one_is_named(tmp_path):
    (tmp_path / "vicon.csv").write_text(
        of_vicon(bodies=("drone:drone", "cart:cart"))
    )
    with pytest.raises(
        InputError, match="several segments: drone:drone, cart:cart; name one"
    ):
        read_trajectory_file(tmp_path / "vicon.csv", AUTO)
    trajectory = read_trajectory_file(
        tmp_path / "vicon.csv", AUTO, columns="cart:cart"
    ).trajectory
    assert_allclose(trajectory.poses[:, :3, 3], 2 * P, atol=1e-9)


def test_a_take_of_many_markers_needs_memory_for_its_poses_alone(tmp_path):
    """A take of OptiTrack has hundreds of columns of which seven are read."""
    lines = of_motive().splitlines()
    markers = ",".join(["0.123456"] * 300)
    path = tmp_path / "take.csv"
    path.write_text(
        "\n".join([*lines, *(f"{lines[-1]},{markers}" for _ in range(3_000))])
    )
    size = path.stat().st_size
    tracemalloc.start()
    try:
        trajectory = hec.read_trajectory(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert size > 5_000_000
    assert len(trajectory) == N
    assert peak < 6 * size
