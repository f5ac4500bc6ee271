"""Files of every format, damaged on purpose, each from a seed: a finding is repeated by its format
and seed. ``make fuzz`` makes thousands.

What must hold: no traceback, errors in one line, no control characters on the terminal, no file
written but the results.
"""

import faulthandler
import functools
import os
import random
import re
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from motions import (
    as_trajectory,
    child_of,
    disturbed,
    messages,
    wandering_poses,
)

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.writer import write_bag
from hand_eye_calib.formats.journal import JournalWriter
from hand_eye_calib.formats.trajectory_files.writing import write_trajectory

FORMATS = (
    "mcap",
    "sqlite3",
    "rosbag1",
    "tum",
    "kitti",
    "euroc",
    "csv",
    "journal",
)
N_INPUTS = int(os.environ.get("FUZZ_INPUTS", 24 * len(FORMATS))) // len(FORMATS)
FIRST_SEED = 1 if N_INPUTS == 24 else 1000
LONGEST_S = 10.0
LARGEST_MB = 1000.0
LONGEST_LINE = 20_000

SOLVE = ("--method", "park", "--reference", "B3", "--scale", "1", "--time-offset", "0", "--json",
         "--parent-frame", "a", "--child-frame", "b")  # fmt: skip
TOPICS = ("--parent-topic", "/a", "--child-topic", "/b")
POSES = wandering_poses(60)
PARENT = as_trajectory(POSES)
CHILD = as_trajectory(disturbed(child_of(POSES), 1, 1e-3, 1e-3))
ODD = ("", "nan", "inf", "-inf", "1e400", "1e154", "-1e300", "0x10", "1_0", "1e-400", "abc", "--",
       "9" * 400, "1e999999999", "-0", "1,5", '"', "\0", "\x1b[2J", "١", "5e-324", "#", "1" * 5000,
       "# t x y z", ",,,,,,,", "\t", " " * 1000, "\ufeff", '"1\n2"', "\x0c", "\x85")  # fmt: skip


def text_of(format):
    """A file of PARENT, and of its stamps for format kitti."""
    stamps = [
        f"{stamp // 10**9}.{stamp % 10**9:09d}"
        for stamp in PARENT.stamps_ns.tolist()
    ]
    rows = np.c_[POSES[:, :3, 3], se3.to_quat_xyzw(POSES)].tolist()
    if format == "kitti":
        return "\n".join(
            " ".join(map(repr, T[:3].ravel().tolist())) for T in POSES
        ), stamps
    if format == "euroc":
        stamps = PARENT.stamps_ns.tolist()
        rows = [[*row[:3], row[6], *row[3:6]] for row in rows]
    separator = " " if format == "tum" else ","
    lines = [
        separator.join(map(str, row)) for row in np.c_[stamps, rows].tolist()
    ]
    if format == "csv":
        lines.insert(0, "t,x,y,z,qx,qy,qz,qw")
    return "\n".join(lines), stamps


