"""Trajectory files in all formats: exact stamps and their units, columns, stamps out of order, and
errors that name the line.
"""

import json

import numpy as np
import pytest
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    disturbed,
    wandering_poses,
)
from numpy.testing import assert_allclose, assert_array_equal

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.trajectory_files.dates import seconds
from hand_eye_calib.formats.trajectory_files.writing import write_trajectory
from hand_eye_calib.offline.cli.main import main

POSE = "1 2 3 0 0 0 1"
START_NS = 1_700_000_000_123_456_789
TRAJECTORY = as_trajectory(wandering_poses(30), start_ns=START_NS)
POSITIONS = TRAJECTORY.poses[:, :3, 3].tolist()
QUATS_XYZW = se3.to_quat_xyzw(TRAJECTORY.poses).tolist()
NO_QUATERNION = (
    "no column for qx, .* or rotvec_x,rotvec_y,rotvec_z for rotations"
)
XYZW = "t,x,y,z,qx,qy,qz,qw"
WXYZ = "t,x,y,z,qw,qx,qy,qz"


@pytest.fixture
def file(tmp_path):
    """Writes lines into a file and returns its path."""

    def write(lines, name="trajectory.csv"):
        path = tmp_path / name
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write


def rows(stamps, order="xyzw", separator=","):
    """Lines of stamp, position, quaternion."""
    quats = [
        [quat["xyzw".index(axis)] for axis in order] for quat in QUATS_XYZW
    ]
    return [
        separator.join([str(stamp), *map(repr, position + quat)])
        for stamp, position, quat in zip(stamps, POSITIONS, quats, strict=True)
    ]


def assert_is_the_trajectory(trajectory, stamps_ns=TRAJECTORY.stamps_ns):
    assert_array_equal(trajectory.stamps_ns, stamps_ns)
    assert_allclose(trajectory.poses, TRAJECTORY.poses, atol=1e-12)


# ---- tum, and what holds for all


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1317375625.661736", 1317375625661736000),
        (
            "1317375625.6617361234",
            1317375625661736123,
        ),  # a tenth digit is rounded
        (".5", 500_000_000),
        ("-0.000000001", -1),
    ],
)
def test_stamps_are_exactly_the_decimal_text(file, text, stamp_ns):
    assert hec.read_trajectory(file([f"{text} {POSE}"])).stamps_ns.tolist() == [
        stamp_ns
    ]


def test_comments_empty_lines_tabs_and_a_byte_order_mark_are_skipped(file):
    path = file(
        [
            "\ufeff# timestamp tx ty tz",
            "",
            f"  0\t{POSE}\r",
            "   ",
            "#1 2",
            f"1  {POSE}",
        ]
    )
    assert hec.read_trajectory(path).stamps_ns.tolist() == [0, 1_000_000_000]
    path.write_bytes(path.read_bytes().replace(b"\r\n", b"\r"))
    assert hec.read_trajectory(path).stamps_ns.tolist() == [0, 1_000_000_000]


