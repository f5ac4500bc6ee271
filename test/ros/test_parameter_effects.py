"""Every parameter has an effect, and is an argument of the launch file: whoever adds one says here
which effect.
"""

import contextlib
import dataclasses
import importlib.util
import os
import signal
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import ros_harness
import yaml
from geometry_msgs.msg import PoseStamped, TransformStamped
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Odometry
from numpy.testing import assert_allclose
from parameter_values import CHANGES, GIVEN, TOGETHER
from source_code import ROOT

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig
from hand_eye_calib.core.base.option import option_name
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.journal import has_session
from hand_eye_calib.offline.cli.main import main

QUIET = ["-p solve_period:=1000.0", *ros_harness.RELIABLE_INPUTS]
STREAMS = ("parent", "child")
T_PARENT_REAR = se3.exp(np.array([-1.0, 0.1, 0.3, 0.2, 0.1, 2.5]))


@pytest.fixture(scope="module")
def fed(tmp_path_factory):
    """A peer of a node that has a noisy drive, the child 30 ms after the parent; and the answer
    with everything at its default but B5.
    """
    domain = ros_harness.free_domain()
    node = ros_harness.NodeProcess(
        domain,
        tmp_path_factory.mktemp("effects") / "node.log",
        [*QUIET, "-p reference:=B5"],
    )
    peer = ros_harness.Peer(domain)
    stamps_ns, Ts_pw_p, Ts_cw_c = ros_harness.drive(200)
    noise = se3.exp(
        np.random.default_rng(0).normal(size=(2, 200, 6))
        * np.repeat([0.01, 0.003], 3)
    )
    publishers = peer.publishers()
    peer.wait_matched(*publishers)
    late_ns = stamps_ns + 30_000_000
    streams = (
        (stamps_ns, Ts_pw_p @ noise[0], "lidar"),
        (late_ns, Ts_cw_c @ noise[1], "camera"),
    )
    for publisher, (times_ns, Ts, frame) in zip(
        publishers, streams, strict=True
    ):
        for stamp_ns, T in zip(times_ns.tolist(), Ts, strict=True):
            publisher.publish(
                ros_harness.message(publisher.msg_type, stamp_ns, T, frame)
            )

    def has_all():
        peer.with_defaults = peer.trigger("solve").message
        return "199 poses" in peer.with_defaults

    peer.spin_until(has_all, "all poses in the result")
    yield peer
    peer.close()
    code, _ = node.stop()
    node.kill()
    assert (code, "Traceback" in node.log) == (0, False), node.log


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_while_the_node_runs_changes_the_answer_and_back(fed, name):
    value, beforehand = CHANGES[name]
    defaults = {
        parameter: fed.parameter(parameter) for parameter in (name, *beforehand)
    }
    for parameter, other in beforehand.items():
        assert fed.set_parameter(parameter, other).successful
    before = fed.trigger("solve").message if beforehand else fed.with_defaults
    assert fed.set_parameter(name, value).successful
    after = fed.trigger("solve").message
    assert after != before
    assert fed.set_parameter(name, defaults[name]).successful
    assert fed.trigger("solve").message == before
    for parameter in beforehand:
        assert fed.set_parameter(parameter, defaults[parameter]).successful


def frame_is_used(start_node, peer, tmp_path, stream, text):
    start_node(*QUIET, f"-p {stream}_frame:=chosen")
    assert (
        text in peer.solve(peer.publishers(), *ros_harness.drive())[0].message
    )


def type_is_used(start_node, peer, tmp_path, stream):
    node = start_node(
        *QUIET, f"-p {stream}_type:=geometry_msgs/msg/PoseStamped"
    )
    # The node subscribes although nobody publishes.
    node.wait_for_log(
        f"subscribed to /{stream}_odom (geometry_msgs/msg/PoseStamped)"
    )
    peer.wait_matched(peer.publisher(PoseStamped, f"{stream}_odom"))


