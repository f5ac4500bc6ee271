"""The command line: what it prints where, its exit codes, and one line for everything that is wrong
with the input.
"""

import dataclasses
import functools
import hashlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from motions import disturbed, walked, write_pair
from numpy.testing import assert_allclose
from result_making import written_finding
from source_code import ROOT

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import SolveStatus
from hand_eye_calib.core.results.records import Severity
from hand_eye_calib.formats.bags.writer import write_bag
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.offline.cli.main import main
from hand_eye_calib.offline.cli.options import fail, print_result
from hand_eye_calib.offline.cli.present import as_lines

pytestmark = pytest.mark.usefixtures("no_figures")

ODOMETRY = "nav_msgs/msg/Odometry"
PARENT_TOPIC = "/lidar/odom"
CHILD_TOPIC = "/camera/odom"
TOPICS = ["--parent-topic", PARENT_TOPIC, "--child-topic", CHILD_TOPIC]
START_NS = 1_700_000_000_000_000_000
TRUTH = se3.exp(np.array([0.4, -0.1, 0.25, 0.3, -0.2, 1.1]))
NOISE = 5e-5, 7e-4  # m, rad
OTHER_WORLD = se3.exp(np.array([5.0, -3.0, 1.0, 0.1, 0.4, -2.0]))


def drive(count=120, planar=False, first_ns=START_NS):
    """Trajectories of two sensors whose extrinsic is TRUTH, 10 Hz. Without noise they would be one
    stream computed from the other.
    """
    time = 0.1 * np.arange(count)
    twists = np.zeros((count, 6))
    twists[:, 0] = 0.1
    twists[:, 5] = 0.08 * np.sin(0.9 * time)
    if not planar:
        twists[:, 3] = 0.05 * np.sin(1.7 * time)
        twists[:, 4] = 0.06 * np.cos(1.3 * time)
    stamps_ns = first_ns + 100_000_000 * np.arange(count)
    parent = Trajectory(stamps_ns, walked(se3.exp(twists[1:])), "lidar", "map")
    child = disturbed(OTHER_WORLD @ parent.poses @ TRUTH, 1, *NOISE)
    return parent, Trajectory(stamps_ns, child, "camera", "odom")


@pytest.fixture
def new_bag(tmp_path):
    """Writes a bag with both trajectories and returns its path."""

    def write(parent=None, child=None, storage="mcap"):
        both = drive()
        streams = {
            PARENT_TOPIC: (both[0] if parent is None else parent, ODOMETRY),
            CHILD_TOPIC: (both[1] if child is None else child, ODOMETRY),
        }
        path = tmp_path / ("drive.bag" if storage == "rosbag1" else "drive")
        write_bag(path, streams, storage)
        return str(path)

    return write


# ---- replay and calibrate on good input


@pytest.mark.parametrize("storage", ["mcap", "rosbag1"])
def test_replay_finds_the_extrinsic_and_says_it_in_both_directions(
    run, new_bag, storage
):
    code, out, err = run("calibrate", new_bag(storage=storage), *TOPICS, "-v")
    assert (code, err) == (0, "")
    assert out.startswith("USE: good to ")
    assert "\ncamera in lidar: maps coordinates of camera into lidar\n" in out
    assert "\nlidar in camera: maps coordinates of lidar into camera\n" in out
    rows = re.findall(r"^  [xyz] +(\S+) \+/- \d\S* m ", out, flags=re.MULTILINE)
    truth = np.concatenate([TRUTH[:3, 3], se3.inverse(TRUTH)[:3, 3]])
    assert_allclose(np.array(rows, dtype=float), truth, atol=1e-3)
    assert re.search(r"  yaw +\S+ \+/- \d\S* deg  \(.* measured, ", out)
    assert "\nNext\n" not in out
    assert (
        "\nTo publish it (USE)\n  ros2 run tf2_ros static_transform_publisher"
        in out
    )


