import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from motions import as_trajectory, child_of, wandering_poses

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.engine.pose_buffer import BufferLimits
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.journal import JournalWriter, has_session, read_journal
from hand_eye_calib.ros.session_journal import resume, takers, whole_state

CONFIG = CalibratorConfig(reference="B3")


def messages(n_poses=60):
    poses = wandering_poses(n_poses)
    for parent, child in zip(
        *(_rows(as_trajectory(each)) for each in (poses, child_of(poses))), strict=True
    ):
        yield ("parent", *parent)
        yield ("child", *child)


def _rows(trajectory):
    quats = se3.to_quat_xyzw(trajectory.poses).tolist()
    return zip(
        trajectory.stamps_ns.tolist(), trajectory.poses[:, :3, 3].tolist(), quats, strict=True
    )


def record(writer, calibrator, sequence):
    for message in sequence:
        if calibrator.add_pose(*message):
            writer.add_pose(*message)


def resumed(directory):
    checkpoint, events, lost_bytes = read_journal(directory)
    calibrator = Calibrator(CONFIG)
    calibrator.restore(checkpoint)
    for kind, *event in events:
        calibrator.add_pose(*event) if kind == "pose" else calibrator.set_frame(*event)
    return calibrator, len(events), lost_bytes


def test_a_resumed_session_is_the_session(tmp_path):
    calibrator = Calibrator(CONFIG)
    writer = JournalWriter(tmp_path / "journal", calibrator.state())
    calibrator.set_frame("parent", "lidar")
    writer.set_frame("parent", "lidar")
    record(writer, calibrator, messages())
    writer.close()
    again, n_events, lost_bytes = resumed(tmp_path / "journal")
    assert (n_events, lost_bytes) == (121, 0)
    assert np.array_equal(again.estimate().T_parent_child, calibrator.estimate().T_parent_child)
    assert again.snapshot().parent_frame == "lidar"
    assert again.statistics("child") == calibrator.statistics("child")


def test_the_engine_state_goes_round_after_pairs_were_made():
    limits = BufferLimits(capacity=50)
    calibrator = Calibrator(CONFIG, limits)
    sequence = list(messages(150))
    for message in sequence[:200]:
        calibrator.add_pose(*message)
    again = Calibrator(CONFIG, limits)
    again.restore(calibrator.state())
    for each in (calibrator, again):
        for message in sequence[200:]:
            each.add_pose(*message)
    assert np.array_equal(
        again.snapshot().pose_pairs().stamps_ns, calibrator.snapshot().pose_pairs().stamps_ns
    )
    assert np.array_equal(again.estimate().T_parent_child, calibrator.estimate().T_parent_child)
    assert again.statistics("parent") == calibrator.statistics("parent")


def test_a_new_segment_replaces_the_old_ones(tmp_path):
    calibrator = Calibrator(CONFIG)
    writer = JournalWriter(tmp_path, calibrator.state(), segment_bytes=20_000)
    rotations = 0
    for message in messages(400):
        record(writer, calibrator, [message])
        if writer.is_full:
            writer.rotate(calibrator.state())
            rotations += 1
    writer.close()
    assert rotations > 0
    assert len(list(tmp_path.iterdir())) == 1
    again, _, _ = resumed(tmp_path)
    assert np.array_equal(again.estimate().T_parent_child, calibrator.estimate().T_parent_child)