def measures_is_used(start_node, peer, tmp_path, stream):
    start_node(*QUIET, f"-p {stream}_measures:=rotations")
    assert (
        peer.solve(peer.publishers(), *ros_harness.drive())[
            1
        ].transform.translation.x
        == 0.0
    )


def solve_period_is_used(start_node, peer, tmp_path):
    start_node(*QUIET)
    heard = peer.listen(TransformStamped, "extrinsic")
    peer.feed(peer.publishers(), *ros_harness.drive())
    assert peer.set_parameter("solve_period", 0.1).successful
    peer.spin_until(lambda: heard, "a result without being asked")


def output_directory_is_used(start_node, peer, tmp_path):
    start_node(*QUIET)
    assert "output_directory" in peer.trigger("save").message
    peer.solve(peer.publishers(), *ros_harness.drive())
    assert not peer.trigger("save").success
    assert peer.set_parameter(
        "output_directory", str(tmp_path / "out")
    ).successful
    saved = peer.trigger("save")
    assert saved.success, saved.message
    assert (tmp_path / "out" / "extrinsic.yaml").exists()
    assert peer.trigger("reset").success
    assert "no result" in peer.trigger("save").message


def journal_is_used(start_node, peer, tmp_path):
    node = start_node(
        *QUIET, f"-p output_directory:={tmp_path / 'off'}", "-p journal:=off"
    )
    assert not peer.trigger("solve").success
    assert node.stop()[0] == 0
    assert not has_session(tmp_path / "off" / "journal")
    start_node(
        *QUIET, f"-p output_directory:={tmp_path / 'new'}", "-p journal:=new"
    )
    peer.spin_until(
        lambda: has_session(tmp_path / "new" / "journal"), "a journal"
    )


def others_are_solved_together(start_node, peer, tmp_path):
    """Saving solves for all sensors, without a report of the two as well."""
    node = start_node(
        *ros_harness.RELIABLE_INPUTS,
        "-p qos_overrides./child2_odom.subscription.reliability:=reliable",
        "-p other_children:=1",
        f"-p output_directory:={tmp_path / 'out'}",
    )
    rear = peer.publisher(Odometry, "child2_odom")
    peer.wait_matched(rear)
    stamps_ns, Ts_pw_p, Ts_cw_c = ros_harness.drive(200)
    for stamp_ns, T in zip(stamps_ns, Ts_pw_p @ T_PARENT_REAR, strict=True):
        rear.publish(ros_harness.message(Odometry, stamp_ns, T, "rear"))
    node.wait_for_log("first pose on /child2_odom")
    peer.solve(peer.publishers(), stamps_ns, Ts_pw_p, Ts_cw_c)
    assert peer.trigger("save").message.endswith("rig/ follows")
    node.wait_for_log("rig/report.html\n", may_have_ended=True)
    for name, T in (
        ("camera", ros_harness.T_PARENT_CHILD),
        ("rear", T_PARENT_REAR),
    ):
        loaded = hec.load(tmp_path / "out/rig" / name)
        assert_allclose(loaded.T_parent_child, T, atol=1e-3)
    assert not (tmp_path / "out/report.html").exists()


