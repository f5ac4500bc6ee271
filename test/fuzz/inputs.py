"""Every input of the fuzzers: a file made from a seed, and what is done with it.

What must hold: no traceback, errors in one line, no control characters on the terminal, and no file
changed outside the directory of the results.
"""

import contextlib
import functools
import io
import tempfile
from pathlib import Path

import pytest
from fuzz import text_inputs
from fuzz.chaos import Chaos

from hand_eye_calib.cli.main import main
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.io.bags import write_bag
from hand_eye_calib.io.journal import count_poses, has_session, read_journal
from hand_eye_calib.io.trajectory_files import write_trajectory
from hand_eye_calib.live.journal import give
from hand_eye_calib.simulation.drive import simulate_drive

SOLVE = ("--method", "park", "--reference", "B3", "--scale", "1", "--time-offset", "0")
ODOMETRY = "nav_msgs/msg/Odometry"


class Finding(Exception):
    """Something that must not happen."""


def command(*arguments):
    """Run a command; returns its exit code. What it prints must be fit for a terminal."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
    said = out.getvalue() + err.getvalue()
    if code not in (0, 1, 2, 3):
        raise Finding(f"exit code {code}")
    if any(not (letter.isprintable() or letter in "\n") for letter in said):
        raise Finding(f"control characters in {said[:300]!r}")
    errors = [line for line in err.getvalue().splitlines() if ": error: " in line]
    if code in (1, 2) and not errors and not out.getvalue():
        raise Finding(f"exit code {code} without a word")
    if max(map(len, err.getvalue().splitlines()), default=0) > 20_000:
        raise Finding("a line of more than 20,000 characters")
    return code


@functools.cache
def whole_bag(suffix):
    """Bytes of a storage file, to be damaged."""
    storage = {".mcap": "mcap", ".db3": "sqlite3", ".bag": "rosbag1"}[suffix]
    drive = simulate_drive(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("bag.bag" if suffix == ".bag" else "bag")
        write_bag(path, {"/a": (drive.parent, ODOMETRY), "/b": (drive.child, ODOMETRY)}, storage)
        return (path if path.is_file() else path / f"bag{suffix}").read_bytes()


# ---- what is done with each kind


def bag(chaos, folder, *names):
    """List a bag, and calibrate from it."""
    path = folder / chaos.choice(names)
    data = whole_bag(path.suffix)
    if chaos.random.random() < 0.5:
        data = chaos.flipped(data, chaos.choice([1, 10, 100]))
    if chaos.random.random() < 0.5:
        data = data[: chaos.random.randrange(len(data))]
    path.write_bytes(data)
    listed = command("replay", path, "--list", "--json")
    topics = ("--parent-topic", "/a", "--child-topic", "/b", "--child-frame", "b")
    saved = ("--out", folder / "out") if chaos.random.random() < 0.01 else ()
    return min(listed, command("replay", path, *topics, *SOLVE, "--json", *saved))


def trajectory(chaos, folder):
    """Calibrate from a text file and a good one."""
    format = chaos.choice(["tum", "kitti", "euroc", "csv"])
    data, times = text_inputs.trajectory(chaos, format)
    (folder / "parent").write_bytes(data)
    (folder / "times").write_bytes(times)
    write_trajectory(folder / "child", text_inputs.CHILD)
    is_guessed = chaos.random.random() < 0.5
    options = [] if is_guessed else ["--parent-format", format]
    options += ["--parent-frame", "a", "--child-frame", "b"]
    options += ["--parent-times", folder / "times"] if format == "kitti" else []
    files = (folder / "parent", folder / "child")
    return command("calibrate", *files, *options, *SOLVE, "--json")


def journal(chaos, folder):
    """Resume a session."""
    for stream in ("parent", "child"):
        (folder / f"{stream}.tum").write_bytes(text_inputs.journal(chaos, stream))
    if not has_session(folder):
        raise Finding("the journal is not seen")
    count_poses(folder)
    calibrator = Calibrator(CalibratorConfig(reference="B3", method="park"))
    try:
        give(read_journal(folder), folder, {"child": calibrator})
        calibrator.estimate()
    except HandEyeCalibError as error:
        if "\n" in str(error):
            raise Finding(f"an error of several lines: {error}") from None
        return 1
    return 0


FORMATS = {
    "mcap": lambda *case: bag(*case, "bag.mcap"),
    "rosbag1": lambda *case: bag(*case, "bag.bag"),
    "sqlite3": lambda *case: bag(*case, "bag.db3", "a%31#?.db3"),
    "trajectory": trajectory,
    "journal": journal,
}


def snapshot(folder):
    """Names, sizes and times of all files but those of the results."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if "out" not in path.relative_to(folder).parts and not path.is_dir():
            state = path.lstat()
            found[str(path)] = (state.st_size, state.st_mtime_ns)
    return found


def exercise(name, seed, folder):
    """Make an input and use it; returns the exit code.

    Raises
    ------
    Finding
        If something happens that must not; any other error is a finding as well.
    """
    case = Path(tempfile.mkdtemp(prefix=f"{name}_{seed}_", dir=folder))
    (case / "mine").write_text("mine")
    for outside in ("tmp", "home"):
        (case / outside).mkdir()
    (case / "inside").mkdir()
    before = snapshot(case)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MPLCONFIGDIR", str(Path(folder).parent))  # its list of fonts is written once
        patch.setenv("TMPDIR", str(case / "tmp"))
        patch.setenv("HOME", str(case / "home"))
        patch.setattr(tempfile, "tempdir", None)
        code = FORMATS[name](Chaos(f"{name} {seed}"), case / "inside")
    changed = {path for path in snapshot(case) if "/inside/" not in path} - before.keys()
    changed |= {path for path in before if snapshot(case).get(path) != before[path]}
    inputs = ("bag", "a%31#?.db3", "parent", "child", "times", "parent.tum", "child.tum")
    changed |= {path.name for path in (case / "inside").iterdir()
                if path.stem != "bag" and path.name not in (*inputs, "out")}  # fmt: skip
    if changed:
        raise Finding(f"written outside the directory of the results: {sorted(changed)}")
    return code
