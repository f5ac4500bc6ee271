"""Small files that unpack to much, and files that are no files, are refused in one line."""

import io
import os
import struct
import subprocess
import sys
import zipfile
import zlib

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.extras.sensors.target_images import images_in, read_image
from hand_eye_calib.formats.npz import read_arrays
from hand_eye_calib.formats.trajectory_files.reading import read_trajectory

READ_IMAGES = """
import sys
from pathlib import Path
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.extras.sensors.target_images import read_image
for name in sys.argv[1:]:
    try:
        print(read_image(Path(name)).shape)
    except InputError as error:
        print(error)
"""


def test_arrays_are_read_by_name(tmp_path):
    path = tmp_path / "stops.npz"
    np.savez_compressed(path, robot=np.eye(4)[None], tracking=np.ones((2, 7)))
    arrays = read_arrays(path)
    assert_array_equal(arrays["robot"], np.eye(4)[None])
    assert_array_equal(arrays["tracking"], np.ones((2, 7)))


def test_arrays_of_zeros_are_refused_by_their_unpacked_size(tmp_path):
    path = tmp_path / "stops.npz"
    np.savez_compressed(path, robot=np.zeros((80_000, 16, 8)))
    assert path.stat().st_size < 200_000
    with pytest.raises(
        InputError, match="its arrays take more than 67108864 bytes"
    ):
        read_arrays(path)


def array_file(header):
    text = (header + " " * (117 - len(header)) + "\n").encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"no array", "magic string"),
        (
            array_file(
                "{'descr': '<f8', 'fortran_order': False, 'shape': (10**12,)}"
            ),
            "ormed",
        ),
        (
            array_file(
                "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}"
            ),
            "truncated",
        ),
        (
            array_file(
                "{'descr': '|O', 'fortran_order': False, 'shape': (1,)}"
            ),
            "truncated|pickle",
        ),
        (b"\x93NUMPY\x09\x00", "version"),
        (b"", "magic|EOF"),
    ],
)
def test_what_is_no_array_gives_one_line(tmp_path, content, reason):
    path = tmp_path / "stops.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("robot.npy", content)
    with pytest.raises(
        InputError, match=f"cannot read .*stops.npz: .*({reason})"
    ) as caught:
        read_arrays(path)
    assert "\n" not in str(caught.value)


def png(width, height):
    """A grey image without light: a thousandth of its size in memory."""

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data))
            + kind
            + data
            + struct.pack(">I", zlib.crc32(kind + data))
        )

    packer = zlib.compressobj()
    rows = io.BytesIO()
    for _ in range(height):
        rows.write(packer.compress(bytes(width + 1)))
    rows.write(packer.flush())
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = (
        chunk(b"IHDR", head),
        chunk(b"IDAT", rows.getvalue()),
        chunk(b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def test_an_image_of_too_many_pixels_is_refused(tmp_path):
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    (tmp_path / "small.png").write_bytes(png(30, 20))
    (tmp_path / "large.png").write_bytes(png(20_000, 10_000))
    # In a process of its own: OpenCV reads its limit when it is imported.
    command = [
        sys.executable,
        "-c",
        READ_IMAGES,
        tmp_path / "small.png",
        tmp_path / "large.png",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    small, large = done.stdout.splitlines()
    assert small == "(20, 30)"
    assert "large.png has more than 130,000,000 pixels" in large


def test_a_pipe_among_images_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "1.png")
    (tmp_path / "2.png").symlink_to("/dev/zero")
    for path in images_in(tmp_path):
        with pytest.raises(InputError, match="it is not a regular file"):
            read_image(path)


def test_images_are_in_the_order_of_their_numbers_whatever_digits_they_have(
    tmp_path,
):
    names = ["10.png", "9.png", "a2.png", "²1.png", "٣.png", "a10.png"]
    for name in names:
        (tmp_path / name).touch()
    ordered = [path.name for path in images_in(tmp_path)]
    assert sorted(ordered) == sorted(names)
    assert ordered.index("9.png") < ordered.index("10.png")
    assert ordered.index("a2.png") < ordered.index("a10.png")


def test_compressed_points_are_refused_with_the_command_that_unpacks_them(
    tmp_path,
):
    path = tmp_path / "transformations.pcd"
    names = "x y z intensity roll pitch yaw time"
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {names}\nSIZE 4 4 4 4 4 4 4 8\nTYPE F F F F F F F F\n"
    head += "COUNT 1 1 1 1 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA binary_compressed\n"
    path.write_bytes(head.encode() + bytes(range(80)))
    with pytest.raises(
        InputError,
        match="compressed; unpack them: pcl_convert_pcd_ascii_binary",
    ):
        read_trajectory(path)


def test_a_path_with_a_zero_byte_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot read"):
        read_trajectory(f"{tmp_path}/a\0b.tum")
