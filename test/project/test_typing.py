"""What editors and type checkers see of the Python API."""

import ast
import importlib
import subprocess
import sys

import pytest
from source_code import ROOT

import hand_eye_calib as hec

pytest.importorskip("mypy", reason="mypy is not installed")


# A line that says "# wrong" must fail the type check; all others must pass it.
PROGRAM = """\
import numpy as np
import hand_eye_calib as hec

parent: hec.Trajectory = hec.read_trajectory("lidar.txt", format="tum")
child = hec.Trajectory(np.arange(3), np.repeat(np.eye(4)[None], 3, axis=0))
result = hec.calibrate(parent, child, method="dnlo", reference="B5", time_offset="estimate")
result = hec.calibrate(parent, child, prior={"z": (1.85, 0.02)}, keyframe_min_translation=0.1)
hec.calibrate(parent, child, metod="dnlo")  # wrong
hec.calibrate(parent, child, "dnlo")  # wrong
hec.calibrate(parent, child, prior={"z": 1.85})  # wrong
hec.calibrat(parent, child)  # wrong
inliers = int(result.residuals().is_inlier.sum())
sigma: float = result.sigmas_rpy[2]
text: str = result.T_parent_child  # wrong
status: hec.SolveStatus = result.status
path = hec.save(result, "results")
again: hec.Calibration = hec.load(path)
again.T_child_paren  # wrong
config = hec.CalibratorConfig(method="dnl", max_gap=1.0)
calibrator = hec.Calibrator(config)
version: str = hec.__version__
child = hec.read_trajectory(np.zeros((3, 8)), columns="t,x,y,z,qw,qx,qy,qz")
child = hec.read_trajectory(np.zeros((3, 4, 4)), times=np.arange(3.0))
child = hec.read_trajectory(5)  # wrong
hec.calibrate(parent, child, progress=lambda share, step: print(f"{share:.0%} {step}"))
hec.calibrate(parent, child, progress="done")  # wrong
rig: hec.RigCalibration = hec.calibrate_rig({"a": parent, "b": child}, time_offset="estimate")
hec.calibrate_rig([parent, child])  # wrong
hec.write_trajectory("moved.tum", parent)
hec.plot(result).savefig("result.png")
hec.calibrate("lidar.tum", np.zeros((3, 8)), method="dnl", scale=1.0)
hec.calibrate(parent, child, method="dnlp")  # wrong
back: hec.Calibration = result.inverse()
truth = hec.simulate(3, poses=100).T_parent_child
part = parent[:10].shifted(0.5).scaled(2.0).at(np.array([5]))
"""


def test_a_wrong_call_fails_the_type_check_and_a_right_one_passes(tmp_path):
    """Only what the signatures name is followed: a lint run checks the rest."""
    program = tmp_path / "program.py"
    config = tmp_path / "mypy.ini"
    program.write_text(PROGRAM, encoding="utf-8")
    public = {getattr(hec, name).__module__ for name in hec.__all__}
    of_arguments = {
        "hand_eye_calib.core.base.arrays",
        "hand_eye_calib.core.results.result",
        "hand_eye_calib.core.results.verdict",
    }
    of_arguments |= {"hand_eye_calib.core.engine.run"}
    # The modules of Prior and OptionSet.
    of_arguments |= {
        "hand_eye_calib.core.base.text",
        "hand_eye_calib.core.base.option",
    }
    followed = [
        hec.__name__,
        *sorted(public | of_arguments),
        "numpy",
        "numpy.*",
    ]
    config.write_text(
        "[mypy]\nfollow_imports = skip\n"
        + "".join(
            f"[mypy-{module}]\nfollow_imports = silent\n" for module in followed
        )
    )
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", config, program],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    failed = {
        int(line.split(":")[1])
        for line in done.stdout.splitlines()
        if ": error:" in line
    }
    lines = enumerate(PROGRAM.splitlines(), start=1)
    assert failed == {
        number for number, line in lines if line.endswith("# wrong")
    }, done.stdout + done.stderr


def test_the_stub_names_what_exists():
    tree = ast.parse(
        (ROOT / "hand_eye_calib" / "__init__.pyi").read_text(encoding="utf-8")
    )
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    seen = {
        alias.asname: (node.module, alias.name)
        for node in imports
        for alias in node.names
    }
    assert sorted(seen) == sorted(hec.__all__)
    for name, (module, original) in seen.items():
        assert getattr(importlib.import_module(module), original) is getattr(
            hec, name
        )
    assert set(hec.__all__) <= set(dir(hec))
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        _ = hec.calibrat