def test_what_is_written_reads_back_to_the_last_bit_of_stamp_and_translation(
    tmp_path,
):
    random = np.random.default_rng(5)
    stamps_ns = np.sort(random.choice(2**60, 200, replace=False)) - 2**59
    written = Trajectory(stamps_ns, se3.exp(random.normal(size=(200, 6)) * 3))
    write_trajectory(tmp_path / "t.txt", written)
    read = hec.read_trajectory(tmp_path / "t.txt")
    assert_array_equal(read.stamps_ns, written.stamps_ns)
    assert_array_equal(read.poses[:, :3, 3], written.poses[:, :3, 3])
    assert_allclose(read.poses, written.poses, rtol=0, atol=2e-15)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "the file contains no poses"),
        (["0 1 2 3 0 0 0 1 9"], "line 1: expected 8 numbers, .* found 9"),
        (
            [f"0 {POSE}", "", "1 1 2 3"],
            "line 3, the last line, is cut: 4 of 8 numbers",
        ),
        (["0 1 2 x 0 0 0 1"], "line 1: expected 8 numbers, .* 'x'"),
        ([f"now {POSE}"], "line 1: .* found 'now' for the timestamp"),
        (
            [f"13173756256617361230 {POSE}"],
            "line 1: .* 1.31738e.19 is too large for ns; set its",
        ),
        (
            [f"{t} {POSE}" for t in (0, 33, 66)],
            "is unclear; read as s, the poses are 33 s apart",
        ),
        (
            ["0 nan 2 3 0 0 0 1"],
            "the file contains no poses: all 1 rows are empty, zero or not finite, the f",
        ),
        (
            ["# x", f"0 {POSE}", "1 1 2 3 0 0 0 1.1"],
            "line 3: found a quaternion of length 1.1, ex",
        ),
        (
            [f"5 {POSE}", "#", f"5.0 {POSE}"],
            "line 3: timestamps must increase, found 5.0+ after",
        ),
    ],
)
def test_an_unusable_line_is_named(file, lines, message):
    path = file(lines)
    with pytest.raises(InputError, match=message) as caught:
        hec.read_trajectory(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read_or_written(tmp_path):
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe\x00")
    for name, message in (
        ("absent.txt", r"absent\.txt: No such file"),
        ("image.png", r"image\.png: not a text file"),
    ):
        with pytest.raises(InputError, match=message):
            hec.read_trajectory(tmp_path / name)
    with pytest.raises(
        ConfigError, match="is a folder: name the topic of the bag"
    ):
        hec.read_trajectory(tmp_path)
    with pytest.raises(InputError, match="cannot write .*absent"):
        write_trajectory(tmp_path / "absent" / "t.txt", TRAJECTORY)


# ---- the other formats


def test_kitti_has_its_stamps_in_a_file_of_their_own(file):
    lines = [
        " ".join(map(repr, pose[:3].ravel().tolist()))
        for pose in TRAJECTORY.poses
    ]
    poses = file(lines, "poses.txt")
    times = file(
        [seconds(stamp) for stamp in TRAJECTORY.stamps_ns], "times.txt"
    )
    assert_is_the_trajectory(hec.read_trajectory(poses, "kitti", times=times))
    message = r"poses\.txt: the poses have no stamps; name their column t, set `times`, or pair"
    with pytest.raises(InputError, match=message):
        hec.read_trajectory(poses, "kitti")
    one_stamp = file(["0.0"], "one.txt")
    short = file(["0.0", "0.1"], "short.txt")
    for path, other_times, message in (
        (poses, short, r"30 poses, but .*short\.txt has 2 stamps"),
        (
            poses,
            file(["x"], "odd.txt"),
            r"odd\.txt, line 1: .* found 'x' for the timestamp",
        ),
        (
            file([" ".join(["2"] * 12)], "s.txt"),
            one_stamp,
            "s.txt, line 1: the 3x3 part is not a rot",
        ),
        (
            file(["1 2"], "pair.txt"),
            one_stamp,
            r"line 1: expected 12 numbers.* found 2",
        ),
    ):
        with pytest.raises(InputError, match=message):
            hec.read_trajectory(path, "kitti", times=other_times)


def test_exports_of_messages_have_stamps_in_two_columns_and_quoted_tuples(file):
    names = ["time", ".header.stamp.secs", ".header.stamp.nsecs", ".child"]
    names += [f".pose.pose.position.{axis}" for axis in "xyz"]
    names += [
        *(f".pose.pose.orientation.{axis}" for axis in "xyzw"),
        ".covariance",
    ]
    lines = []
    for number, row in enumerate(rows(TRAJECTORY.stamps_ns)):
        stamp, _, pose = row.partition(",")
        lines.append(
            f'7, {stamp[:-9]}, {stamp[-9:]}, "a, b", {pose}, "(0.0, {number})"'
        )
    assert_is_the_trajectory(
        hec.read_trajectory(file([", ".join(names), *lines]), "csv")
    )


def test_without_a_header_the_columns_must_be_named(file):
    path = file(rows(TRAJECTORY.stamps_ns, "wxyz", " "))
    message = (
        "so their order is unknown; name the 8 columns with `columns`, such as"
    )
    with pytest.raises(InputError, match=message):
        hec.read_trajectory(path, "csv")
    assert_is_the_trajectory(hec.read_trajectory(path, "csv", columns=WXYZ))
    with pytest.raises(
        InputError, match=r"line 1: expected 9 columns: .*; found 8"
    ):
        hec.read_trajectory(path, "csv", columns=f"{WXYZ},extra")
    with pytest.raises(
        InputError, match="line 1: expected 8 numbers or more, timestamp, px"
    ):
        hec.read_trajectory(file(["1,2,3"]), "euroc")


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            "t,x,y,z,roll,pitch,a,b",
            "no column for qx, qy, qz, qw among t, x, .*, b; name all col",
        ),
        ("t,x,y,z,rx [deg],ry [deg],rz [deg],e", NO_QUATERNION),
        (
            "t,ax,ay,az,gx,gy,gz,temperature",
            "gz, temperature .accelerations contain no pose.; na",
        ),
        ("t,north,east,down,qx,qy,qz,qw", "no column for x, y, z among"),
        (
            f"t,time,{XYZW[2:]}",
            "line 1: names 9 columns, but the rows have 8 cells; write one",
        ),
        (
            "t,time,x,y,z,qx,qy,qz",
            "columns t, time could all be t; name them|no column for qw",
        ),
    ],
)
def test_columns_that_are_missing_or_not_clear(file, header, message):
    with pytest.raises(InputError, match=message):
        hec.read_trajectory(file([header, *rows(TRAJECTORY.stamps_ns)]), "csv")


