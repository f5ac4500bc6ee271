"""Shells complete commands and options."""

import subprocess
import sys

import pytest

pytest.importorskip("argcomplete", reason="argcomplete is not installed: '.[completion]'")

# What bash does when the tab key is pressed at the end of each line.
PRESS_TAB = r"""
eval "$(PYTHON -c 'import argcomplete; print(argcomplete.shellcode(["hand_eye_calib"]))')"
hand_eye_calib() { PYTHON -m hand_eye_calib "$@"; }
while IFS= read -r line; do
    COMP_LINE="$line" COMP_POINT=${#line} COMP_TYPE=9 COMPREPLY=()
    read -ra COMP_WORDS <<< "$line"
    COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
    _python_argcomplete hand_eye_calib
    echo ${COMPREPLY[*]}
done
"""


def test_commands_and_options_are_completed():
    lines = ["hand_eye_calib ch", "hand_eye_calib calibrate --child-f"]
    done = subprocess.run(
        ["bash", "-c", PRESS_TAB.replace("PYTHON", sys.executable)],
        input="".join(f"{line}\n" for line in lines),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    offered = [set(line.split()) for line in done.stdout.splitlines()]
    assert offered == [{"check"}, {"--child-fields", "--child-format", "--child-frame"}]
