"""KITTI, EuRoC and CSV files: columns, units of stamps, order of quaternions; and stamps out of
order.
"""

import json

import numpy as np
import pytest
from motions import T_PARENT_CHILD, as_trajectory, child_of, disturbed, wandering_poses
from published_data import data_folder

import hand_eye_calib as hec
from hand_eye_calib.cli.main import main
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.trajectory_files import FORMATS, read_trajectory_file, write_trajectory

START_NS = 1_700_000_000_123_456_789
TRAJECTORY = as_trajectory(wandering_poses(30), start_ns=START_NS)
POSITIONS, QUATS_XYZW = (
    TRAJECTORY.poses[:, :3, 3].tolist(),
    se3.to_quat_xyzw(TRAJECTORY.poses).tolist(),
)


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
    quats = [[quat["xyzw".index(axis)] for axis in order] for quat in QUATS_XYZW]
    return [
        separator.join(map(repr, [*position, *quat])).join([f"{stamp}{separator}", ""])
        for stamp, position, quat in zip(stamps, POSITIONS, quats, strict=True)
    ]


def assert_is_the_trajectory(found, stamps_ns=TRAJECTORY.stamps_ns):
    np.testing.assert_array_equal(found.stamps_ns, stamps_ns)
    np.testing.assert_allclose(found.poses, TRAJECTORY.poses, atol=1e-12)


def test_kitti_has_its_stamps_in_a_file_of_their_own(file):
    poses = file(
        [" ".join(map(repr, pose[:3].ravel().tolist())) for pose in TRAJECTORY.poses], "poses.txt"
    )
    times = file(
        [
            f"{(stamp - START_NS) // 10**9}.{(stamp - START_NS) % 10**9:09d}"
            for stamp in TRAJECTORY.stamps_ns.tolist()
        ],
        "times.txt",
    )
    assert_is_the_trajectory(
        hec.read_trajectory(poses, "kitti", times=times), TRAJECTORY.stamps_ns - START_NS
    )
    with pytest.raises(
        ConfigError,
        match=r"poses\.txt: the poses of format kitti have no stamps; name their file with `times`",
    ):
        hec.read_trajectory(poses, "kitti")
    short = file(["0.0", "0.1"], "short.txt")
    with pytest.raises(InputError, match=r"30 poses, but .*short\.txt has 2 stamps"):
        hec.read_trajectory(poses, "kitti", times=short)
    scaled = file([" ".join(["2"] * 12)], "scaled.txt")
    with pytest.raises(
        InputError, match=r"scaled\.txt, line 1: the 3x3 part is not a rotation matrix"
    ):
        hec.read_trajectory(scaled, "kitti", times=file(["0.0"], "one.txt"))
    with pytest.raises(InputError, match=r"line 1: expected 12 numbers.* found 2"):
        hec.read_trajectory(file(["1 2"], "pair.txt"), "kitti", times=times)


def test_euroc_is_nanoseconds_with_the_scalar_first(file):
    header = (
        "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
        "q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]"
    )
    lines = [f"{row}, 0.5" for row in rows(TRAJECTORY.stamps_ns, "wxyz", ", ")]
    assert_is_the_trajectory(hec.read_trajectory(file([header, *lines]), "euroc"))
    assert_is_the_trajectory(hec.read_trajectory(file([header, *lines]), "csv"))
    small = hec.read_trajectory(file([header, *rows(range(30), "wxyz")]), "euroc")
    assert small.stamps_ns.tolist() == list(range(30))  # the format's unit, whatever their size
    with pytest.raises(InputError, match="line 1: expected 8 numbers or more, timestamp, px"):
        hec.read_trajectory(file(["1,2,3"]), "euroc")


@pytest.mark.parametrize(
    ("header", "order", "separator"),
    [
        ("t,x,y,z,qx,qy,qz,qw", "xyzw", ","),
        ("timestamp; tx; ty; tz; qw; qx; qy; qz", "wxyz", ";"),
        ("# time px py pz q_w q_x q_y q_z", "wxyz", " "),
        (
            "time,.pose.pose.position.x,.pose.pose.position.y,.pose.pose.position.z,"
            ".pose.pose.orientation.x,.pose.pose.orientation.y,.pose.pose.orientation.z,"
            ".pose.pose.orientation.w",
            "xyzw",
            ",",
        ),
        ("Stamp [ns],Pos_X [m],Pos_Y [m],Pos_Z [m],rot_w,rot_x,rot_y,rot_z", "wxyz", ","),
    ],
)
def test_csv_finds_its_columns_by_their_names(file, header, order, separator):
    path = file([header, *rows(TRAJECTORY.stamps_ns, order, separator)])
    assert_is_the_trajectory(hec.read_trajectory(path, "csv"))