@pytest.mark.parametrize(
    ("unit", "ns"), [("s", 10**9), ("ms", 10**6), ("us", 10**3), ("ns", 1)]
)
def test_units_of_stamps_are_recognised_named_or_taken_from_the_header(
    file, unit, ns
):
    stamps_ns = START_NS // 10**9 * 10**9 + 100_000_000 * np.arange(30)
    relative_ns = stamps_ns - stamps_ns[0]

    def in_unit(values_ns):
        return [
            f"{value_ns // ns}" if ns < 10**9 else f"{value_ns / ns:.1f}"
            for value_ns in values_ns
        ]

    absolute = file(rows(in_unit(stamps_ns.tolist()), separator=" "))
    assert_is_the_trajectory(hec.read_trajectory(absolute), stamps_ns)
    relative = in_unit(relative_ns.tolist())
    path = file(rows(relative, separator=" "), "relative.txt")
    assert_is_the_trajectory(
        hec.read_trajectory(path, stamp_unit=unit), relative_ns
    )
    for name in (f"time [{unit}]", f"t_{unit}", f"timestamp ({unit})"):
        named = file([f"{name},{XYZW[2:]}", *rows(relative)])
        assert_is_the_trajectory(hec.read_trajectory(named, "csv"), relative_ns)
    message = (
        r"unclear; read as \w+, the poses are .* s apart; set `stamp_unit`"
    )
    if unit != "s":
        with pytest.raises(InputError, match=message):
            hec.read_trajectory(path)


def test_stamps_out_of_order_are_refused_or_repaired_with_a_warning(file):
    order = [*range(10), 9, 12, 11, 10, *range(13, 30), 3]
    lines = rows(TRAJECTORY.stamps_ns)
    path = file([XYZW, *(lines[index] for index in order)])
    message = r"line 12: timestamps must increase, .*; 4 such lines; sort .* repair=True"
    with pytest.raises(InputError, match=message):
        hec.read_trajectory(path, "csv")
    message = "decrease at 3 of 32 poses; the poses were sorted; dropped 2 with a repeated stamp"
    with pytest.warns(UserWarning, match=message):
        assert_is_the_trajectory(hec.read_trajectory(path, "csv", repair=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"stamp_unit": "minutes"},
            "unknown unit of stamps 'minutes'; known are s, ms, us",
        ),
        ({"format": "bvh"}, "unknown trajectory format 'bvh'; known are tum"),
        (
            {"format": "kitti", "columns": "t"},
            "columns can be set for format csv only",
        ),
        (
            {"format": "csv", "times": "t"},
            "a file of times belongs to format kitti only",
        ),
    ],
)
def test_options_that_do_not_go_with_the_format(file, options, message):
    path = file(rows(TRAJECTORY.stamps_ns))
    with pytest.raises(ConfigError, match=message):
        hec.read_trajectory(path, **options)


# ---- on the command line, and files of others


def test_calibrate_reads_each_file_in_its_own_format(tmp_path, file, capsys):
    child = as_trajectory(
        disturbed(child_of(TRAJECTORY.poses), 1, 5e-5, 5e-5), start_ns=START_NS
    )
    write_trajectory(tmp_path / "child.tum", child)
    lines = rows(TRAJECTORY.stamps_ns, "wxyz")
    files = [str(file([*lines, lines[3]])), str(tmp_path / "child.tum")]
    command = [
        "calibrate",
        *files,
        "--json",
        "--reference",
        "B5",
        "--parent-columns",
        WXYZ,
    ]
    for more in ([], ["--parent-format", "csv"]):
        assert main([*command, *more]) in (0, 3)
        out, err = capsys.readouterr()
        assert (
            "decrease at 1 of 31 poses; the poses were sorted; dropped 1 with a repeated stamp"
            in err
        )
        document = json.loads(out)
        assert_allclose(
            document["T_parent_child"]["matrix"], T_PARENT_CHILD, atol=1e-3
        )
    assert main([*command, "--format", "tum"]) == 2
    assert (
        "columns can be set for format csv only; the format is tum"
        in capsys.readouterr().err
    )
