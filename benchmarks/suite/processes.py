"""Rows measured as whole processes: from files to the result, start of the command line, memory."""

import compileall
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hand_eye_calib.formats.trajectory_files.writing import write_trajectory
from suite.baseline import NUMPY
from suite.data import LONG, MESSAGES
from suite.measuring import row_of
from suite.rows import TOPICS, write_messages

PROJECT = Path(__file__).resolve().parents[2]
_REPEATS = 5
_TOPIC_OPTIONS = ("--parent-topic", "--child-topic")

# Peak memory in bytes after importing everything, and after solving this many pairs; they are made
# bit by bit, so that only they count.
_MEMORY = """
import sys
import numpy as np
from suite.data import simulated_drive
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers.registry import Method
def peak():  # the maximum that resource tells includes this process's parent
    lines = open("/proc/self/status")
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
size, part = int(sys.argv[1]), 10_000
A, B = np.empty((2, size, 4, 4))
drive = simulated_drive(part + 5)
before = peak()
for first in range(0, size, part):
    pairs = drive.pairs[: min(part, size - first)]
    A[first : first + part] = pairs.Ts_parenti_parentj
    B[first : first + part] = pairs.Ts_childi_childj
Method("dnlo").solve(MotionPairs(A, B, np.arange(size), np.arange(5, size + 5)))
print(before, peak(), A.nbytes + B.nbytes)
"""


def process_rows(drives):
    """From two TUM files, and from a bag, to the result with covariance; the time until the command
    line shows its help.
    """
    compileall.compile_dir(
        PROJECT / "hand_eye_calib", quiet=1
    )  # as pip installs it
    calibrate = [sys.executable, "-m", "hand_eye_calib", "calibrate"]
    with tempfile.TemporaryDirectory() as folder:
        files = [
            str(Path(folder, name)) for name in ("parent.txt", "child.txt")
        ]
        for file, trajectory in zip(
            files, drives[LONG].trajectories(), strict=True
        ):
            write_trajectory(file, trajectory)
        bag = Path(folder, "bag")
        write_messages(bag, MESSAGES)
        sources = [
            word
            for pair in zip(_TOPIC_OPTIONS, TOPICS, strict=True)
            for word in pair
        ]
        commands = {
            (NUMPY, 0): [sys.executable, "-c", "import numpy"],
            ("calibrate --help", 0): [*calibrate, "--help"],
            ("replay --help", 0): [*calibrate[:-1], "replay", "--help"],
            ("files to result", LONG + 5): [*calibrate, *files],
            ("files to result, reference B5", LONG + 5): [
                *calibrate,
                *files,
                "--reference",
                "B5",
            ],
            ("bag to result", MESSAGES): [*calibrate, str(bag), *sources],
        }
        for (name, size), command in commands.items():
            wall, processor = zip(
                *(_run(command) for _ in range(_REPEATS)), strict=True
            )
            yield row_of(name, size, processor)
            if name == "files to result":
                yield row_of(f"{name}, wall", size, wall)


def _run(command):
    """Wall and processor time of a process, in seconds."""
    with tempfile.TemporaryFile("w+") as said:
        start = time.perf_counter()
        process = subprocess.Popen(
            command, cwd=PROJECT, stdout=subprocess.DEVNULL, stderr=said
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - start
        if process.returncode not in (0, 3):  # 3: an axis is not observable
            said.seek(0)
            raise RuntimeError(
                f"{command} ended with {process.returncode}: {said.read()}"
            )
    return wall, usage.ru_utime + usage.ru_stime


def memory(sizes):
    """For each number of pairs: peak memory of a process that solves them by DNLO, before and
    after, and what the pairs take, in bytes.
    """
    path = os.pathsep.join([str(PROJECT / "benchmarks"), str(PROJECT)])
    found = {}
    for size in sizes:
        command = [sys.executable, "-c", _MEMORY, str(size)]
        options = dict(capture_output=True, text=True, check=True)
        done = subprocess.run(
            command, **options, env=os.environ | {"PYTHONPATH": path}
        )
        found[size] = tuple(map(int, done.stdout.split()))
    return found
