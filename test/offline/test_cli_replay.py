"""``replay``: sources, listing and convergence."""

import dataclasses
import functools
import json

import numpy as np
import pytest
from bag_making import TF, path_message, tf_message, write_messages
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    disturbed,
    messages,
    wandering_poses,
)
from numpy.testing import assert_allclose

from hand_eye_calib.formats.bags.writer import write_bag
from hand_eye_calib.formats.journal import JournalWriter
from hand_eye_calib.offline.cli.bags import read_journal_of

ODOMETRY = "nav_msgs/msg/Odometry"
STREAMS = ["--parent-topic", "/a", "--child-topic", "/b"]
POSES = wandering_poses(100)
PARENT = as_trajectory(POSES, sensor_frame="lidar", world_frame="map")
CHILD = as_trajectory(
    disturbed(child_of(POSES), 1, 0.002, 0.001),
    sensor_frame="camera",
    world_frame="odom",
)


@pytest.fixture
def run(run):
    return functools.partial(run, "replay")


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "drive"
    write_bag(path, {"/a": (PARENT, ODOMETRY), "/b": (CHILD, ODOMETRY)})
    return path


def matrix(text):
    return np.array(json.loads(text)["T_parent_child"]["matrix"])


def write_session(directory, options, *recorded):
    """The journal of a node that has heard both trajectories."""
    streams = {"parent": (PARENT, "/a"), "child": (CHILD, "/b")}
    about = {
        stream: {
            "options": options,
            "given": recorded,
            "topic": topic,
            "frame": poses.sensor_frame,
        }
        for stream, (poses, topic) in streams.items()
    }
    writer = JournalWriter(directory, about)
    for stream, (trajectory, _) in streams.items():
        for message in messages(stream, trajectory):
            writer.add_pose(*message)
    writer.close()


@pytest.mark.parametrize("folder", ["live/journal", "live"])
def test_a_journal_gives_what_a_bag_gives_with_the_options_of_its_session(
    run, bag, tmp_path, folder
):
    write_session(
        tmp_path / "live" / "journal", {"method": "park", "reference": "B7"}
    )
    code, out, err = run(tmp_path / folder, "--reference", "B5", "--json")
    document = json.loads(out)
    assert (code, err) == (0, "")
    # Options on the command line override those of the session.
    assert (document["method"], document["reference"]) == (
        "park",
        "B5",
    )
    assert document["inputs"]["child"]["topic"] == "/b"
    assert document["inputs"]["journal"] == str(tmp_path / "live" / "journal")
    of_bag = run(
        bag, *STREAMS, "--method", "park", "--reference", "B5", "--json"
    )[1]
    assert np.array_equal(matrix(out), matrix(of_bag))


def test_what_was_set_in_a_session_counts_as_set_in_its_replay(tmp_path):
    of_old = {"prior.transform": ""}  # an option that is no longer there
    write_session(
        tmp_path, of_old | {"time_offset": 0.0, "scale": "none"}, "time_offset"
    )
    config = read_journal_of(tmp_path, {"reference": "B5"}).snapshot.config
    assert config.given == {"time_offset", "reference"}


def test_journals_are_recordings_of_their_own(run, bag, tmp_path, no_processes):
    write_session(tmp_path / "live" / "journal", {"reference": "B5"})
    code, out, err = run(
        tmp_path / "live", bag, "--reference", "B5", "--json", "--jobs", "1"
    )
    assert (
        "is a recording of its own; all are used as recordings of one rig"
        in err
    )
    assert (code, len(json.loads(out)["together"]["recordings"])) == (0, 2)


def test_what_does_not_go_with_a_journal(run, tmp_path):
    write_session(tmp_path, {})
    code, out, err = run(tmp_path, *STREAMS)
    assert (code, out) == (2, "")
    assert "has two streams; omit the options for topics" in err
    (tmp_path / "parent.tum").write_text('# {"options": [1]}')
    code, out, err = run(tmp_path)
    assert (code, out) == (1, "")
    assert "damaged from its first byte" in err


def test_frames_stand_for_topics(run, bag, tmp_path):
    messages = []
    for ns, parent, child in zip(
        PARENT.stamps_ns, PARENT.poses, CHILD.poses, strict=True
    ):
        both = [(ns, "map", "lidar", parent), (ns, "odom", "camera", child)]
        messages.append((ns, "/tf", TF, tf_message(both)))
    path = write_messages(tmp_path / "tf", messages)
    code, out, err = run(
        path,
        "--parent-topic",
        "map:lidar",
        "--child-topic",
        "odom:camera",
        "--json",
    )
    document = json.loads(out)
    assert (code, err) == (0, "")
    assert (document["parent_frame"], document["child_frame"]) == (
        "lidar",
        "camera",
    )
    assert document["inputs"]["child"]["topic"] == "transform odom:camera"
    assert_allclose(
        matrix(out), matrix(run(bag, *STREAMS, "--json")[1]), atol=1e-9
    )
    code, out, err = run(
        path, "--parent-topic", "map:lidar", "--child-topic", "odom:radar"
    )
    assert (code, out) == (1, "")
    assert (
        "no frame 'radar' in the bag's transforms; it has map:lidar, odom:camera"
        in err
    )