def test_exports_of_messages_have_stamps_in_two_columns_and_quoted_tuples(file):
    header = (
        "time, .header.stamp.secs, .header.stamp.nsecs, .child, .p.position.x, .p.position.y, "
        ".p.position.z, .p.orientation.x, .p.orientation.y, .p.orientation.z, "
        ".p.orientation.w, .covariance"
    )
    lines = [
        ", ".join(
            [
                "7",
                str(stamp // 10**9),
                str(stamp % 10**9),
                '"a, b"',
                *map(repr, position + quat),
                '"(0.0, 1.0)"',
            ]
        )
        for stamp, position, quat in zip(
            TRAJECTORY.stamps_ns.tolist(), POSITIONS, QUATS_XYZW, strict=True
        )
    ]
    assert_is_the_trajectory(hec.read_trajectory(file([header, *lines]), "csv"))


def test_without_a_header_the_columns_must_be_named(file):
    path = file(rows(TRAJECTORY.stamps_ns, "wxyz", " "))
    with pytest.raises(
        InputError,
        match="so the order of the quaternion is unknown; name them with `columns`, .* there are 8",
    ):
        hec.read_trajectory(path, "csv")
    assert_is_the_trajectory(hec.read_trajectory(path, "csv", columns="t,x,y,z,qw,qx,qy,qz"))
    with pytest.raises(InputError, match=r"line 1: expected 9 columns: .*; found 8"):
        hec.read_trajectory(path, "csv", columns="t,x,y,z,qw,qx,qy,qz,extra")


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            "t,x,y,z,roll,pitch,a,b",
            "no column for qx, qy, qz, qw among t, x, y, z, roll, pitch, a, b; name all columns",
        ),
        ("t,x,y,a,qx,qy,qz,qw", "no column for z among t, x, y, a"),
        ("t,x,y,z,q0,q1,q2,q3", "no column for qx, qy, qz, qw among"),
        ("t,time,x,y,z,qx,qy,qz,qw", "columns t, time could all be t; name them with `columns`"),
    ],
)
def test_columns_that_are_missing_or_not_clear(file, header, message):
    with pytest.raises(InputError, match=message):
        hec.read_trajectory(file([header, *rows(TRAJECTORY.stamps_ns)]), "csv")


@pytest.mark.parametrize(("unit", "ns"), [("s", 10**9), ("ms", 10**6), ("us", 10**3), ("ns", 1)])
def test_units_of_stamps_are_recognised_named_or_taken_from_the_header(file, unit, ns):
    stamps_ns = START_NS // 10**9 * 10**9 + 100_000_000 * np.arange(30)
    stamps = [
        f"{stamp // ns}" if ns < 10**9 else f"{stamp / ns:.1f}" for stamp in stamps_ns.tolist()
    ]
    assert_is_the_trajectory(
        hec.read_trajectory(file(rows(stamps, separator=" ")), "tum"), stamps_ns
    )
    relative_ns = stamps_ns - stamps_ns[0]
    relative = [
        f"{stamp // ns}" if ns < 10**9 else f"{stamp / ns:.1f}" for stamp in relative_ns.tolist()
    ]
    path = file(rows(relative, separator=" "))
    assert_is_the_trajectory(hec.read_trajectory(path, "tum", stamp_unit=unit), relative_ns)
    for name in (f"time [{unit}]", f"t_{unit}", f"timestamp ({unit})"):
        path = file([f"{name},x,y,z,qx,qy,qz,qw", *rows(relative)])
        assert_is_the_trajectory(hec.read_trajectory(path, "csv"), relative_ns)
    if unit != "s":
        with pytest.raises(
            InputError,
            match=r"unit of the timestamps is unclear; read as \w+, the poses are .* s apart; "
            r"name it with `stamp_unit`",
        ):
            hec.read_trajectory(file(rows(relative, separator=" ")), "tum")


