"""The launch file, executed with every argument: wherever ROS's launch is installed."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from nav_msgs.msg import Odometry
from ros_harness import PATIENCE_S
from test_parameter_effects import CHANGES

from hand_eye_calib.config import CalibratorConfig, NodeConfig

PROJECT = Path(__file__).resolve().parents[2]

# Of every parameter a value that is not its default, as typed on the command line and as a ROS
# parameter.
GIVEN = {name: (str(value), value) for name, (value, _) in CHANGES.items()} | {
    "threshold": ("1", 1.0),
    "min_inlier_fraction": ("1", 1.0),
    "time_offset": ("estimate", "estimate"),
    "target.translation": ("0.1", 0.1),
    "target.rotation": ("0.01", 0.01),
    "parent_frame": ("123", "123"),
    "child_frame": ("true", "true"),
    "solve_period": ("4", 4.0),
    "parent_type": ("nav_msgs/msg/Odometry", "nav_msgs/msg/Odometry"),
    "child_type": ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseStamped"),
    "output_directory": ("{folder}/out", "{folder}/out"),
    "journal": ("off", "off"),
    "publish_tf": ("true", True),
    "parent_measures": ("poses", "poses"),
    "child_measures": ("poses", "poses"),
    "parent_tf": ("odom:lidar", "odom:lidar"),
    "child_tf": ("vision:camera", "vision:camera"),
    "other_children": ("2", 2),
    "report": ("false", False),
    "installed": ("1 0 0 0 0 0", "1 0 0 0 0 0"),
    "base_frame": ("base_link", "base_link"),
    "monitor": ("true", True),
}

# monitor watches one child sensor.
TOGETHER = [set(GIVEN) - {"monitor"}, {"monitor", "installed"}]

LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
arguments = [argument.split(":=", 1) for argument in sys.argv[2:]]
source = PythonLaunchDescriptionSource(sys.argv[1])
service = LaunchService()
service.include_launch_description(
    LaunchDescription([IncludeLaunchDescription(source, launch_arguments=arguments)])
)
sys.exit(service.run())
"""


@pytest.fixture
def prefix(tmp_path):
    """An installed package, as far as launch looks."""
    pytest.importorskip("launch_ros")
    marker = tmp_path / "share" / "ament_index" / "resource_index" / "packages" / "hand_eye_calib"
    program = tmp_path / "lib" / "hand_eye_calib" / "calibrator"
    for path in (marker, program):
        path.parent.mkdir(parents=True)
        path.touch()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m hand_eye_calib calibrator "$@"\n')
    program.chmod(0o755)
    return tmp_path


@pytest.fixture
def start_launch(prefix, domain, tmp_path):
    """Function that runs the launch file with arguments; returns the log's path."""
    running = []

    def start(*arguments):
        log = tmp_path / "log"
        earlier = os.environ.get("AMENT_PREFIX_PATH", "")
        environment = {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_LOG_DIR": str(tmp_path / "ros_log"),
            "AMENT_PREFIX_PATH": os.pathsep.join(filter(None, [str(prefix), earlier])),
            "PYTHONPATH": os.pathsep.join([str(PROJECT), os.environ.get("PYTHONPATH", "")]),
            "PYTHONUNBUFFERED": "1",
        }
        command = [sys.executable, "-c", LAUNCH, str(PROJECT / "launch" / "calibrator.launch.py")]
        with log.open("wb") as file:
            process = subprocess.Popen(
                [*command, *arguments],
                stdout=file,
                stderr=file,
                env=os.environ | environment,
                start_new_session=True,
            )
        running.append((process, log))
        return log

    yield start
    try:
        for process, log in running:
            process.send_signal(signal.SIGINT)
            code = process.wait(PATIENCE_S)
            assert (code, "Traceback" in log.read_text()) == (0, False), log.read_text()
    finally:
        for process, _ in running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("names", TOGETHER, ids=["most", "monitor"])
def test_every_parameter_is_an_argument_and_arrives(start_launch, peer, tmp_path, names):
    given = {name: GIVEN[name] for name in names}
    texts = {name: text.format(folder=tmp_path) for name, (text, _) in given.items()}
    start_launch(*(f"{name}:={text}" for name, text in texts.items()))
    for name, (_, value) in given.items():
        expected = value.format(folder=tmp_path) if isinstance(value, str) else value
        assert peer.parameter(name) == expected, name


def test_what_is_not_given_is_left_to_the_parameter_file(start_launch, peer, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text("/**: {ros__parameters: {use_sim_time: true, method: park, scale: auto}}")
    start_launch(f"config_file:={config}", "scale:=2")
    assert peer.parameter("method") == "park"
    assert peer.parameter("use_sim_time") is True
    assert peer.parameter("scale") == 2


TYPES = [f"{stream}_type:=nav_msgs/msg/Odometry" for stream in ("parent", "child")]


def test_name_namespace_topics_and_log_level(start_launch, peer):
    arguments = ["name:=front", "namespace:=/robot1", "parent_topic:=/lidar/odom"]
    log = start_launch(*TYPES, *arguments, "log_level:=warn")
    peer.target = "/robot1/front"
    publishers = [peer.publisher(Odometry, name) for name in ("/lidar/odom", "/robot1/child_odom")]
    peer.wait_matched(*publishers)
    assert peer.trigger("reset").success
    assert "subscribed to" not in log.read_text()


def test_debug_is_of_this_node_only(start_launch, peer):
    log = start_launch(*TYPES, "log_level:=debug")
    assert peer.trigger("reset").success
    peer.spin_until(lambda: "subscribed to" in log.read_text(), "the node's log")
    assert "[rcl" not in log.read_text()


def test_every_parameter_is_tried():
    assert set().union(*TOGETHER) == set(GIVEN)
    assert set(GIVEN) == {*CalibratorConfig().to_options(), *NodeConfig().to_options()}