def report_is_used(start_node, peer, tmp_path):
    """The report follows after the end of the node; a replay of the journal makes it again."""
    out = tmp_path / "out"
    node = start_node(
        *QUIET,
        "-p report:=true",
        f"-p output_directory:={out}",
        "-p scale:=none",
    )
    with_a_gap = (poses[np.r_[0:60, 75:120]] for poses in ros_harness.drive())
    answer, _ = peer.solve(peer.publishers(), *with_a_gap)
    assert answer.success
    code, _ = node.stop()
    assert code == 0
    node.wait_for_log(
        "report.html follows", "wrote", "report.html\n", may_have_ended=True
    )
    page = (out / "report.html").read_text()
    assert "/parent_odom" in page
    saved = yaml.safe_load((out / "extrinsic.yaml").read_text())
    assert saved["cross_check"]["x"]["of_halves"] is not None
    gap = "gaps: 1, of up to 1.60 s"  # both say what the last check found
    assert gap in page
    assert gap in str(saved["findings"])
    assert saved["provenance"]["inputs"]["child"]["topic"] == "/child_odom"
    assert main(["replay", str(out), "--out", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / "report.html").exists()
    again = yaml.safe_load((tmp_path / "again" / "extrinsic.yaml").read_text())
    assert again["T_parent_child"] == saved["T_parent_child"]
    assert again["provenance"]["inputs"]["child"]["topic"] == "/child_odom"


def publish_tf_is_used(start_node, peer, tmp_path):
    start_node(*QUIET)
    if importlib.util.find_spec("tf2_msgs") is None:
        refused = peer.set_parameter("publish_tf", True)
        assert not refused.successful
        assert refused.reason.startswith(
            "publish_tf needs the message package tf2_msgs, which is not installed"
        )
        assert peer.parameter("publish_tf") is False
        return
    assert peer.set_parameter("publish_tf", True).successful
    peer.spin_until(
        lambda: peer.node.count_subscribers("/tf") == 1,
        "the node to look at /tf",
    )
    assert peer.set_parameter("publish_tf", False).successful
    peer.spin_until(
        lambda: peer.node.count_subscribers("/tf") == 0, "the node to stop that"
    )


def tf_is_used(start_node, peer, tmp_path, name, value, topic):
    node = start_node(*QUIET, f"-p {name}:={value}")
    if importlib.util.find_spec("tf2_msgs") is None:
        assert node.wait() == 1
        assert node.log.startswith(
            f"calibrator: {name} needs the message package tf2_msgs, which is not installed"
        )
        return
    peer.spin_until(
        lambda: peer.node.count_subscribers(topic) == 1,
        f"a listener to {topic}",
    )


def installed_is_used(start_node, peer, tmp_path):
    node = start_node(
        "-p solve_period:=0.2",
        "-p installed:=1 2 3 0 0 0",
        *ros_harness.RELIABLE_INPUTS,
    )
    peer.feed(peer.publishers(), *ros_harness.drive())
    node.wait_for_log("the installed transform is from 1 2 3 0 0 0")


def enabled_is_used(start_node, peer, tmp_path):
    node = start_node(*QUIET, "-p enabled:=false")
    node.wait_for_log("poses are not accepted before ~/set_enabled")
    statuses = peer.diagnostics()
    inputs = ("parent", "child")
    peer.feed(peer.publishers(), *ros_harness.drive(10))

    def ignored():
        values = [
            ros_harness.values_of(statuses[f"/calibrator: {name} input"])
            for name in inputs
            if statuses
        ]
        return [(row["messages"], row["poses_taken"]) for row in values] == [
            ("10", "0")
        ] * 2

    peer.spin_until(ignored, "messages that are not taken")
    assert peer.set_enabled(True).success
    assert peer.solve(peer.publishers(), *ros_harness.drive())[0].success


def monitor_is_used(start_node, peer, tmp_path):
    start_node(*QUIET, "-p monitor:=true", "-p installed:=0 0 0 0 0 0")
    statuses = peer.diagnostics()
    peer.spin_until(lambda: statuses, "diagnostics")
    assert list(statuses) == [
        f"/calibrator: {name}"
        for name in ("mount", "parent input", "child input")
    ]
    # Its page has a button that ends the watch, and calibrates anew.
    assert peer.set_parameter("monitor", False).successful
    peer.solve(peer.publishers(), *ros_harness.drive(60))
    peer.spin_until(
        lambda: "/calibrator: extrinsic" in statuses,
        "the state of a calibration",
    )


def lifecycle_is_used(start_node, peer, tmp_path):
    start_node(*QUIET, "-p lifecycle:=true")
    state = peer.call(GetState, "get_state").current_state
    assert state.label == "unconfigured"


TF = [(f"{stream}_tf", "odom:lidar", "/tf") for stream in STREAMS]
TF.append(("base_frame", "base_link", "/tf_static"))
EFFECTS = {
    "parent_frame": partial(
        frame_is_used, stream="parent", text="camera in chosen: "
    ),
    "child_frame": partial(
        frame_is_used, stream="child", text="chosen in lidar: "
    ),
    **{
        f"{stream}_type": partial(type_is_used, stream=stream)
        for stream in STREAMS
    },
    **{
        f"{stream}_measures": partial(measures_is_used, stream=stream)
        for stream in STREAMS
    },
    **{
        name: partial(tf_is_used, name=name, value=value, topic=topic)
        for name, value, topic in TF
    },
    "solve_period": solve_period_is_used,
    "output_directory": output_directory_is_used,
    "journal": journal_is_used,
    "other_children": others_are_solved_together,
    "report": report_is_used,
    "publish_tf": publish_tf_is_used,
    "installed": installed_is_used,
    "monitor": monitor_is_used,
    "enabled": enabled_is_used,
    "lifecycle": lifecycle_is_used,
}


@pytest.mark.parametrize("name", EFFECTS)
def test_effect(start_node, peer, tmp_path, name):
    EFFECTS[name](start_node, peer, tmp_path)


def test_no_parameter_is_left_out():
    declared = {
        option_name(field)
        for config in (CalibratorConfig, NodeConfig)
        for field in dataclasses.fields(config)
    }
    assert declared == {*CHANGES, *EFFECTS} == {*GIVEN}
    assert set().union(*TOGETHER) == {*GIVEN}


# ---------------------------------------- the launch file, wherever ROS's launch is installed


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

LAUNCHER = [
    sys.executable,
    "-c",
    LAUNCH,
    str(ROOT / "launch" / "calibrator.launch.py"),
]


def environment(prefix, **more):
    """The environment in which launch finds the package."""
    variables = (
        os.environ
        | {"ROS_LOG_DIR": str(prefix / "ros_log"), "PYTHONUNBUFFERED": "1"}
        | more
    )
    for name, path in (("AMENT_PREFIX_PATH", prefix), ("PYTHONPATH", ROOT)):
        variables[name] = os.pathsep.join(
            filter(None, [str(path), os.environ.get(name, "")])
        )
    return variables


@pytest.fixture
def prefix(tmp_path):
    """An installed package, as far as launch looks."""
    pytest.importorskip("launch_ros")
    marker = (
        tmp_path
        / "share"
        / "ament_index"
        / "resource_index"
        / "packages"
        / "hand_eye_calib"
    )
    program = tmp_path / "lib" / "hand_eye_calib" / "calibrator"
    for path in (marker, program):
        path.parent.mkdir(parents=True)
        path.touch()
    program.write_text(
        f'#!/bin/sh\nexec {sys.executable} -m hand_eye_calib calibrator "$@"\n'
    )
    program.chmod(0o755)
    return tmp_path


@pytest.fixture
def start_launch(prefix, domain, tmp_path):
    """Function that runs the launch file with arguments; returns the log's path."""
    running = []

    def start(*arguments):
        log = tmp_path / "log"
        with log.open("wb") as file:
            process = subprocess.Popen(
                [*LAUNCHER, *arguments],
                stdout=file,
                stderr=file,
                env=environment(prefix, ROS_DOMAIN_ID=str(domain)),
                start_new_session=True,
            )
        running.append((process, log))
        return log

    yield start
    try:
        for process, log in running:
            process.send_signal(signal.SIGINT)
            code = process.wait(ros_harness.PATIENCE_S)
            assert (code, "Traceback" in log.read_text()) == (0, False), (
                log.read_text()
            )
    finally:
        for process, _ in running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("names", TOGETHER, ids=["most", "monitor"])
def test_every_parameter_is_an_argument_and_arrives(
    start_launch, peer, tmp_path, names
):
    options = {name: GIVEN[name] for name in names}
    texts = {
        name: text.format(folder=tmp_path)
        for name, (text, _) in options.items()
    }
    start_launch(*(f"{name}:={text}" for name, text in texts.items()))
    for name, (_, value) in options.items():
        expected = (
            value.format(folder=tmp_path) if isinstance(value, str) else value
        )
        assert peer.parameter(name) == expected, name


def test_what_is_not_given_is_left_to_the_parameter_file(
    start_launch, peer, tmp_path
):
    config = tmp_path / "mine.yaml"
    config.write_text(
        "/**: {ros__parameters: {use_sim_time: true, method: park, scale: auto}}"
    )
    start_launch(f"config_file:={config}", "scale:=2")
    assert peer.parameter("method") == "park"
    assert peer.parameter("use_sim_time") is True
    assert peer.parameter("scale") == 2


TYPES = [
    f"{stream}_type:=nav_msgs/msg/Odometry" for stream in ("parent", "child")
]


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("respawn:=yes", "respawn must be true or false; got 'yes'"),
        ("min_pairs:=3.5", "min_pairs must be a whole number; got '3.5'"),
        ("method:=magic", "method must be one of "),
    ],
)
def test_a_value_that_is_not_allowed_is_refused_with_its_name(
    prefix, argument, message
):
    """The node is not started."""
    options = dict(
        capture_output=True, text=True, timeout=ros_harness.PATIENCE_S
    )
    done = subprocess.run(
        [*LAUNCHER, argument], env=environment(prefix), **options
    )
    assert done.returncode == 1
    assert message in done.stdout + done.stderr


