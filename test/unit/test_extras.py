"""Without an extra's folder and its line, everything else works."""

import json
import os
import re
import shutil
import subprocess
import sys

import pytest
from source_code import PACKAGE, SOURCE

import hand_eye_calib as hec
from hand_eye_calib.extras import EXTRAS
from hand_eye_calib.offline.cli.main import main

# Run without the finder of an editable install, which would find the deleted folder elsewhere.
WITHOUT = """
import importlib.util
import json
import sys

sys.meta_path[:] = [
    finder for finder in sys.meta_path if "__editable__" not in getattr(finder, "__module__", "")
]
import hand_eye_calib as hec

extra = sys.argv[1]
assert importlib.util.find_spec(f"hand_eye_calib.extras.{extra}") is None
from hand_eye_calib.offline.cli.main import main

assert main([]) == 0
assert main(["calibrate", "sample:lidar.tum", "sample:camera.tum", "--out", sys.argv[2]]) == 0
print(json.dumps(hec.load(sys.argv[2]).to_dict()), file=sys.stderr)
if importlib.util.find_spec("rclpy"):
    import hand_eye_calib.online.ros.calibrator_node
"""


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The result of the sample recording with all extras, as plain values."""
    out = tmp_path_factory.mktemp("all") / "out"
    arguments = ["calibrate", "sample:lidar.tum", "sample:camera.tum", "--out", str(out)]
    assert main(arguments) == 0
    return hec.load(out).to_dict()


def calibrated_without(extra, folder):
    """The result of the sample recording by a copy of the package without an extra."""
    copy = folder / PACKAGE
    shutil.copytree(SOURCE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.rmtree(copy / "extras" / extra)
    table = copy / "extras" / "__init__.py"
    lines = table.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if not re.match(rf' +"{extra}",', line)]
    assert len(kept) == len(lines) - 1
    table.write_text("".join(kept), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, extra, str(folder / "out")],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stderr.splitlines()[-1])


@pytest.mark.parametrize("extra", EXTRAS)
def test_everything_else_works_without(tmp_path, extra, expected):
    assert calibrated_without(extra, tmp_path) == expected


def test_every_folder_is_in_the_table():
    folders = sorted(path.parent.name for path in (SOURCE / "extras").glob("*/__init__.py"))
    assert folders == sorted(EXTRAS)