def test_stamps_out_of_order_are_refused_or_repaired_with_a_warning(file):
    order = [*range(10), 9, 12, 11, 10, *range(13, 30), 3]
    lines = rows(TRAJECTORY.stamps_ns)
    path = file(["t,x,y,z,qx,qy,qz,qw", *(lines[index] for index in order)])
    with pytest.raises(
        InputError,
        match=r"line 12: timestamps must increase, .*; 4 such lines; sort .* `repair`",
    ):
        hec.read_trajectory(path, "csv")
    with pytest.warns(
        UserWarning,
        match="stamps went back at 3 of 32 poses, which were sorted; dropped 2 whose stamp was "
        "there already",
    ):
        assert_is_the_trajectory(hec.read_trajectory(path, "csv", repair=True))


def test_options_that_do_not_go_with_the_format(file):
    path = file(rows(TRAJECTORY.stamps_ns))
    for file_format in FORMATS:
        if file_format != "csv":
            with pytest.raises(
                ConfigError,
                match=f"columns are named for format csv only; the format is {file_format}",
            ):
                hec.read_trajectory(path, file_format, columns="t")
        if file_format != "kitti":
            with pytest.raises(
                ConfigError,
                match=f"a file of times belongs to format kitti only; the format is {file_format}",
            ):
                hec.read_trajectory(path, file_format, times=path)
    with pytest.raises(
        ConfigError, match="unknown unit of stamps 'minutes'; known are s, ms, us, ns"
    ):
        hec.read_trajectory(path, stamp_unit="minutes")
    with pytest.raises(ConfigError, match="tum, mcap, sqlite3, rosbag1; got .kitti."):
        write_trajectory(path, TRAJECTORY, "kitti")


# ---- on the command line


def test_calibrate_reads_each_file_in_its_own_format(tmp_path, file, capsys):
    child = as_trajectory(disturbed(child_of(TRAJECTORY.poses), 1, 1e-5, 5e-5), start_ns=START_NS)
    write_trajectory(tmp_path / "child.tum", child)
    parent = file([*rows(TRAJECTORY.stamps_ns, "wxyz"), rows(TRAJECTORY.stamps_ns, "wxyz")[3]])
    command = [
        "calibrate",
        str(parent),
        str(tmp_path / "child.tum"),
        "--json",
        "--reference",
        "B5",
        "--parent-frame",
        "a",
        "--child-frame",
        "b",
    ]
    code = main(
        [
            *command,
            "--parent-format",
            "csv",
            "--columns",
            "t,x,y,z,qw,qx,qy,qz",
            "--out",
            str(tmp_path / "out"),
        ]
    )
    out, err = capsys.readouterr()
    assert code == 0
    assert (
        "stamps went back at 1 of 31 poses, which were sorted; dropped 1 whose stamp was "
        "there already" in err
    )
    document = json.loads(out)
    np.testing.assert_allclose(document["T_parent_child"]["matrix"], T_PARENT_CHILD, atol=1e-3)
    assert [entry["file"] for entry in document["inputs"]["files"]] == [
        str(parent),
        str(tmp_path / "child.tum"),
    ]
    columns = ["--columns", "t,x,y,z,qw,qx,qy,qz"]
    assert main([*command, *columns]) == 0
    assert json.loads(capsys.readouterr().out)["T_parent_child"] == document["T_parent_child"]
    assert main([*command, "--format", "tum", *columns]) == 2
    assert "columns are named for format csv only; the format is tum" in capsys.readouterr().err


# ---- files of others


def test_published_files_of_other_programs():
    folder = data_folder()
    counts = {}
    for pattern, columns in (
        ("asl_*/*.csv", "t,x,y,z,qx,qy,qz,qw"),
        ("zxl19/bag*/[ILV]*_FCPE.mat", "t,x,y,z,qw,qx,qy,qz"),
    ):
        for path in sorted(folder.glob(pattern)):
            trajectory, notes, _ = read_trajectory_file(path, "csv", columns=columns, repair=True)
            counts[path.name] = len(trajectory)
            assert 30 < trajectory.duration_s < 100, path
            assert all(
                path.name in note and ("were sorted" in note or "dropped" in note) for note in notes
            )
    assert len(counts) >= 10
    export = folder / "zxl19" / "raw_bag1" / "bag1-aft_mapped_to_init.csv"
    trajectory = read_trajectory_file(export, "csv").trajectory
    assert (len(trajectory), trajectory.stamps_ns[0]) == (
        572,
        1636512749922900677,
    )  # of the header, not of the arrival
