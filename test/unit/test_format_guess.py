"""The format of a trajectory file is recognised, and said."""

import os

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, wandering_poses

from hand_eye_calib.cli.main import main
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.format_guess import guess_format
from hand_eye_calib.io.trajectory_files import write_trajectory

NS = "1403637132888318976"
EUROC_HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)
POSE = ["0.1", "0.2", "0.3", "0.0", "0.0", "0.0", "1.0"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (" ".join(["1.5", *POSE]), "tum"),
        ("# timestamp tx ty tz qx qy qz qw\n" + " ".join(["1.5", *POSE]), "tum"),
        ("1 0 0 0 0 1 0 0 0 0 1 0", "kitti"),
        (",".join([NS, *POSE]), "euroc"),
        ("# by hand\n" + ",".join([NS, *POSE, "1", "2"]), "euroc"),
        (EUROC_HEADER + "\n" + ",".join([NS, *POSE]), "csv"),
        ("t,x,y,z,qw,qx,qy,qz\n" + ",".join(["1.5", *POSE]), "csv"),
        ("t;x;y;z;qw;qx;qy;qz\n" + ";".join(["1.5", *POSE]), "csv"),
        ("t x y z qw qx qy qz\n" + " ".join(["1.5", *POSE]), "csv"),
        (",".join(["1.5", *POSE]), "csv"),
        ("", "tum"),
        ("hello", "tum"),
    ],
)
def test_the_format_is_recognised(tmp_path, text, expected):
    path = tmp_path / "poses"
    path.write_text(text + "\n")
    assert guess_format(path) == expected


def test_what_is_no_file_is_left_to_the_reader(tmp_path):
    assert guess_format(tmp_path / "absent") == "tum"
    assert guess_format(tmp_path) == "tum"
    os.mkfifo(tmp_path / "fifo")
    assert guess_format(tmp_path / "fifo") == "tum"
    (tmp_path / "bytes").write_bytes(bytes(range(256)) * 1000)
    assert guess_format(tmp_path / "bytes") in ("tum", "csv")


@pytest.fixture
def streams():
    poses = wandering_poses(100)
    return as_trajectory(poses), as_trajectory(disturbed(child_of(poses), 1, 0.002, 0.001))


def write_csv(path, trajectory):
    rows = np.c_[trajectory.poses[:, :3, 3], np.roll(se3.to_quat_xyzw(trajectory.poses), 1, axis=1)]
    lines = [
        ",".join([str(stamp), *map(repr, row)])
        for stamp, row in zip(trajectory.stamps_ns.tolist(), rows.tolist(), strict=True)
    ]
    path.write_text("t,x,y,z,qw,qx,qy,qz\n" + "\n".join(lines) + "\n")


def test_files_of_two_formats_need_no_options(tmp_path, streams, capsys):
    parent, child = tmp_path / "parent.txt", tmp_path / "child.csv"
    write_trajectory(parent, streams[0])
    write_csv(child, streams[1])
    command = ["calibrate", str(parent), str(child), "--json", "--reference", "B5"]
    assert main(command) == 0
    guessed = capsys.readouterr()
    assert guessed.err == (
        f"hand_eye_calib: note: {child} looks like format csv; "
        "to change that, give --child-format\n"
    )
    assert main([*command, "--child-format", "csv"]) == 0
    given = capsys.readouterr()
    assert given.err == ""
    assert given.out == guessed.out
