"""Trajectory files: exact stamps, and errors that name the line."""

import numpy as np
import pytest

from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.trajectory_files import read_trajectory, write_trajectory

POSE = "1 2 3 0 0 0 1"


@pytest.fixture
def tum(tmp_path):
    """Writes text into a file and returns its path."""

    def write(text):
        path = tmp_path / "trajectory.txt"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1317375625.661736", 1317375625661736000),
        ("1317375625.661736123", 1317375625661736123),
        ("9223372036.854775807", 2**63 - 1),
        ("1317375625.6617361234", 1317375625661736123),  # a tenth digit is rounded
        ("1317375625", 1317375625000000000),
        ("1.317375625661736e+09", 1317375625661736000),
        ("0", 0),
        (".5", 500_000_000),
        ("-0.000000001", -1),
    ],
)
def test_stamps_are_exactly_the_decimal_text(tum, text, stamp_ns):
    assert read_trajectory(tum(f"{text} {POSE}\n")).stamps_ns.tolist() == [stamp_ns]


def test_columns_are_translation_then_scalar_last_quaternion(tum):
    pose = read_trajectory(tum(f"0 1 2 3 0 0 {np.sqrt(0.5)} {np.sqrt(0.5)}")).poses[0]
    quarter_turn_about_z = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(pose, quarter_turn_about_z, atol=1e-15)


def test_comments_empty_lines_tabs_and_a_byte_order_mark_are_skipped(tum):
    path = tum(f"\ufeff# timestamp tx ty tz\n\n  0\t{POSE}\r\n   \n#1 2\n1  {POSE}")
    assert read_trajectory(path).stamps_ns.tolist() == [0, 1_000_000_000]


def test_what_is_written_reads_back_to_the_last_bit_of_stamp_and_translation(tmp_path):
    random = np.random.default_rng(5)
    stamps_ns = np.sort(random.choice(2**60, 200, replace=False)) - 2**59
    written = Trajectory(stamps_ns, se3.exp(random.normal(size=(200, 6)) * 3))
    write_trajectory(tmp_path / "t.txt", written)
    read = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_array_equal(read.poses[:, :3, 3], written.poses[:, :3, 3])
    np.testing.assert_allclose(read.poses, written.poses, rtol=0, atol=2e-15)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "no poses in it"),
        (["# only a comment"], "no poses in it"),
        (["0 1 2 3 0 0 0 1 9"], "line 1: expected 8 numbers, .* found 9"),
        ([f"0 {POSE}", "", "1 1 2 3"], "line 3: expected 8 numbers, .* found 4: '1 1 2 3'"),
        ([f"0,{POSE.replace(' ', ',')}"], "line 1: expected 8 numbers"),
        (["0 1 2 x 0 0 0 1"], "line 1: expected 8 numbers, .* 'x'"),
        ([f"now {POSE}"], "line 1: .* found 'now' for the timestamp"),
        ([f"nan {POSE}"], "line 1: .* found 'nan' for the timestamp"),
        ([f"inf {POSE}"], "line 1: .* found 'inf' for the timestamp"),
        ([f"1e999999999 {POSE}"], "line 1: .* timestamp"),
        (
            [f"13173756256617361230 {POSE}"],
            "line 1: the timestamp 1.31738e.19 is too large for ns; name its unit with "
            "`stamp_unit`",
        ),
        (
            [f"{stamp} {POSE}" for stamp in (0, 33, 66, 99)],
            "unit of the timestamps is unclear; read as s, the poses are 33 s apart",
        ),
        ([f"0 {POSE}", "1 nan 2 3 0 0 0 1"], "line 2: found a value that is not finite"),
        ([f"0 {POSE}", "1 1 2 3 0 0 0 inf"], "line 2: found a value that is not finite"),
        (
            ["# x", f"0 {POSE}", "1 1 2 3 0 0 0 1.1"],
            "line 3: found a quaternion of length 1.1, expected 1",
        ),
        (["0 1 2 3 0 0 0 0"], "line 1: found a quaternion of length 0, expected 1"),
        (
            [f"5 {POSE}", f"4.5 {POSE}"],
            "line 2: timestamps must increase, found 4.500000000 after 5.000000000",
        ),
        (
            [f"5 {POSE}", "#", f"5.0 {POSE}"],
            "line 3: timestamps must increase, found 5.000000000 after 5.000000000",
        ),
    ],
)
def test_an_unusable_line_is_named(tum, lines, message):
    path = tum("\n".join(lines))
    with pytest.raises(InputError, match=message) as caught:
        read_trajectory(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(InputError, match=r"absent\.txt: No such file"):
        read_trajectory(tmp_path / "absent.txt")
    with pytest.raises(InputError, match="directory"):
        read_trajectory(tmp_path)
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(InputError, match=r"image\.png: not a text file"):
        read_trajectory(tmp_path / "image.png")
    with pytest.raises(InputError, match="cannot write .*absent"):
        write_trajectory(tmp_path / "absent" / "t.txt", Trajectory(np.array([0]), np.eye(4)[None]))


def test_an_unknown_format_is_refused_with_the_known_ones(tmp_path):
    with pytest.raises(ConfigError, match="unknown trajectory format 'bvh'; known are tum"):
        read_trajectory(tmp_path / "t.bvh", format="bvh")