def test_json_is_one_document_on_stdout(run, new_bag):
    bag = new_bag()
    code, out, err = run(
        "replay", bag, *TOPICS, "--json", "--method", "dnl", "--reference", "B2"
    )
    document = json.loads(out)
    assert (code, err) == (0, "")
    assert_allclose(document["T_parent_child"]["matrix"], TRUTH, atol=1e-3)
    assert (document["method"], document["reference"], document["status"]) == (
        "dnl",
        "B2",
        "ok",
    )
    assert (document["parent_frame"], document["child_frame"]) == (
        "lidar",
        "camera",
    )
    assert document["inputs"]["bag"] == bag
    assert document["inputs"]["parent"] == {
        "topic": PARENT_TOPIC, "messages": 120, "refused_duplicate": 0, "refused_late": 0,
        "dropped_unpaired": 0,
        "first_stamp_ns": START_NS, "last_stamp_ns": START_NS + 11_900_000_000,
    }  # fmt: skip
    assert document["inputs"]["options"]["method"] == "dnl"


def test_the_likelier_parent_is_chosen_by_its_name(run, tmp_path):
    first, second = drive()
    write_bag(
        tmp_path / "named",
        {"/a": (second, ODOMETRY), "/base_link/odom": (first, ODOMETRY)},
    )
    code, out, _err = run("check", tmp_path / "named")
    assert code == 0
    assert "parent is /base_link/odom\nchild is /a\n" in out


def test_calibrate_on_files_gives_what_replay_gives(run, new_bag, tmp_path):
    files = write_pair(tmp_path, *drive())
    options = [
        "--json",
        "--reference",
        "B5",
        "--parent-frame",
        "lidar",
        "--child-frame",
        "camera",
    ]
    code, out, err = run("calibrate", *files, *options)
    assert (code, err) == (0, "")
    from_files = json.loads(out)
    from_bag = json.loads(run("replay", new_bag(), *TOPICS, *options)[1])
    assert_allclose(
        from_files["T_parent_child"]["matrix"],
        from_bag["T_parent_child"]["matrix"],
        atol=1e-12,
    )
    stamps = {
        "first_stamp_ns": START_NS,
        "last_stamp_ns": START_NS + 11_900_000_000,
    }
    assert from_files["inputs"]["child"] == {
        "file": files[1],
        "poses": 120,
        **stamps,
    }
    # two files are used whole, a stream is bounded
    options = [
        document["inputs"]["options"] for document in (from_files, from_bag)
    ]
    assert [document.pop("max_pairs") for document in options] == [120, 5000]
    assert options[0] == options[1]


def test_out_saves_what_info_shows(run, new_bag, tmp_path):
    out_dir = tmp_path / "result"
    code, text, err = run("replay", new_bag(), *TOPICS, "--out", out_dir)
    wrote = f"hand_eye_calib: note: wrote {out_dir}/"
    files = (
        "extrinsic.yaml, extrinsic.urdf.xacro and static_transform.launch.py"
    )
    assert (code, err) == (0, f"{wrote}{files}\n{wrote}report.html\n")
    files = [
        "extrinsic.urdf.xacro",
        "extrinsic.yaml",
        "report.html",
        "static_transform.launch.py",
    ]
    assert sorted(path.name for path in out_dir.iterdir()) == files
    assert run("info", out_dir) == (0, text, "")
    document = json.loads(run("info", out_dir / "extrinsic.yaml", "--json")[1])
    assert document == load_result(out_dir).to_dict()
    provenance = yaml.safe_load((out_dir / "extrinsic.yaml").read_text())[
        "provenance"
    ]
    assert provenance["inputs"]["child"]["topic"] == CHILD_TOPIC
    (file,) = provenance["inputs"]["files"]
    assert (
        file["sha256"]
        == hashlib.sha256(Path(file["file"]).read_bytes()).hexdigest()
    )
    assert provenance["parameters"]["method"] == "auto"
    again = run("replay", file["file"], *TOPICS, "--out", out_dir)
    assert (
        f"launch.py; the earlier files are in {out_dir}/previous\n" in again[2]
    )


