"""Shells complete commands, options, values and topics."""

import subprocess
import sys

import pytest
from motions import as_trajectory, wandering_poses

from hand_eye_calib.cli.main import main
from hand_eye_calib.io.bags import write_bag

pytest.importorskip("argcomplete", reason="argcomplete is not installed: '.[completion]'")

# What bash does when the tab key is pressed at the end of each line.
PRESS_TAB = r"""
eval "$(PYTHON -m hand_eye_calib completion bash)"
python3() { PYTHON "$@"; }
hand_eye_calib() { PYTHON -m hand_eye_calib "$@"; }
while IFS= read -r line; do
    COMP_LINE="$line" COMP_POINT=${#line} COMP_TYPE=9 COMPREPLY=()
    read -ra COMP_WORDS <<< "$line"
    [[ "$line" == *" " ]] && COMP_WORDS+=("")
    COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
    _python_argcomplete hand_eye_calib
    echo ${COMPREPLY[*]}
done
"""


def completed(*lines):
    """What is offered at the end of each line."""
    done = subprocess.run(
        ["bash", "-c", PRESS_TAB.replace("PYTHON", sys.executable)],
        input="".join(f"{line}\n" for line in lines),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return [set(line.split()) for line in done.stdout.splitlines()]


def test_commands_options_values_and_topics(tmp_path):
    poses = as_trajectory(wandering_poses(5), sensor_frame="a")
    kind = "nav_msgs/msg/Odometry"
    write_bag(tmp_path / "bag", {"/lidar": (poses, kind), "/camera": (poses, kind)})
    offered = completed(
        "hand_eye_calib ch",
        "hand_eye_calib replay --parent-t",
        "hand_eye_calib calibrate --method d",
        f"hand_eye_calib replay {tmp_path / 'bag'} --child-topic /",
        "hand_eye_calib calibrate --child-f",
        "hand_eye_calib simulate --drive h",
    )
    assert offered == [
        {"check"},
        {"--parent-topic", "--parent-tf", "--parent-times"},
        {"dnlo", "dnl"},
        {"/lidar", "/camera"},
        {"--child-format", "--child-frame"},
        {"hilly"},
    ]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_gets_its_code(shell, capsys):
    assert main(["completion", shell]) == 0
    out = capsys.readouterr().out
    assert "hand_eye_calib" in out


def test_without_argcomplete_one_line_says_what_to_install(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "argcomplete", None)
    assert main(["completion", "bash"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert "pip install 'hand_eye_calib[completion]'" in err
