"""Rows of whole processes: from files to the result, start of the command line, memory."""

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

# Script that prints peak memory (bytes) before and after the solve of some pairs, and the size of
# the pairs. The pairs are simulated in parts, so that the simulation needs little memory.
_MEMORY = """
import sys
import numpy as np
from suite.data import simulated_drive
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers.registry import Method
def peak():  # the maximum of the module resource includes the parent process
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
    """Yield rows for: two TUM files or a bag to the result with covariance, and the help texts."""
    # An installation by pip contains compiled modules, too.
    compileall.compile_dir(PROJECT / "hand_eye_calib", quiet=1)
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
        sources = []
        for option, topic in zip(_TOPIC_OPTIONS, TOPICS, strict=True):
            sources += [option, topic]
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
            runs = [_run(command) for _ in range(_REPEATS)]
            yield row_of(name, size, [processor_s for _, processor_s in runs])
            if name == "files to result":
                walls_s = [wall_s for wall_s, _ in runs]
                yield row_of(f"{name}, wall", size, walls_s)


def _run(command):
    """Run a process; return its wall time and processor time (s)."""
    with tempfile.TemporaryFile("w+") as errors:
        start = time.perf_counter()
        process = subprocess.Popen(
            command, cwd=PROJECT, stdout=subprocess.DEVNULL, stderr=errors
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        wall_s = time.perf_counter() - start
        # 3 is the exit code if an axis is not observable.
        if process.returncode not in (0, 3):
            errors.seek(0)
            raise RuntimeError(
                f"{command} ended with {process.returncode}: {errors.read()}"
            )
    return wall_s, usage.ru_utime + usage.ru_stime


def memory(sizes):
    """Return the memory (bytes) of a process that solves pairs by DNLO, by number of pairs.

    Each value contains the peak before the solve, the peak after it, and the size of the pairs.
    """
    path = os.pathsep.join([str(PROJECT / "benchmarks"), str(PROJECT)])
    memory_of_size = {}
    for size in sizes:
        command = [sys.executable, "-c", _MEMORY, str(size)]
        options = dict(capture_output=True, text=True, check=True)
        done = subprocess.run(
            command, **options, env=os.environ | {"PYTHONPATH": path}
        )
        numbers = [int(word) for word in done.stdout.split()]
        memory_of_size[size] = tuple(numbers)
    return memory_of_size
