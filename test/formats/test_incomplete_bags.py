"""Bags that are not whole: a killed recorder, a split that was not copied."""

import hashlib
import shutil
import sqlite3

import pytest
from bag_making import ODOMETRY, POSE_STAMPED, storage_file
from motions import as_trajectory, child_of, wandering_poses

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.writer import write_bag

POSES = wandering_poses(120)
STREAMS = {
    "/a": (as_trajectory(POSES, sensor_frame="lidar"), ODOMETRY),
    "/b": (as_trajectory(child_of(POSES), sensor_frame="camera"), POSE_STAMPED),
}


def killed_recording(folder, journal_mode, kept_in_file):
    """Copy a .db3 as a recorder in this journal mode leaves it if it is killed."""
    write_bag(folder / "whole", STREAMS, "sqlite3")
    file = storage_file(folder / "whole")
    database = sqlite3.connect(file, isolation_level=None)
    rows = database.execute("SELECT * FROM messages ORDER BY id").fetchall()
    database.execute("DELETE FROM messages WHERE id > ?", (kept_in_file,))
    database.execute("VACUUM")
    database.execute(f"PRAGMA journal_mode={journal_mode}")
    database.execute("PRAGMA wal_autocheckpoint=0")
    # In the middle of a transaction that is on the disk.
    if journal_mode == "DELETE":
        database.execute("PRAGMA cache_size=1")
        database.execute("BEGIN")
    else:
        rows = rows[kept_in_file:]
    for row in rows:
        marks = ", ".join("?" * len(row))
        if journal_mode == "DELETE":
            database.execute(
                "UPDATE messages SET data = zeroblob(60000) WHERE id = ?",
                row[:1],
            )
        else:
            database.execute(f"INSERT INTO messages VALUES ({marks})", row)
    killed = folder / "killed"
    killed.mkdir()
    for path in file.parent.iterdir():
        if path.name.startswith(file.name) and not path.name.endswith("-shm"):
            shutil.copyfile(path, killed / path.name)
    database.close()
    return killed


def state_of(folder):
    """Return name, content and time of every file."""
    return {
        path.name: (
            hashlib.sha256(path.read_bytes()).hexdigest(),
            path.stat().st_mtime_ns,
        )
        for path in folder.iterdir()
    }


@pytest.mark.parametrize("kept_in_file", [40, 0])
@pytest.mark.parametrize("as_file", [True, False])
def test_messages_in_the_wal_of_a_killed_recorder_are_read(
    tmp_path, kept_in_file, as_file
):
    killed = killed_recording(tmp_path, "WAL", kept_in_file)
    assert [path.name[-4:] for path in sorted(killed.iterdir())] == [
        ".db3",
        "-wal",
    ]
    before = state_of(killed)
    with PoseBag(storage_file(killed) if as_file else killed) as bag:
        counts = {topic.name: topic.count for topic in bag.topics.values()}
        poses = bag.poses("/a", "/b")
        files = [path.name for path in bag.files]
    assert counts == {"/a": 120, "/b": 120}
    assert len(poses) == 240
    assert files == sorted(before)
    assert state_of(killed) == before


def test_a_folder_that_cannot_be_written_is_read_with_its_wal(tmp_path):
    killed = killed_recording(tmp_path, "WAL", 40)
    killed.chmod(0o500)
    try:
        with PoseBag(killed) as bag:
            n_poses = len(bag.poses("/a", "/b"))
    finally:
        killed.chmod(0o700)
    assert n_poses == 240


def test_an_unfinished_transaction_is_undone_in_a_copy(tmp_path):
    killed = killed_recording(tmp_path, "DELETE", 240)
    assert [path.name[-8:] for path in sorted(killed.iterdir())][1:] == [
        "-journal"
    ]
    before = state_of(killed)
    with PoseBag(killed) as bag:
        n_poses = len(bag.poses("/a", "/b"))
    assert n_poses == 240
    assert state_of(killed) == before


def test_no_room_for_the_copy_is_said_in_a_line(tmp_path, monkeypatch):
    killed = killed_recording(tmp_path, "WAL", 40)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(
        InputError, match=r"newest messages are in .*-wal.*No space.*set TMPDIR"
    ):
        PoseBag(killed)


# ---- listed files that are missing

METADATA = """\
rosbag2_bagfile_information:
  version: {version}
  message_count: 480
  relative_file_paths: [{names}]
"""
COUNTED = """\
  files:
    - {{path: {0}, message_count: 240}}
    - {{path: {1}, message_count: {2}}}
"""


def split_bag(folder, storage, with_counts, prefix=""):
    """Write a bag whose metadata lists a second file that is not there."""
    write_bag(folder / "split", STREAMS, storage)
    file = storage_file(folder / "split")
    missing = f"split_1{file.suffix}"
    names = [f"{prefix}{file.name}", f"{prefix}{missing}"]
    text = METADATA.format(
        version=9 if with_counts else 4, names=", ".join(names)
    )
    if with_counts:
        text += COUNTED.format(*names, 120)
    (folder / "split" / "metadata.yaml").write_text(text)
    return folder / "split", missing


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize(
    ("with_counts", "prefix", "lost"),
    [
        (True, "", "120 of 360 messages (33%)"),
        (False, "split/", "240 of 480 messages (50%)"),
    ],
)
def test_a_missing_split_is_named_with_its_share(
    tmp_path, storage, with_counts, prefix, lost
):
    path, missing = split_bag(tmp_path, storage, with_counts, prefix)
    with PoseBag(path) as bag:
        n_poses = len(bag.poses("/a", "/b"))
        warnings = bag.warnings
    assert n_poses == 240
    assert warnings == [
        f"{path}: metadata.yaml lists {missing}, which is missing: {lost} are not read; copy the "
        "whole bag"
    ]


def test_a_bag_of_which_only_the_metadata_was_copied_names_its_files(tmp_path):
    path, _ = split_bag(tmp_path, "mcap", with_counts=True)
    storage_file(path).unlink()
    with pytest.raises(
        InputError,
        match=r"lists split\.mcap and split_1\.mcap, and no such file",
    ):
        PoseBag(path)


@pytest.mark.parametrize(
    "text", ["", "a: [", "rosbag2_bagfile_information: 3", "x: 1"]
)
def test_metadata_that_cannot_be_read_changes_nothing(tmp_path, text):
    path, _ = split_bag(tmp_path, "mcap", with_counts=True)
    (path / "metadata.yaml").write_text(text)
    with PoseBag(path) as bag:
        assert len(bag.poses("/a", "/b")) == 240
        assert bag.warnings == []
