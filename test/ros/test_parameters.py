"""Parameters: declared from the options, checked, applied."""

import dataclasses

import pytest
from rcl_interfaces.srv import ListParameters
from ros_harness import RELIABLE_INPUTS, drive

from hand_eye_calib.core.base.config import (
    METHODS,
    CalibratorConfig,
    NodeConfig,
)
from hand_eye_calib.core.base.option import option_name

FIELDS = {
    option_name(field): field
    for config in (CalibratorConfig, NodeConfig)
    for field in dataclasses.fields(config)
}


def parameter_file(path, **parameters):
    lines = [f"    {name}: {value}" for name, value in parameters.items()]
    path.write_text("\n".join(["/**:", "  ros__parameters:", *lines]) + "\n")
    return f"--params-file {path}"


def test_every_option_is_a_described_parameter_changes_are_applied_or_rejected(
    start_node, peer
):
    start_node("-p solve_period:=1000.0", *RELIABLE_INPUTS)
    assert set(FIELDS) <= set(
        peer.call(ListParameters, "list_parameters").result.names
    )
    (of_threshold,) = peer.describe("threshold").floating_point_range
    assert (of_threshold.from_value, of_threshold.to_value) == (1e-12, 1e6)
    (of_max_pairs,) = peer.describe("max_pairs").integer_range
    assert (of_max_pairs.from_value, of_max_pairs.to_value) == (10, 10**8)
    for name in ("threshold", "max_pairs", "method", "scale", "parent_frame"):
        meta = FIELDS[name].metadata
        descriptor = peer.describe(name)
        assert descriptor.description.startswith(meta["doc"])
        assert descriptor.read_only == meta["read_only"]
        assert descriptor.dynamic_typing == bool(meta["words"])
        assert peer.parameter(name) == FIELDS[name].default
    assert ", ".join(METHODS) in peer.describe("method").description

    answer, _ = peer.solve(peer.publishers(), *drive())
    assert "; adaptive " in answer.message
    assert peer.set_parameter("method", "dnl").successful
    assert peer.set_parameter("reference", "B3").successful
    assert "; dnl B3: " in peer.trigger("solve").message

    for name, value, reason in [
        ("method", "magic", f"method must be one of {', '.join(METHODS)}"),
        ("reference", "B0", "reference must be auto, A, B<n>"),
        ("threshold", -1.0, "threshold out of range Min: 1e-12"),
        ("max_pairs", 3, "max_pairs out of range. Min: 10"),
        ("threshold", 1, "Wrong parameter type"),
        ("scale", "huge", "scale must be none or "),
        ("scale", -2.0, "scale out of range Min: 1e-06"),
        ("parent_frame", "lidar", "read-only"),
    ]:
        before = peer.parameter(name)
        result = peer.set_parameter(name, value)
        assert not result.successful, (name, value)
        assert reason in result.reason
        assert peer.parameter(name) == before
    assert "; dnl B3: " in peer.trigger("solve").message


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("max_pairs", "many", "max_pairs must be a whole number; got 'many'"),
        (
            "method",
            "magic",
            f"method must be one of {', '.join(METHODS)}; got 'magic'",
        ),
        ("scale", "[]", "a parameter has an unusable value, such as []"),
    ],
)
def test_bad_value_in_the_file_is_one_line_and_code_1(
    start_node, tmp_path, name, value, expected
):
    node = start_node(parameter_file(tmp_path / "bad.yaml", **{name: value}))
    assert node.wait() == 1
    assert node.log.startswith(f"calibrator: {expected}")
    assert node.log.count("\n") == 1


def test_unknown_names_in_the_file_are_warned_about(start_node, tmp_path):
    node = start_node(
        parameter_file(
            tmp_path / "typo.yaml",
            treshold=0.02,
            nonsense=1,
            threshold=1,
            parent_topic="/lidar/odometry",
            child2_odom="/gnss",
        ),
        *RELIABLE_INPUTS,
    )
    log = node.wait_for_log(
        "parameter treshold does not exist and is ignored; did you mean threshold?",
        "parameter nonsense does not exist",
        "parent_topic does not exist and is ignored; a topic is set with -r "
        "parent_odom:=/lidar/odometry",
        "child2_odom does not exist and is ignored; a topic is set with -r child2_odom:=/gnss",
        "parameters: threshold 1.0",  # written as an integer
    )
    assert log.count("does not exist") == 4
    assert node.stop()[0] == 0


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["--params-file {folder}/broken.yaml"], 1, "{folder}/broken.yaml"),
        (["--params-file {folder}/absent.yaml"], 1, "{folder}/absent.yaml"),
        (["--no-such-option"], 2, "no-such-option"),
        (["-r parent_odom=/lidar"], 1, "write -r FROM:=TO"),
        (
            [
                "-p parent_type:=nav_msgs/msg/Odometry",
                "-p qos_overrides./parent_odom.subscription.reliability:=sometimes",
            ],
            *(1, "calibrator: cannot subscribe to /parent_odom: "),
        ),
    ],
)
def test_a_wrong_start_is_one_line(start_node, tmp_path, arguments, code, text):
    (tmp_path / "broken.yaml").write_text("a: [1\n b: {")
    node = start_node(
        *(argument.format(folder=tmp_path) for argument in arguments)
    )
    assert node.wait() == code
    assert text.format(folder=tmp_path) in node.log
    assert node.log.count("\n") == 1