def test_whatever_byte_the_file_ends_at_the_whole_records_before_it_are_read(tmp_path):
    calibrator = Calibrator(CONFIG)
    writer = JournalWriter(tmp_path, calibrator.state())
    beginning = (tmp_path / "session-000001.journal").stat().st_size
    record(writer, calibrator, messages(4))
    writer.close()
    path = tmp_path / "session-000001.journal"
    data = path.read_bytes()
    for end in range(beginning, len(data)):
        path.write_bytes(data[:end])
        _, events, lost_bytes = read_journal(tmp_path)
        assert len(events) == (end - beginning) // ((len(data) - beginning) // 8)
        assert lost_bytes == (end - beginning) % ((len(data) - beginning) // 8)


def test_a_damaged_record_ends_the_session_before_it(tmp_path):
    calibrator = Calibrator(CONFIG)
    writer = JournalWriter(tmp_path, calibrator.state())
    record(writer, calibrator, messages(4))
    writer.close()
    path = tmp_path / "session-000001.journal"
    data = path.read_bytes()
    record_size = 9 + 65
    for position in range(len(data) - 8 * record_size, len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        _, events, _ = read_journal(tmp_path)
        assert len(events) <= (position - (len(data) - 8 * record_size)) // record_size


def test_what_is_no_journal_is_said(tmp_path):
    assert not has_session(tmp_path)
    with pytest.raises(InputError, match="no session journal in"):
        read_journal(tmp_path)
    (tmp_path / "session-000001.journal").write_bytes(b"something else")
    with pytest.raises(InputError, match="damaged from its first byte"):
        read_journal(tmp_path)


def test_a_half_written_new_segment_leaves_the_old_one_in_force(tmp_path):
    calibrator = Calibrator(CONFIG)
    writer = JournalWriter(tmp_path, calibrator.state())
    record(writer, calibrator, messages(20))
    writer.close()
    (tmp_path / "session-000002.tmp").write_bytes(b"hand_eye")
    assert resumed(tmp_path)[1] == 40


def test_a_journal_renamed_while_it_is_looked_for_is_no_error(tmp_path):
    journal = tmp_path / "journal"
    journal.mkdir()
    (journal / "session-000001.journal").write_bytes(b"")
    rename = "import os, sys\nwhile True:\n    os.rename(sys.argv[1], sys.argv[1] + 'x')\n"
    rename += "    os.rename(sys.argv[1] + 'x', sys.argv[1])\n"
    with subprocess.Popen([sys.executable, "-c", rename, journal]) as process:
        try:
            answers = {has_session(journal) for _ in range(20_000)}
        finally:
            process.kill()
    assert True in answers


def test_kill_at_any_moment_costs_only_what_was_not_flushed(tmp_path):
    """A child process journals with small segments and reports each flush; it is killed at moments
    of its own making.
    """
    program = """
import sys
sys.path[:0] = sys.argv[3:]
from test_journal import CONFIG, messages
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.engine.pose_buffer import BufferLimits
from hand_eye_calib.io.journal import JournalWriter
calibrator = Calibrator(CONFIG)
writer = JournalWriter(sys.argv[1], calibrator.state(), segment_bytes=30_000)
sequence = list(messages(4000))
print("ready", flush=True)
for count, message in enumerate(sequence, 1):
    calibrator.add_pose(*message)
    writer.add_pose(*message)
    if count % 10 == 0:
        writer.flush()
        print(count, flush=True)
    if writer.is_full:
        writer.rotate(calibrator.state())
"""
    random = np.random.default_rng(0)
    folders = [os.path.dirname(__file__), os.path.dirname(os.path.dirname(__file__))]
    for attempt in range(20):
        directory = tmp_path / str(attempt)
        command = [sys.executable, "-c", program, str(directory), "-", *folders]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            flushed = 0
            for line in process.stdout:
                if line.strip() != "ready":
                    flushed = int(line)
                if flushed >= random.integers(10, 4000):
                    process.send_signal(signal.SIGKILL)
                    break
            # what was still in the pipe was flushed too
            for line in process.stdout:
                if line.strip().isdigit():
                    flushed = int(line)
        calibrator, _, _ = resumed(directory)
        recovered = (
            calibrator.statistics("parent").received + calibrator.statistics("child").received
        )
        assert flushed <= recovered <= flushed + 10


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("parent.stamps_ns", lambda _: np.array(5)),
        ("parent.stamps_ns", lambda array: array[::-1]),
        ("parent.stamps_ns", lambda array: array.astype(float)),
        ("child.poses", lambda array: array[:-1]),
        ("child.poses", lambda array: array * np.nan),
        ("child.frame", lambda _: np.array(["a", "b"])),
        ("child.statistics", lambda array: array - 10**6),
        ("child.statistics", lambda _: None),
        ("kept.Ts_pw_p", lambda _: np.ones((0, 3, 3))),
        ("kept.stamps_ns", lambda _: np.array([3, 2])),
        ("base", lambda _: np.array(7)),
        ("unknown.part", lambda _: np.array(7)),
        ("offset.unknown", lambda _: np.array(7)),
    ],
)
def test_a_state_that_no_calibrator_gave_is_refused(name, change):
    calibrator = Calibrator(CONFIG)
    for message in messages():
        calibrator.add_pose(*message)
    state = calibrator.state()
    changed = state | {name: change(state.get(name))}
    changed = {key: value for key, value in changed.items() if value is not None}
    again = Calibrator(CONFIG)
    again.add_pose(*next(messages()))
    with pytest.raises(InputError, match="the saved state"):
        again.restore(changed)
    assert again.statistics("parent").received == 1
    again.restore(state)
    assert again.statistics("parent") == calibrator.statistics("parent")


def test_further_child_sensors_are_resumed_too(tmp_path):
    calibrator, others = Calibrator(CONFIG), {"child2": Calibrator(CONFIG)}
    writer = JournalWriter(tmp_path / "journal", whole_state(calibrator, others))
    for number, (stream, *pose) in enumerate(messages()):
        if number == 60:  # half of it is in a checkpoint
            writer.rotate(whole_state(calibrator, others))
        for name in [stream, "child2"] if stream == "child" else [stream]:
            writer.add_pose(name, *pose)
            for own_stream, each in takers(name, calibrator, others):
                each.add_pose(own_stream, *pose)
    writer.close()
    again = {"child2": Calibrator(CONFIG)}
    assert resume(tmp_path / "journal", Calibrator(CONFIG), again) == 120
    assert again["child2"].statistics("child").received == 60
    T = calibrator.estimate().T_parent_child
    assert np.array_equal(again["child2"].estimate().T_parent_child, T)
    assert resume(tmp_path / "journal", Calibrator(CONFIG)) == 120