def test_planar_motion_is_said_to_leave_z_unknown(run, new_bag, tmp_path):
    parent, child = drive(planar=True)
    code, out, err = run("replay", new_bag(parent, child), *TOPICS, "-v")
    assert (code, err) == (3, "")
    assert re.search(r"^  z +unknown$", out, flags=re.MULTILINE)
    assert out.startswith("USE WITH CARE: all but z; measure z by hand\n")
    command = next(
        line
        for line in out.splitlines()
        if "static_transform_publisher" in line
    )
    assert " --z MEASURE_Z_BY_HAND --qx " in command
    assert (
        "\nTo publish it (USE WITH CARE, after you have replaced MEASURE_Z_BY_HAND)\n"
        in out
    )
    assert (
        "\n  measure z by hand, then add --prior z=0.50+/-0.02 with your value"
        in out
    )
    path = tmp_path / "drive"
    code, out, err = run("replay", path, *TOPICS, "--prior", "z=0.1±0.01")
    assert (code, err) == (0, "")
    assert "MEASURE_Z_BY_HAND" not in out


# ---- what is printed


def in_millimetres(parent, child):
    positions = 1000.0 * se3.translation_of(child.poses)
    poses = se3.from_rotation_translation(
        se3.rotation_of(child.poses), positions
    )
    return parent, dataclasses.replace(child, poses=poses)


def late(parent, child):
    stamps_ns = child.stamps_ns + 40_000_000
    return parent, dataclasses.replace(child, stamps_ns=stamps_ns)


@pytest.mark.parametrize(
    ("streams", "options", "n_commands"),
    [
        (drive(planar=True), [], 0),
        (drive(planar=True), ["--prior", "y=-0.1+/-0.02"], 0),
        (in_millimetres(*drive()), ["--scale", "none"], 1),
        (in_millimetres(*drive()), ["--scale=0.5"], 1),
        (
            late(*drive(600)),
            ["--time-offset", "0.02", "--prior", "z=0.3+/-0.2"],
            1,
        ),
    ],
)
def test_every_printed_command_runs_as_it_is(
    run, new_bag, streams, options, n_commands
):
    """Options are in it once, and a value that is still to be measured is not."""
    _, out, err = run("calibrate", new_bag(*streams), *TOPICS, *options)
    pattern = r"^  hand_eye_calib (calibrate .*)$"
    printed = re.findall(pattern, out + err, flags=re.MULTILINE)
    assert len(printed) == n_commands
    for command in printed:
        typed = shlex.split(command)
        names = [
            word.partition("=")[0] for word in typed if word.startswith("--")
        ]
        assert len(names) == len({*names}), command
        code, _, err = run(*typed)
        assert code in (0, 3), err


def test_each_reason_stands_above_what_to_do_about_it(run, new_bag, tmp_path):
    """The headline of planar motion names the second reason, too."""
    assert (
        run(
            "replay",
            new_bag(*drive(planar=True)),
            *TOPICS,
            "--out",
            tmp_path / "out",
        )[0]
        == 3
    )
    jumps = written_finding(
        "jumps", Severity.WARNING, "many jumps", "find out why"
    )
    calibration = dataclasses.replace(
        load_result(tmp_path / "out"), findings=(jumps,)
    )
    lines = as_lines(calibration)
    assert lines[0] == "USE WITH CARE: all but z; measure z by hand; many jumps"
    assert lines[1:5] == [
        "- z cannot be determined from this motion",
        "  -> measure it by hand and give a prior, such as --prior z=0.50+/-0.02",
        "- many jumps",
        "  -> find out why",
    ]


@functools.cache
def solved():
    return hec.calibrate(*drive())


