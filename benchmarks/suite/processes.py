"""Rows measured as whole processes: from files to the result, start of the command line, memory;
and bags.
"""

import compileall
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import bags

from hand_eye_calib.io.bags import write_bag
from hand_eye_calib.io.trajectory_files import write_trajectory
from suite.data import LONG
from suite.measuring import row_of

PROJECT = Path(__file__).resolve().parents[2]
_REPEATS = 5
_COMMAND = [sys.executable, "-m", "hand_eye_calib"]

# Peak memory in bytes after importing everything, and after solving this many pairs; they are made
# bit by bit, so that only they count.
_MEMORY = """
import sys
import numpy as np
from suite.data import simulated_drive
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.solvers.registry import Method
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
    """From two TUM files to the result with covariance, and the time until the command line shows
    its help.
    """
    compileall.compile_dir(PROJECT / "hand_eye_calib", quiet=1)  # as pip installs it
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder, name)) for name in ("parent.txt", "child.txt")]
        for file, trajectory in zip(files, drives[LONG].trajectories(), strict=True):
            write_trajectory(file, trajectory)
        commands = {
            "python -c pass": [sys.executable, "-c", "pass"],
            "import numpy": [sys.executable, "-c", "import numpy"],
            "hand_eye_calib --help": [*_COMMAND, "--help"],
            "hand_eye_calib calibrate --help": [*_COMMAND, "calibrate", "--help"],
            "hand_eye_calib replay --help": [*_COMMAND, "replay", "--help"],
            "files to result": [*_COMMAND, "calibrate", *files],
            "files to result, reference B5": [*_COMMAND, "calibrate", *files, "--reference", "B5"],
        }
        for name, command in commands.items():
            size = LONG + 5 if name.startswith("files") else 0
            times = [_run(command) for _ in range(_REPEATS)]
            yield row_of(f"{name}, processor", size, [processor for _, processor in times])
            if name == "files to result":
                yield row_of(f"{name}, wall", size, [wall for wall, _ in times])


def _run(command):
    """Wall and processor time of a process, in seconds."""
    with tempfile.TemporaryFile("w+") as said:
        start = time.perf_counter()
        with subprocess.Popen(
            command, cwd=PROJECT, stdout=subprocess.DEVNULL, stderr=said
        ) as process:
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - start
        if process.returncode:
            said.seek(0)
            raise RuntimeError(
                f"{' '.join(command)} ended with exit code {process.returncode}: {said.read()}"
            )
    return wall, usage.ru_utime + usage.ru_stime


def bag_rows(n_messages):
    """An mcap bag of two Odometry topics, read and solved by us, and iterated over with every
    message deserialised by rosbags.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "bag")
        write_bag(path, bags.streams(n_messages))
        theirs = [bags.with_rosbags(path) for _ in range(3)]
        ours = [bags.with_ours(path) for _ in range(3)]
    yield row_of("rosbags alone", 2 * n_messages, theirs)
    yield row_of("bag: read", 2 * n_messages, [read for read, _, _ in ours])
    yield row_of("bag to result", 2 * n_messages, [fed + solved for _, fed, solved in ours])


def memory(sizes):
    """For each number of pairs: peak memory of a process that solves them by DNLO, before and
    after, and what the pairs take, in bytes.
    """
    found = {}
    for size in sizes:
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(PROJECT / "benchmarks"), str(PROJECT)]),
        }
        done = subprocess.run(
            [sys.executable, "-c", _MEMORY, str(size)],
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        )
        found[size] = tuple(map(int, done.stdout.split()))
    return found
