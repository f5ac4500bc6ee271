"""The command line is quick to start because it loads little: what is loaded is counted, not how
long that takes.
"""

import os
import subprocess
import sys

import pytest

from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.formats.trajectory_files.writing import write_trajectory
from hand_eye_calib.offline.cli.main import main

# Each takes from a tenth of a second to a second to load.
HEAVY = {
    "casadi",
    "matplotlib",
    "numpy",
    "rclpy",
    "rich",
    "rosbags",
    "scipy",
    "yaml",
}

SHOW_HELP = """
import sys
from hand_eye_calib.offline.cli.main import main
from hand_eye_calib.core.base.registry import COMMANDS
for command in ((), *((each,) for each in COMMANDS)):
    try:
        main([*command, "--help"])
    except SystemExit as end:
        assert end.code == 0
    print(*{name.partition(".")[0] for name in sys.modules}, file=sys.stderr)
"""


def loaded_by(code, *arguments):
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stderr.split())


def test_the_help_of_every_command_loads_no_library():
    assert not loaded_by(SHOW_HELP) & HEAVY


@pytest.mark.parametrize(
    "code",
    [
        "import hand_eye_calib.core.engine.calibrator, hand_eye_calib.online.live.solving; "
        "import hand_eye_calib as hec; hec.Trajectory; hec.Calibration; hec.calibrate",
        "import hand_eye_calib.online.ros.calibrator_node",
    ],
)
def test_engine_and_node_load_only_what_they_compute_with(code):
    loaded = loaded_by(
        f"{code}; import sys; print(*sys.modules, file=sys.stderr)"
    )
    allowed = {"numpy", "scipy"} | (
        {"rclpy", "yaml"} if ".ros." in code else set()
    )
    assert not {name.partition(".")[0] for name in loaded} & (HEAVY - allowed)
    # Any part of scipy takes as long as all the rest, but for the wrapper of LAPACK alone.
    assert {name for name in loaded if name.startswith("scipy")} <= {
        "scipy.linalg._flapack"
    }


def test_calibrating_two_files_loads_no_writer_of_results(tmp_path):
    drive = simulate_drive(0)
    for name, trajectory in (("parent", drive.parent), ("child", drive.child)):
        write_trajectory(tmp_path / name, trajectory)
    code = (
        "import sys; from hand_eye_calib.offline.cli.main import main; "
        "main(sys.argv[1:]); print('loaded', *sys.modules, file=sys.stderr)"
    )
    loaded = loaded_by(
        code, "calibrate", str(tmp_path / "parent"), str(tmp_path / "child")
    )
    assert "loaded" in loaded
    assert not loaded & {
        "yaml",
        "urllib.request",
        "importlib.metadata",
        "matplotlib",
        "casadi",
    }


def test_commands_use_one_thread_unless_told_otherwise(monkeypatch):
    def threads():
        with pytest.raises(SystemExit):
            main(["--help"])
        return os.environ["OMP_NUM_THREADS"]

    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert threads() == "3"
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert threads() == "1"