def some_calibration(**changes):
    return dataclasses.replace(solved(), **changes)


def test_a_solve_that_did_not_converge_fails(run, new_bag, monkeypatch):
    from hand_eye_calib.core.engine.snapshot import Snapshot

    calibration = some_calibration(
        status=SolveStatus.NOT_CONVERGED, warnings=("look here",)
    )
    assert "\n".join(as_lines(calibration)).startswith(
        "DO NOT USE: the solver did not converge\n  -> record more varied motion\nNote: look here\n"
    )
    assert "static_transform_publisher" not in "\n".join(as_lines(calibration))
    monkeypatch.setattr(Snapshot, "estimate", lambda self, **_: calibration)
    code, out, err = run("replay", new_bag(), *TOPICS, "--json")
    assert (code, json.loads(out)["status"]) == (1, "not_converged")
    assert err.startswith("hand_eye_calib: error: the solver did not converge")


# ---- bad input: one line, exit code 1


def child_with(**fields):
    return {"child": dataclasses.replace(drive()[1], **fields)}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"parent": drive(count=5)[0]},
            "10 synchronised pose pairs are needed, found 5",
        ),
        (
            {"child": drive(30, first_ns=START_NS + 10**12)[1]},
            "the streams do not overlap in time",
        ),
        ({"child": drive()[1][:0]}, "no poses on the child stream"),
        (
            child_with(sensor_frame=""),
            f"{CHILD_TOPIC}, stamp 1700000000.000000000: the child stream's sensor frame is empty",
        ),
        (
            child_with(sensor_frame="lidar"),
            "both streams name 'lidar' as their sensor frame",
        ),
    ],
)
def test_streams_that_cannot_be_used(refused, new_bag, changed, message):
    assert message in refused("replay", new_bag(**changed), *TOPICS)


def test_what_is_not_there_is_named_with_what_is(refused, new_bag, tmp_path):
    assert f"no bag at {tmp_path / 'absent'}" in refused(
        "replay", tmp_path / "absent", *TOPICS
    )
    line = refused(
        "replay",
        new_bag(),
        "--parent-topic",
        "/odom",
        "--child-topic",
        CHILD_TOPIC,
    )
    assert "no topic /odom in " in line
    topics = [
        f"{topic} ({ODOMETRY}, 120 messages)"
        for topic in (CHILD_TOPIC, PARENT_TOPIC)
    ]
    assert " and ".join(topics) in line


def test_a_misspelt_name_is_answered_with_a_similar_one(
    refused, new_bag, tmp_path
):
    file = tmp_path / "camera.tum"
    file.write_text("0 0 0 0 0 0 0 1\n")
    line = refused("calibrate", tmp_path / "camra.tum", file)
    assert line.endswith("No such file or directory; did you mean camera.tum?")
    bag = Path(new_bag())
    line = refused("replay", bag.with_name(f"{bag.name}s"), *TOPICS)
    assert line.endswith(f"; did you mean {bag.name}?")
    line = refused(
        "replay",
        bag,
        "--parent-topic",
        "/lidar/odo",
        "--child-topic",
        CHILD_TOPIC,
    )
    assert f"; did you mean {PARENT_TOPIC}? The bag has" in line


def test_a_bag_without_an_obvious_pair_is_answered_with_a_command_that_runs(
    run, refused, tmp_path
):
    parent, child = drive()
    names = ("/lidar/odom", "/camera/odom", "/gnss/odom")
    streams = {
        name: (poses, ODOMETRY)
        for name, poses in zip(names, (parent, child, child), strict=True)
    }
    streams["/gnss/odom"] = (
        dataclasses.replace(child, sensor_frame="gnss"),
        ODOMETRY,
    )
    bag = tmp_path / "three bags"
    write_bag(bag, streams)
    line = refused("calibrate", bag)
    message, _, command = line.partition(". Run: ")
    assert (
        "error: 3 topics have poses: /lidar/odom (nav_msgs/msg/Odometry, 120 mess"
        in message
    )
    program, *arguments = shlex.split(command)
    assert program == "hand_eye_calib"
    assert arguments[:2] == ["calibrate", str(bag)]
    code, out, _ = run(*arguments)
    assert code == 0
    assert "camera in lidar" in out


