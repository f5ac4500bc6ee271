"""Messages spell options for the interface of the user: command line, Python or node."""

import ast
import inspect
import re

import numpy as np
import pytest
from motions import child_of, planar_poses

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.registry import FINDING_WORDS
from hand_eye_calib.core.base.spelling import (
    PLACEHOLDER,
    Interface,
    spelled,
    spelled_options,
    with_options,
)
from hand_eye_calib.offline.cli.main import main
from hand_eye_calib.offline.cli.options import as_typed

TEMPLATES = {
    f"{package}: {key}": text
    for package, words in FINDING_WORDS.items()
    for key, row in words().items()
    for text in [f"{row.what}; {row.advice}"]
}

# Neutral text, and its spelling on the command line and in Python.
SPELLINGS = {
    "raise max_gap if so": ("raise --max-gap if so", "raise max_gap if so"),
    "give parent_scale 0.3048, or scale estimate": (
        "give --parent-scale 0.3048, or --scale estimate",
        'give parent_scale=0.3048, or scale="estimate"',
    ),
    "give prior.z 0.5+/-0.02": (
        "give --prior z=0.5+/-0.02",
        'give prior={"z": (0.5, 0.02)}',
    ),
    "confirm it: prior.roll 179deg+/-10deg": (
        "confirm it: --prior roll=179deg+/-10deg",
        'confirm it: prior={"roll": "179deg+/-10deg"}',
    ),
    "check prior.z": ("check --prior z", 'check prior["z"]'),
    "set time_offset 0.0": ("set --time-offset 0.0", "set time_offset=0"),
    "set time_offset to estimate": (
        "set --time-offset to estimate",
        "set time_offset to estimate",
    ),
    "ground off leaves them out": (
        "--ground off leaves them out",
        'ground="off" leaves them out',
    ),
    "target.axes z=1cm": ("--target-axes z=1cm", 'target_axes="z=1cm"'),
    "leave setup out, or setup beside": (
        "leave setup out, or --setup beside",
        'leave setup out, or setup="beside"',
    ),
    "in /a/b.max_gap and 'max_gap'": ("in /a/b.max_gap and 'max_gap'",) * 2,
}


@pytest.mark.parametrize("text", SPELLINGS)
def test_an_option_in_a_message_is_spelled_as_its_road_does(text):
    typed, in_python = SPELLINGS[text]
    assert as_typed(text) == typed
    assert spelled(text, Interface.PYTHON) == in_python
    assert spelled(text, Interface.NODE) == text


def test_the_part_of_a_recording_is_always_an_option_of_a_command_or_of_python():
    text = "calibrate with start 2 and end 18, at the end of which it starts"
    typed = (
        "calibrate with --start 2 and --end 18, at the end of which it starts"
    )
    assert as_typed(text) == typed
    assert spelled(text, Interface.NODE) == typed
    assert "with start=2 and end=18, at" in spelled(text, Interface.PYTHON)


def test_options_are_joined_as_their_road_does():
    options = {
        "prior.z": "VALUE+/-SIGMA",
        "scale": "estimate",
        "prior.x": "1.5+/-0.1",
    }
    assert spelled_options(options.items(), Interface.PYTHON) == (
        'scale="estimate", prior={"z": (0.50, 0.02), "x": (1.5, 0.1)}'
    )
    assert spelled_options(options.items(), Interface.NODE) == (
        "prior.z 0.50+/-0.02, scale estimate, prior.x 1.5+/-0.1"
    )


@pytest.fixture(scope="module")
def flags():
    """Return all arguments of the command ``calibrate``."""
    import contextlib
    import io

    text = io.StringIO()
    with contextlib.redirect_stdout(text), pytest.raises(SystemExit):
        main(["calibrate", "--help", "all"])
    return {*re.findall(r"--[a-z][a-z-]*", text.getvalue())}


@pytest.mark.parametrize("key", TEMPLATES)
def test_the_options_of_each_finding_exist_on_all_roads(key, flags):
    text = re.sub(r"\{[^}]*\}", "1.5", TEMPLATES[key])
    assert not re.search("--[a-z]", text), "the engine writes public names"
    assert {*re.findall(r"--[a-z][a-z-]*", as_typed(text))} <= flags
    parameters = {*inspect.signature(hec.calibrate).parameters, "setup"}
    assert {
        *re.findall(r"(\w+)=", spelled(text, Interface.PYTHON))
    } <= parameters
    for name in CalibratorConfig.by_name():
        if "_" in name or "." in name:
            pattern = rf"(?<![\w.]){re.escape(name)}(?![\w.])"
            assert not re.search(pattern, as_typed(text))
            assert "." not in name or not re.search(
                pattern, spelled(text, Interface.PYTHON)
            )


def test_each_reason_for_unknown_axes_names_a_prior_that_python_accepts():
    stamps_ns = np.arange(300) * 100_000_000
    poses = planar_poses(300, seed=91)
    parent = hec.Trajectory(stamps_ns, poses, sensor_frame="lidar")
    child = hec.Trajectory(stamps_ns, child_of(poses), sensor_frame="camera")
    result = hec.calibrate(
        parent, child, checks=False, method="dnlo", reference="B5"
    )
    reason = next(
        reason for reason in result.reasons if reason.rule == "unobservable"
    )
    assert [*reason.options] == [f"prior.{axis}" for axis in reason.axes]
    argument = re.search(r"prior=(\{.*\})", reason.what_to_do)[1]
    prior = ast.literal_eval(argument)
    assert {*prior} == {*reason.axes}
    again = hec.calibrate(parent, child, checks=False, prior=prior)
    assert not again.hidden
    assert "such as --prior z=0.50+/-0.02" in reason.advice_on(
        Interface.TERMINAL
    )


def test_an_option_in_an_advice_is_not_repeated():
    options = {"scale": "estimate", "prior.yaw": PLACEHOLDER, "max_gap": 2.0}
    text = with_options(
        "give scale estimate, and a prior", options, Interface.TERMINAL
    )
    assert text == (
        "give --scale estimate, and a prior: --max-gap 2.0, such as --prior yaw=90deg+/-2deg"
    )