@functools.cache
def whole(format):
    """Names and bytes of a good input."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name, "made")
        if format == "journal":
            streams = {"parent": PARENT, "child": CHILD}
            about = {"options": {}, "given": (), "topic": "/a"}
            writer = JournalWriter(folder, dict.fromkeys(streams, about))
            for stream, poses in streams.items():
                for message in messages(stream, poses):
                    writer.add_pose(*message)
            writer.close()
        elif format in ("mcap", "sqlite3", "rosbag1"):
            kind = "nav_msgs/msg/Odometry"
            path = folder / "bag.bag" if format == "rosbag1" else folder
            path.parent.mkdir(exist_ok=True)
            write_bag(path, {"/a": (PARENT, kind), "/b": (CHILD, kind)}, format)
        else:
            folder.mkdir()
            text, stamps = text_of(format)
            (folder / "parent").write_text(text)
            (folder / "times").write_text("\n".join(map(str, stamps)))
        kept = [
            path for path in folder.iterdir() if path.name != "metadata.yaml"
        ]
        return {path.name: path.read_bytes() for path in kept}


def damaged(chance, data):
    """Bytes with some changed, left out or repeated."""
    for _ in range(chance.choice([1, 1, 3, 30])):
        place = chance.randrange(len(data) + 1)
        length = chance.choice([1, 1, 8, 1000])
        before = data[:place]
        piece = data[place : place + length]
        after = data[place + length :]
        flipped = bytes(byte ^ 1 << chance.randrange(8) for byte in piece)
        data = (
            before
            + chance.choice([flipped, flipped, b"", piece * 2, bytes(length)])
            + after
        )
    return (
        data[: chance.randrange(len(data) + 1)]
        if chance.random() < 0.3
        else data
    )


def rewritten(chance, data):
    """Text with some words and lines exchanged for others."""
    lines = data.decode().splitlines()
    rate = chance.choice([0.0003, 0.004, 0.05])
    for k, line in enumerate(lines):
        separator = "," if "," in line else " "
        words = [
            chance.choice(ODD) if chance.random() < rate else w
            for w in line.split(separator)
        ]
        lines[k] = (
            chance.choice(ODD)
            if chance.random() < rate
            else separator.join(words)
        )
    if chance.random() < 0.2:
        chance.shuffle(lines)
    return chance.choice(["\n", "\n", "\r\n"]).join(lines).encode()


def exercise(run, format, seed, folder):
    """Exit code of a command on an input made from a seed."""
    chance = random.Random(f"{format} {seed}")
    files = {}
    is_text = format not in ("mcap", "sqlite3", "rosbag1")
    for name, data in whole(format).items():
        change = rewritten if is_text and chance.random() < 0.7 else damaged
        files[name] = change(chance, data) if chance.random() < 0.9 else data
    if is_text and format != "journal":
        write_trajectory(folder / "child", CHILD)
        files |= {"child": (folder / "child").read_bytes()}
        guess = [] if chance.random() < 0.5 else ["--parent-format", format]
        times = (
            ["--parent-times", folder / "times"] if format == "kitti" else []
        )
        command = [
            "calibrate",
            folder / "parent",
            folder / "child",
            *guess,
            *times,
            *SOLVE,
        ]
    else:
        path = folder if format == "journal" else folder / next(iter(files))
        command = ["replay", path, *TOPICS * (not is_text), *SOLVE]
    for name, data in files.items():
        (folder / name).write_bytes(data)
    code, out, err = run(*command)
    assert code in (0, 1, 2, 3)
    assert all(letter.isprintable() or letter == "\n" for letter in out + err)
    assert code not in (1, 2) or ": error: " in err or out
    assert max(map(len, err.splitlines()), default=0) <= LONGEST_LINE
    contents = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert contents == files
    for path in folder.iterdir():
        path.unlink()
    return code


@pytest.mark.parametrize("format", FORMATS)
def test_damaged_inputs_end_in_an_answer_or_in_one_line(
    run, tmp_path, monkeypatch, format
):
    for name in ("HOME", "TMPDIR"):
        (tmp_path / name).mkdir()
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "TMPDIR"))
    (tmp_path / "input").mkdir()
    whole(format)
    codes = []
    try:
        for seed in range(FIRST_SEED, FIRST_SEED + N_INPUTS):
            # Whatever takes minutes is a hang.
            faulthandler.dump_traceback_later(
                600, exit=True, file=sys.__stderr__
            )
            began = time.process_time()
            codes.append(exercise(run, format, seed, tmp_path / "input"))
            assert time.process_time() - began < LONGEST_S, seed
    finally:
        faulthandler.cancel_dump_traceback_later()
    assert not [*(tmp_path / "TMPDIR").iterdir()]
    # Memory is measured in a process of its own. ru_maxrss would be that of its parent.
    if N_INPUTS > 24:
        peak = re.search(
            r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text()
        )
        assert int(peak[1]) / 1024 < LARGEST_MB
    assert {code in (0, 3) for code in codes} == {True, False}, codes