@pytest.mark.parametrize(
    "command", [["calibrate"], ["check"], ["calibrate", "lidar.tum"]]
)
def test_a_file_that_is_given_twice_is_refused(run, command):
    code, out, err = run(*command, "camera.tum", "camera.tum")
    assert (code, out) == (2, "")
    assert (
        "error: camera.tum appears twice: pass one file for each sensor" in err
    )


def test_nan_is_left_out_and_counted_by_topic(run, new_bag):
    child = drive()[1]
    child.poses.setflags(write=True)
    child.poses[7, 1, 3] = np.nan
    code, _, err = run("replay", new_bag(child=child), *TOPICS)
    assert code == 0
    assert f"{CHILD_TOPIC}: 1 of 120 poses (0.8%) were left out: " in err
    assert "not finite" in err


# ---- the program around the commands


def test_the_node_gets_its_arguments_as_they_are(monkeypatch):
    seen = []
    monkeypatch.setattr(
        "hand_eye_calib.online.ros.node.main",
        lambda args: seen.append(args) or 5,
    )
    arguments = [
        "--ros-args",
        "-p",
        "method:=dnl",
        "-r",
        "parent_odom:=/lidar/odom",
    ]
    assert main(["calibrator", *arguments]) == 5
    assert main(["calibrator"]) == 5
    assert seen == [arguments, []]


def test_commands_that_need_ros_say_how_to_get_it(refused, monkeypatch):
    for module in [
        name
        for name in sys.modules
        if name.startswith("hand_eye_calib.online.ros")
    ]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "rclpy", None)
    line = refused("watch")
    assert (
        "this needs ROS 2's Python packages (rclpy is missing): source the setup file"
        in line
    )


def start(*arguments, stdout=subprocess.PIPE):
    return subprocess.Popen(
        [sys.executable, "-m", "hand_eye_calib", *map(str, arguments)],
        cwd=ROOT,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_process_ends_with_the_code(tmp_path):
    process = start("replay", tmp_path / "absent")
    out, err = process.communicate()
    assert (process.returncode, out) == (1, "")
    assert "Traceback" not in err


def test_interrupt_ends_quietly(tmp_path):
    process = start(
        "simulate", "--out", tmp_path / "runs", "--runs", 10_000, "--poses", 10
    )
    while not (tmp_path / "runs" / "run_00002").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert (process.returncode, out, err) == (130, "", "")


def test_a_reader_that_goes_away_is_no_error_and_files_are_written(
    tmp_path, new_bag
):
    readable, writable = os.pipe()
    os.close(readable)
    process = start(
        "replay", new_bag(), *TOPICS, "--out", tmp_path / "out", stdout=writable
    )
    lines = process.communicate()[1].splitlines()
    os.close(writable)
    assert (process.returncode, len(lines)) == (141, 2)
    assert all(
        line.startswith("hand_eye_calib: note: wrote ") for line in lines
    )
    assert (tmp_path / "out" / "report.html").exists()


def test_control_characters_in_names_do_not_reach_the_terminal(capsys):
    hostile = "cam\x1b[2Jera\nStatus: ok"
    print_result(
        as_lines(some_calibration(child_frame=hostile, warnings=("w\x1b[31m",)))
    )
    text = capsys.readouterr().out
    assert "\x1b" not in text
    assert "\ncam\\x1b[2Jera\\nStatus: ok in lidar" in text
    fail(hostile, 1)
    assert (
        capsys.readouterr().err
        == "hand_eye_calib: error: cam\\x1b[2Jera\\nStatus: ok\n"
    )
