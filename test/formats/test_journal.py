import itertools
import json
import os

import numpy as np
import pytest
from motions import as_trajectory, child_of, wandering_poses
from motions import messages as messages_of
from numpy.testing import assert_allclose, assert_array_equal

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.engine.calibrator import (
    BufferLimits,
    Calibrator,
    Calibrators,
)
from hand_eye_calib.formats.journal import (
    JournalWriter,
    count_poses,
    has_session,
    keep_aside,
    read_journal,
    replay_journal,
)
from hand_eye_calib.online.live.journal import lock_directory

CONFIG = CalibratorConfig(reference="B3")
BOTH = {"parent": {}, "child": {}}


def messages(n_poses=60):
    poses = wandering_poses(n_poses)
    parent = as_trajectory(poses)
    child = as_trajectory(child_of(poses))
    both = zip(
        messages_of("parent", parent), messages_of("child", child), strict=True
    )
    return list(itertools.chain.from_iterable(both))


def record(writer, calibrator, sequence, flush_every=25):
    for count, message in enumerate(sequence, 1):
        if calibrator.add_pose(*message):
            writer.add_pose(*message)
        if count % flush_every == 0:
            writer.flush()


def resumed(directory, limits=None):
    calibrator = Calibrator(CONFIG, limits)
    journal = read_journal(directory)
    replay_journal(journal, directory, Calibrators(child=calibrator))
    return calibrator, journal


@pytest.mark.parametrize("n_poses", [60, 600])
def test_a_resumed_session_is_the_session(tmp_path, n_poses):
    # Pairs are made of 600 poses.
    limits = BufferLimits(capacity=400, pairing_starts=200)
    calibrator = Calibrator(CONFIG, limits)
    writer = JournalWriter(tmp_path / "journal", BOTH)
    calibrator.set_frame("parent", "lidar")
    writer.describe({"parent": {"frame": "lidar"}})
    record(writer, calibrator, messages(n_poses))
    writer.close()
    again, journal = resumed(tmp_path / "journal", limits)
    assert len(journal.stamps_ns) == 2 * n_poses
    assert again.snapshot().parent_frame == "lidar"
    assert again.statistics("child") == calibrator.statistics("child")
    for name, value in vars(calibrator.snapshot().pose_pairs).items():
        assert_array_equal(vars(again.snapshot().pose_pairs)[name], value)
    assert np.array_equal(
        again.estimate().T_parent_child, calibrator.estimate().T_parent_child
    )


def test_its_files_are_trajectories_that_every_program_reads(tmp_path):
    writer = JournalWriter(
        tmp_path, {"parent": {"topic": "/lidar"}, "child": {"topic": "/camera"}}
    )
    calibrator = Calibrator(CONFIG)
    record(writer, calibrator, messages())
    writer.close()
    parent, child = (
        hec.read_trajectory(tmp_path / f"{stream}.tum") for stream in BOTH
    )
    result = hec.calibrate(parent, child, method="dnl", reference="B3")
    expected = calibrator.snapshot().streams
    assert_array_equal(parent.stamps_ns, expected[0].stamps_ns)
    assert_allclose(child.poses, expected[1].poses, atol=1e-15)
    assert result.n_poses == 60
    first, *lines = (tmp_path / "parent.tum").read_text().splitlines()
    assert json.loads(first.removeprefix("# "))["topic"] == "/lidar"
    assert np.loadtxt(lines).shape == (60, 8)


def test_poses_are_read_in_the_order_in_which_they_came_whatever_their_clocks(
    tmp_path,
):
    writer = JournalWriter(tmp_path, BOTH)
    pose = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    for batch in range(3):
        for stream, offset in (("parent", 0), ("child", 10**12)):
            writer.add_pose(stream, offset + batch, *pose)
        writer.flush()
    writer.close()
    journal = read_journal(tmp_path)
    assert journal.streams.tolist() == ["parent", "child"] * 3
    assert journal.stamps_ns.tolist() == [
        0,
        10**12,
        1,
        10**12 + 1,
        2,
        10**12 + 2,
    ]


def test_a_session_goes_on_after_the_last_whole_line(tmp_path):
    calibrator = Calibrator(CONFIG)
    sequence = messages()
    writer = JournalWriter(tmp_path, BOTH)
    record(writer, calibrator, sequence[:60])
    writer.close()
    with (tmp_path / "child.tum").open("a") as file:
        file.write("1.5000")
    writer = JournalWriter(
        tmp_path, BOTH | {"child2": {}}, resumed=read_journal(tmp_path)
    )
    record(writer, calibrator, sequence[60:])
    writer.close()
    again, journal = resumed(tmp_path)
    assert (
        journal.whole_bytes["child"] == (tmp_path / "child.tum").stat().st_size
    )
    assert np.array_equal(
        again.estimate().T_parent_child, calibrator.estimate().T_parent_child
    )


def test_whatever_byte_the_file_ends_at_the_whole_lines_before_it_are_read(
    tmp_path,
):
    writer = JournalWriter(tmp_path, BOTH)
    record(writer, Calibrator(CONFIG), messages(4))
    writer.close()
    path = tmp_path / "child.tum"
    data = path.read_bytes()
    ends = [index + 1 for index, byte in enumerate(data) if byte == ord("\n")]
    for end in range(ends[0], len(data)):
        path.write_bytes(data[:end])
        journal = read_journal(tmp_path)
        whole = max(offset for offset in ends if offset <= end)
        assert journal.whole_bytes["child"] == whole
        expected = [
            line
            for line in data[:whole].splitlines()
            if not line.startswith(b"#")
        ]
        assert (journal.streams == "child").sum() == len(expected)


