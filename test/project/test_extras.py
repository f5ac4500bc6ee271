"""Without an extra's folder and its line, everything else works."""

import json
import os
import re
import shutil
import subprocess
import sys

import pytest
from package_copy import WITHOUT_FINDER, copy_of_the_package
from source_code import PACKAGE, SOURCE

import hand_eye_calib as hec
from hand_eye_calib.extras import EXTRAS

WITHOUT = (
    WITHOUT_FINDER
    + """
import importlib.util
import json

import hand_eye_calib as hec

extra = sys.argv[1]
assert importlib.util.find_spec(f"hand_eye_calib.extras.{extra}") is None
from hand_eye_calib.offline.cli.main import main

assert main([]) == 0
assert main(["calibrate", "sample:lidar.tum", "sample:camera.tum", "--out", sys.argv[2]]) == 0
print(json.dumps(hec.load(sys.argv[2]).to_dict()), file=sys.stderr)
if importlib.util.find_spec("rclpy"):
    import hand_eye_calib.online.ros.calibrator_node
if sys.argv[3:]:
    try:
        code = main(sys.argv[3:])
    except SystemExit as end:
        code = end.code
    assert code in (1, 2), code
"""
)

# What needs an extra, and the one line that says so without it.
SAMPLE = ["sample:lidar.tum", "sample:camera.tum"]
NEEDING = {
    "clouds": ([], ""),
    "detectability": ([], ""),
    "fleet": (["compare", "out"], "invalid choice: 'compare'"),
    "ground": (["calibrate", *SAMPLE, "--ground", "off"], "unknown '--ground'"),
    "mount": ([], ""),
    "partial": (
        ["calibrate", *SAMPLE, "--child-measures", "rotations"],
        "unknown kind of streams 'rotations'",
    ),
    "rig": (
        ["calibrate", *SAMPLE, "sample:truth.tum"],
        "the trajectory files of two sensors",
    ),
    "sensors": (
        [
            "calibrate",
            SAMPLE[0],
            ".",
            "--target",
            "charuco:5x7:0.04:0.03",
            "--camera",
            "c.yaml",
        ],
        "unknown reader of images of a target 'folder'",
    ),
    "simulation": (["simulate"], "invalid choice: 'simulate'"),
    "stops": (["calibrate", *SAMPLE, "--order", "none"], "unknown '--order'"),
    "viewer": (["calibrate", *SAMPLE, "--viewer", "bag"], "unknown '--viewer'"),
    "vehicle": (
        ["calibrate", SAMPLE[0], "--on-vehicle"],
        "unknown '--on-vehicle'",
    ),
}


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The result of the sample recording with all extras, as plain values.

    It comes from a new process, as do the results that are compared with it. Modules that other
    tests have loaded can change the order of sums, and so the last digit.
    """
    out = tmp_path_factory.mktemp("all") / "out"
    command = [sys.executable, "-m", "hand_eye_calib", "calibrate"]
    subprocess.run(
        [*command, "sample:lidar.tum", "sample:camera.tum", "--out", str(out)],
        env=os.environ | {"PYTHONPATH": str(SOURCE.parent)},
        check=True,
        capture_output=True,
    )
    return hec.load(out).to_dict()


def run_without(extra, folder, needing):
    """What a copy of the package without an extra prints: the result of the sample recording, and
    lines of a command that needs the extra.
    """
    copy = copy_of_the_package(folder)
    shutil.rmtree(copy / "extras" / extra)
    table = copy / "extras" / "__init__.py"
    lines = table.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if not re.match(rf' +"{extra}",', line)]
    assert len(kept) == len(lines) - 1
    table.write_text("".join(kept), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, extra, str(folder / "out"), *needing],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    (at,) = (row for row, line in enumerate(lines) if line.startswith("{"))
    return json.loads(lines[at]), lines[at + 1 :]


@pytest.mark.parametrize("extra", EXTRAS)
def test_everything_else_works_without(tmp_path, extra, expected):
    command, message = NEEDING[extra]
    result, lines = run_without(extra, tmp_path, command)
    # Documents have no field for the part of an extra that is not there.
    missing = expected.keys() - result.keys()
    values = {name: expected[name] for name in missing if name != extra}
    assert {*values.values()} <= {None, ""}
    assert result == {
        name: value for name, value in expected.items() if name not in missing
    }
    assert len(lines) == bool(command)
    for line in lines:
        assert message in line


def test_every_folder_is_in_the_table():
    folders = sorted(
        path.parent.name for path in (SOURCE / "extras").glob("*/__init__.py")
    )
    assert folders == sorted(EXTRAS)


TOY = '''
"""A command that prints how often it was named."""

import sys

from hand_eye_calib.core.base.registry import COMMANDS, Command


def register():
    COMMANDS["toy"] = Command("count words", lambda: sys.modules[__name__])


def add_arguments(parser):
    parser.add_argument("words", nargs="*")


def run(arguments):
    print(len(arguments.words))
    return 0
'''


def run_with_toy(folder, source, command):
    """Run Python with a copy of the package that has one extra more."""
    copy = copy_of_the_package(folder)
    (copy / "extras" / "toy").mkdir()
    (copy / "extras" / "toy" / "__init__.py").write_text(source)
    table = copy / "extras" / "__init__.py"
    text = table.read_text(encoding="utf-8")
    table.write_text(
        text.replace("EXTRAS = (\n", 'EXTRAS = (\n    "toy",\n'),
        encoding="utf-8",
    )
    return subprocess.run(
        [sys.executable, *command],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
    )


def test_a_new_extra_is_a_folder_and_a_line(tmp_path):
    done = run_with_toy(tmp_path, TOY, ["-m", PACKAGE, "toy", "one", "two"])
    assert (done.stdout, done.stderr) == ("2\n", "")


TOY_KIND = '''
"""Poses whose heights mean nothing, such as those of a localisation on a map."""

from hand_eye_calib.core.base.registry import KINDS, MEASURES, OUT_OF_REACH, Measure


def register():
    MEASURES["flat"] = Measure("flat")
    OUT_OF_REACH["flat"] = ("z",)
    KINDS["flat"] = _flat


def _flat():
    from dataclasses import replace

    from hand_eye_calib.core.engine import poses
    from hand_eye_calib.core.engine.estimation import solve_poses
    from hand_eye_calib.core.engine.kinds import Kind
    from hand_eye_calib.core.engine.snapshot import MOST_MOVED_S

    def solve(snapshot, cross_check):
        solved = solve_poses(snapshot.pose_pairs, snapshot.config, snapshot.time_offset)
        return replace(solved, measured="flat").calibration(("z",))

    allowed = {"method": ("auto", "adaptive"), "prior_z": ("",)}
    return Kind(solve, poses.check, MOST_MOVED_S, allowed, has_conventions=True)
'''

USE_TOY_KIND = """
import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3

