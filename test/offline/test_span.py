"""Parts of recordings: from files, bags and Python alike."""

import dataclasses
import json

import motions
import numpy as np
import pytest

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.checks.streams import check_frozen
from hand_eye_calib.core.geometry.span import WHOLE, Span
from hand_eye_calib.formats.bags.writer import write_bag
from hand_eye_calib.formats.trajectory_files.writing import write_trajectory
from hand_eye_calib.offline.cli.main import main

STAMP_S = 1_700_000_000
SECONDS = np.arange(0.0, 100.0)
LATER = np.arange(10.0, 120.0)


def ns(seconds):
    return np.round(np.asarray(seconds) * 1e9).astype(np.int64)


@pytest.mark.parametrize(
    ("span", "streams", "expected"),
    [
        # Streams that overlap: the recording starts with the later one.
        (Span(5.0, 20.0), (SECONDS, LATER), [(15.0, 30.0), (15.0, 30.0)]),
        (Span(None, 20.0), (SECONDS, LATER), [(0.0, 30.0), (10.0, 30.0)]),
        (Span(5.0), (SECONDS, LATER), [(15.0, 99.0), (15.0, 119.0)]),
        # Clocks that differ: each stream counts from its own first pose.
        (
            Span(5.0, 20.0),
            (SECONDS, LATER + STAMP_S),
            [(5.0, 20.0), (STAMP_S + 15.0, STAMP_S + 30.0)],
        ),
        # Stamps.
        (
            Span(STAMP_S + 20.0, STAMP_S + 30.0),
            (SECONDS + STAMP_S, LATER + STAMP_S),
            [(STAMP_S + 20.0, STAMP_S + 30.0)] * 2,
        ),
        (
            Span(STAMP_S + 20.0, 30.0),
            (SECONDS + STAMP_S, LATER + STAMP_S),
            [(STAMP_S + 20.0, STAMP_S + 40.0)] * 2,
        ),
    ],
)
def test_rows_of_a_span(span, streams, expected):
    stamps_ns = [ns(stream) for stream in streams]
    masks = span.rows(stamps_ns, ("a", "b"))
    limits = [
        (stream[mask][0], stream[mask][-1])
        for stream, mask in zip(streams, masks, strict=True)
    ]
    assert limits == expected


@pytest.mark.parametrize(
    ("start", "end", "message"),
    [
        (-1.0, None, "`start` must be seconds after the start"),
        (None, "soon", "`end` must be seconds .*; got 'soon'"),
        (float("nan"), None, "got nan"),
        (10, 10, "`start` 10 must be smaller than `end` 10"),
        (STAMP_S + 1, STAMP_S, "must be smaller"),
    ],
)
def test_a_span_that_is_none_is_one_line(start, end, message):
    with pytest.raises(ConfigError, match=message):
        Span.of(start, end)


def test_a_span_without_poses_names_the_stream_and_its_end():
    with pytest.raises(
        InputError, match=r"b has no poses from `start` 150 s: it ends 109\.0 s"
    ):
        Span(150.0).rows([ns(np.arange(10.0, 300.0)), ns(LATER)], ("a", "b"))


@pytest.fixture(scope="module")
def drive():
    """Two streams of a minute, ten poses a second."""
    streams = motions.noisy_pair(
        motions.wandering_poses(600, 3), 4, 0.001, 0.001
    )
    names = ("lidar", "odom"), ("camera", "map")
    return [
        dataclasses.replace(stream, sensor_frame=sensor, world_frame=world)
        for stream, (sensor, world) in zip(streams, names, strict=True)
    ]


@pytest.fixture(scope="module")
def expected(drive):
    """Result of the poses from 6 s to 36 s."""
    parent, child = (stream[60:361] for stream in drive)
    return hec.calibrate(parent, child, checks=False).T_parent_child


def matrix_of(capsys):
    return np.array(
        json.loads(capsys.readouterr().out)["T_parent_child"]["matrix"]
    )


def span_of(drive):
    """Start and end (s) of the rows 60 to 360."""
    step_s = drive[0].interval_s
    return round(60 * step_s, 3), round(360 * step_s, 3)