def test_a_line_that_cannot_be_read_ends_its_stream_before_it(tmp_path):
    writer = JournalWriter(tmp_path, BOTH)
    record(writer, Calibrator(CONFIG), messages(4))
    writer.close()
    path = tmp_path / "child.tum"
    *lines, _ = path.read_bytes().split(b"\n")
    wrong = (b"\0" * 80, b"1.5 0 0 0 0 0 0 1", b"x.000000001 0 0 0 0 0 0 1", b"9" * 70_000,
             b"99999999999.000000000 0 0 0 0 0 0 1", b"# {" + b"[" * 9000,
             b'# {"parent_poses": "7"}', b"1.000000001 0 0 0 0 0 0")  # fmt: skip
    for line in wrong:
        path.write_bytes(b"\n".join([*lines[:-2], line, *lines[-2:], b""]))
        journal = read_journal(tmp_path)
        assert (journal.streams == "child").sum() == 2, line[:40]
        assert journal.whole_bytes["child"] < path.stat().st_size - len(line)


def test_a_pose_that_the_engine_refuses_is_one_line(tmp_path):
    writer = JournalWriter(tmp_path, BOTH)
    writer.add_pose("parent", 1, (np.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    writer.close()
    with pytest.raises(
        InputError, match=r"cannot use the session journal .*not finite"
    ):
        resumed(tmp_path)


def test_what_is_no_journal_is_said(tmp_path):
    assert not has_session(tmp_path)
    with pytest.raises(InputError, match="no session journal in"):
        read_journal(tmp_path)
    for text, message in (("something else\n", "damaged from its first byte"),
                       ('# {"format": "hand_eye_calib/journal", "version": 3}\n',
                        "is of format version 3, this program reads 2")):  # fmt: skip
        (tmp_path / "parent.tum").write_text(text)
        with pytest.raises(InputError, match=message):
            read_journal(tmp_path)
        assert count_poses(tmp_path) is None


def test_a_file_that_was_replaced_is_not_written_to(tmp_path):
    writer = JournalWriter(tmp_path, BOTH)
    (tmp_path / "parent.tum").rename(tmp_path / "copy.tum")
    (tmp_path / "parent.tum").write_text("mine")
    writer.add_pose("parent", 1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with pytest.raises(OSError, match="another program has replaced its file"):
        writer.flush()
    assert (tmp_path / "parent.tum").read_text() == "mine"


def test_further_child_sensors_are_resumed_too(tmp_path):
    engines = Calibrators(child=Calibrator(CONFIG), child2=Calibrator(CONFIG))
    writer = JournalWriter(tmp_path, BOTH | {"child2": {}})
    for stream, *pose in messages():
        for name in [stream, "child2"] if stream == "child" else [stream]:
            writer.add_pose(name, *pose)
            engines.add_pose(name, *pose)
    writer.close()
    again = Calibrators(child=Calibrator(CONFIG), child2=Calibrator(CONFIG))
    replay_journal(read_journal(tmp_path), tmp_path, again)
    assert again["child2"].statistics("child").received == 60
    T = engines["child"].estimate().T_parent_child
    for engine in again.values():
        assert np.array_equal(engine.estimate().T_parent_child, T)


def test_the_lock_is_on_the_directory(tmp_path):
    lock = lock_directory(tmp_path)
    with pytest.raises(ConfigError, match="is in use by another calibrator"):
        lock_directory(tmp_path)
    assert not list(tmp_path.iterdir())
    os.close(lock)
    os.close(lock_directory(tmp_path))


MINE = "0.0 1.0 2.0 3.0 0.0 0.0 0.0 1.0\n"


@pytest.mark.parametrize("stream", ["parent", "child"])
def test_a_journal_empties_no_file_of_somebody_else(tmp_path, stream):
    mine = tmp_path / f"{stream}.tum"
    mine.write_text(MINE)
    with pytest.raises(
        OSError, match=f"{stream}.tum is no session journal; move it away"
    ):
        JournalWriter(tmp_path, BOTH)
    assert mine.read_text() == MINE


def test_a_journal_is_not_written_through_a_link(tmp_path):
    mine = tmp_path / "poses.tum"
    mine.write_text(MINE)
    directory = tmp_path / "journal"
    directory.mkdir()
    (directory / "child.tum").symlink_to(mine)
    with pytest.raises(OSError, match="child.tum is no session journal"):
        JournalWriter(directory, BOTH)
    assert mine.read_text() == MINE


def test_what_is_no_journal_is_kept_when_journals_are_moved_aside(tmp_path):
    (tmp_path / "journal.previous").mkdir()
    mine = tmp_path / "journal.previous" / "notes.txt"
    mine.write_text("mine")
    for _ in range(2):
        JournalWriter(tmp_path / "journal", BOTH).close()
        assert (
            keep_aside(tmp_path / "journal") == tmp_path / "journal.previous2"
        )
    assert mine.read_text() == "mine"
    assert count_poses(tmp_path / "journal.previous2") == 0