drive = hec.simulate(0, poses=300)
late = drive.child.shifted(-0.3)
inverse = hec.Trajectory(late.stamps_ns, se3.inverse(late.poses))
for child in (late, inverse):
    result = hec.calibrate(drive.parent, child, child_measures="flat")
    error = abs(result.T_parent_child - drive.T_parent_child)[:2, 3].max()
    print(result.measured, result.out_of_reach, result.hidden, result.status.value)
    print(error < 0.05, abs(result.time_offset_s - 0.3) < 0.01, result.verdict.value)
    print([text for text in result.warnings if "solved with" in text.lower()] != [])
for options in ({"method": "dnl"}, {"prior": {"z": (1.0, 0.1)}}, {"parent_measures": "rates"}):
    try:
        hec.calibrate(drive.parent, late, child_measures="flat", **options)
    except hec.HandEyeCalibError as error:
        print(error)
"""


def test_a_new_kind_of_data_is_a_folder_and_a_line(tmp_path):
    done = run_with_toy(
        tmp_path, TOY_KIND, ["-c", WITHOUT_FINDER + USE_TOY_KIND]
    )
    assert done.stderr == ""
    *of_streams, method, prior, other = done.stdout.splitlines()
    assert of_streams == ["flat ('z',) [] ok", "True True USE", "True"] * 2
    both = "the parent measures poses, the child flat"
    assert method == f"method dnl needs poses of both sensors; {both}"
    assert prior == f"prior_z 1.0+/-0.1 needs poses of both sensors; {both}"
    assert other.startswith(
        "these kinds of streams cannot be calibrated together; the parent measures rates"
    )