def test_a_path_and_a_topic_of_two_bags_together(run, bag, tmp_path):
    message = path_message(PARENT.stamps_ns, PARENT.poses)
    messages = [(PARENT.stamps_ns[-1], "/path", "nav_msgs/msg/Path", message)]
    path = write_messages(tmp_path / "path", messages)
    both = [
        "--parent-topic",
        "/path",
        "--child-topic",
        "/b",
        "--parent-frame",
        "lidar",
    ]
    code, out, _ = run(bag, path, *both, "--json")
    assert code == 0
    assert_allclose(
        matrix(out), matrix(run(bag, *STREAMS, "--json")[1]), atol=1e-9
    )


def parts_of(tmp_path, slices, later_s=0.0):
    """Bags of parts of the drive, all but the first so much later."""
    paths = []
    for number, numbers in enumerate(slices):
        paths.append(tmp_path / f"part_{number}")
        moved_ns = round(later_s * 1e9) * bool(number)
        streams = {
            topic: (
                dataclasses.replace(
                    trajectory, stamps_ns=trajectory.stamps_ns + moved_ns
                )[numbers],
                ODOMETRY,
            )
            for topic, trajectory in (("/a", PARENT), ("/b", CHILD))
        }
        write_bag(paths[-1], streams)
    return paths


def test_parts_that_continue_each_other_are_one_recording_in_any_order(
    run, bag, tmp_path
):
    parts = parts_of(tmp_path, [slice(0, 50), slice(50, 80), slice(80, 100)])
    whole = run(bag, *STREAMS, "--json")[1]
    for order in (parts, parts[::-1]):
        code, out, _ = run(*order, *STREAMS, "--json")
        assert code == 0
        assert np.array_equal(matrix(out), matrix(whole))


@pytest.mark.parametrize(
    ("later_s", "reason"),
    [
        (0.03, "both cover the same 9.9 s"),
        (3600, "there is a pause of 3590 s between them"),
    ],
)
@pytest.mark.usefixtures("no_processes")
def test_recordings_are_not_joined_but_give_one_result(
    run, tmp_path, later_s, reason
):
    paths = parts_of(tmp_path, 2 * [slice(0, 100)], later_s)
    code, out, err = run(*paths[::-1], *STREAMS, "--json", "--jobs", "1")
    assert f"are two recordings, not parts of one: {reason}" in err
    together = json.loads(out)["together"]
    names = {recording["name"] for recording in together["recordings"]}
    assert (code, names, together["kind"]) == (0, {"part_0", "part_1"}, "agree")
    assert_allclose(matrix(out), T_PARENT_CHILD, atol=5e-3)
    code, out, err = run(*paths, "--topics", "/a", "/b", "/a")
    assert (code, out) == (1, "")
    assert reason in err


def test_list_shows_topics_types_counts_rates_and_frames(run, tmp_path):
    static = tf_message([(0, "base", "lidar", np.eye(4))])
    write_messages(
        tmp_path / "tf", [(PARENT.stamps_ns[0], "/tf_static", TF, static)]
    )
    streams = {
        "/a": (PARENT, ODOMETRY),
        "/b": (CHILD, "geometry_msgs/msg/PoseStamped"),
    }
    write_bag(tmp_path / "drive", streams)
    code, out, err = run(tmp_path / "drive", tmp_path / "tf", "--list")
    assert (code, err) == (0, "")
    rows = [
        line.split()
        for line in out.splitlines()
        if line.strip().startswith("/")
    ]
    assert [
        "/a",
        ODOMETRY,
        "100",
        "10.0",
        "Hz",
        "poses",
        PARENT.sensor_frame,
    ] in rows
    assert [
        "/b",
        "geometry_msgs/msg/PoseStamped",
        "100",
        "10.0",
        "Hz",
        "poses",
    ] in rows
    assert ["/tf_static", TF, "1", "frames", "base:lidar"] in rows
    code, out, err = run(
        tmp_path / "drive", tmp_path / "tf", "--list", "--json"
    )
    document = json.loads(out)
    assert (code, err, document["warnings"]) == (0, "", [])
    assert document["duration_s"] == pytest.approx(9.9)
    measured = {
        "count": 100,
        "rate_hz": pytest.approx(10),
        "frames": [PARENT.sensor_frame],
    }
    measured |= {"measures": "", "quantity": "poses"}
    named = {"name": "/a", "type": ODOMETRY, "is_usable": True}
    assert document["topics"][0] == measured | named