def test_python_files_and_bags_use_the_same_part(
    drive, expected, tmp_path, capsys
):
    start, end = span_of(drive)
    result = hec.calibrate(*drive, start=start, end=end, checks=False)
    assert result.T_parent_child == pytest.approx(expected, abs=1e-9)

    paths = []
    for name, stream in zip(("parent", "child"), drive, strict=True):
        paths.append(str(tmp_path / f"{name}.tum"))
        write_trajectory(paths[-1], stream)
    limits = ["--start", str(start), "--end", str(end), "--json"]
    main(["calibrate", *paths, *limits])
    of_files = matrix_of(capsys)

    write_bag(
        tmp_path / "bag",
        {
            "/parent": (drive[0], "nav_msgs/msg/Odometry"),
            "/child": (drive[1], "nav_msgs/msg/Odometry"),
        },
    )
    topics = ["--parent-topic", "/parent", "--child-topic", "/child"]
    main(["calibrate", str(tmp_path / "bag"), *topics, *limits])
    of_bag = matrix_of(capsys)
    whole = hec.calibrate(*drive, checks=False).T_parent_child

    assert of_files == pytest.approx(of_bag, abs=1e-6)
    assert np.abs(of_files - expected).max() < np.abs(whole - expected).max()

    main(["check", str(tmp_path / "bag"), *topics, *limits])
    streams = json.loads(capsys.readouterr().out)["streams"]
    assert [stream["poses"] for stream in streams.values()] == [301, 301]


def test_a_batch_uses_the_part_and_repeats_it_for_another(
    drive, tmp_path, capsys
):
    bag = tmp_path / "bag"
    streams = zip(("/parent", "/child"), drive, strict=True)
    write_bag(
        bag,
        {topic: (poses, "nav_msgs/msg/Odometry") for topic, poses in streams},
    )
    command = ["batch", str(bag), "--no-report", "--jobs", "1"]
    command += ["--out", str(tmp_path / "out"), "--json"]
    command += ["--parent-topic", "/parent", "--child-topic", "/child"]
    durations_s = []
    for end in ("20", "20", "30"):
        main([*command, "--start", "5", "--end", end])
        printed = capsys.readouterr()
        (result,) = json.loads(printed.out)["results"]
        stream = result["inputs"]["parent"]
        stamps_ns = stream["last_stamp_ns"] - stream["first_stamp_ns"]
        is_reused = "are done already" in printed.err
        durations_s.append((round(stamps_ns * 1e-9), is_reused))
    assert durations_s == [(15, False), (15, True), (25, False)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("sample:arm.yaml",), "--start has no meaning for stops"),
        (
            ("{parent}", "{parent}2", "--pair-by", "row"),
            "--start and --end are times, and --pair-by row uses none",
        ),
        (("{journal}",), "a journal is used as a whole; for a part, calibrate"),
    ],
)
def test_inputs_without_times_refuse_a_span(
    drive, tmp_path, capsys, arguments, message
):
    journal = tmp_path / "journal"
    journal.mkdir()
    for name in ("parent.tum", "parent.tum2", "child.tum"):
        write_trajectory(journal / name, drive[0])
    places = {"parent": journal / "parent.tum", "journal": journal}
    filled = [argument.format(**places) for argument in arguments]
    assert main(["calibrate", *filled, "--start", "3"]) != 0
    assert message in capsys.readouterr().err


def test_the_whole_recording_is_no_span():
    assert not WHOLE
    assert Span.of() == WHOLE
    assert Span.of(0.0)


@pytest.mark.parametrize(
    ("rows", "advice"),
    [
        ([(1200, 2000)], "calibrate with end 120, the longest part"),
        ([(0, 800)], "calibrate with start 80, the longest part"),
        (
            [(0, 400), (1400, 2000)],
            "calibrate with start 40 and end 140, the longest part",
        ),
        (
            [(50 + at, 200 + at) for at in range(0, 2000, 200)],
            "record again, because no part of 10 s is",
        ),
    ],
)
def test_frozen_streams_name_the_longest_part_without_the_fault(rows, advice):
    parent, child = motions.noisy_pair(
        motions.wandering_poses(2000, 0), 1, 0.001, 0.001
    )
    poses = child.poses.copy()
    for first, last in rows:
        poses[first:last] = poses[first]
    stuck = dataclasses.replace(child, poses=poses)

    (found,) = check_frozen(parent, stuck)

    assert found.values["longest"] == advice
