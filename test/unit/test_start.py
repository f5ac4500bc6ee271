"""The command line is quick to start because it loads little: what is loaded is counted, not how long that takes."""

import subprocess
import sys

import pytest

from hand_eye_calib.cli.experiment import EXPERIMENTS
from hand_eye_calib.cli.main import COMMANDS

# Each takes from a tenth of a second to a second to load.
HEAVY = {"casadi", "matplotlib", "numpy", "rclpy", "rich", "rosbags", "scipy", "yaml"}

SHOW_HELP = """
import sys
from hand_eye_calib.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    assert end.code == 0
print(*{name.partition(".")[0] for name in sys.modules}, file=sys.stderr)
"""


def loaded_by(code, *arguments):
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    return set(done.stderr.split())


@pytest.mark.parametrize("arguments", [(), *((command,) for command in COMMANDS)], ids=" ".join)
def test_help_loads_no_library(arguments):
    assert not loaded_by(SHOW_HELP, *arguments, "--help") & HEAVY


def test_the_engine_loads_only_what_it_computes_with():
    code = "import sys, hand_eye_calib.calibrator; print(*sys.modules, file=sys.stderr)"
    loaded = loaded_by(code)
    assert not {name.partition(".")[0] for name in loaded} & (HEAVY - {"numpy", "scipy"})
    assert not loaded & {"scipy.stats", "scipy.spatial", "scipy.optimize"}  # scipy.stats takes as long as all the rest


def test_the_help_names_every_experiment():
    from hand_eye_calib.experiments import catalogue

    assert tuple(EXPERIMENTS) == tuple(catalogue.EXPERIMENTS)