def test_the_launch_file_also_serves_the_page_and_records(
    start_launch, peer, tmp_path
):
    recorder = tmp_path / "bin" / "ros2"
    recorder.parent.mkdir()
    recorder.write_text('#!/bin/sh\necho "recorded: $*"\n')
    recorder.chmod(0o755)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(
            "PATH", f"{recorder.parent}{os.pathsep}{os.environ['PATH']}"
        )
        log = start_launch(
            *TYPES,
            "namespace:=robot1",
            "parent_topic:=/lidar/odom",
            "watch:=true",
            "record:=drive",
        )
    peer.target = "/robot1/calibrator"
    assert peer.trigger("reset").success
    ready = (
        "open http://",
        "recorded: bag record -o drive /lidar/odom /robot1/child_odom /tf",
    )
    peer.spin_until(
        lambda: all(text in log.read_text() for text in ready), f"{ready}"
    )
    assert (
        "/robot1/calibrator/extrinsic /robot1/calibrator/extrinsic_with"
        in log.read_text()
    )


def test_name_namespace_topics_and_log_level(start_launch, peer):
    arguments = [
        "name:=front",
        "namespace:=/robot1",
        "parent_topic:=/lidar/odom",
    ]
    arguments += ["other_children:=1", "child2_topic:=/rear/odom"]
    arguments += [
        "publish_tf:=true",
        "tf_topic:=/robot1/tf",
        "tf_static_topic:=tf_static",
    ]
    log = start_launch(*TYPES, *arguments, "log_level:=warn")
    peer.target = "/robot1/front"
    topics = ("/lidar/odom", "/robot1/child_odom", "/rear/odom")
    publishers = [peer.publisher(Odometry, name) for name in topics]
    peer.wait_matched(*publishers)
    for topic in ("/robot1/tf", "/robot1/tf_static"):
        peer.spin_until(lambda: peer.node.count_subscribers(topic) == 1, topic)  # noqa: B023
    assert peer.trigger("reset").success
    assert "subscribed to" not in log.read_text()
