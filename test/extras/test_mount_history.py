"""Digests of monitored sessions, and the history of a mount that ``compare`` makes of them."""

import dataclasses
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.extras.mount.compare import compare_digests
from hand_eye_calib.extras.mount.digest import (
    read_digest,
    read_digests,
    write_digest,
)
from hand_eye_calib.extras.mount.history import History, find_changes
from hand_eye_calib.extras.mount.monitor import MountMonitor

MOUNT = se3.exp(np.array([0.4, -0.2, 0.7, 0.3, -1.2, 0.6]))
START_NS = 1_700_000_000_000_000_000
WEEK_NS = 7 * 86_400 * 1_000_000_000


def forklift(duration_s, seed, rate_hz=5.0, mount=MOUNT):
    """Poses of a forklift on a floor with some slope, and of its sensor with noise."""
    rng = np.random.default_rng(seed)
    s = np.arange(0.0, duration_s, 1.0 / rate_hz)
    turns = np.stack(
        [
            0.02 * np.sin(0.31 * s + 1.0),
            0.03 * np.sin(0.23 * s),
            1.5 * np.sin(0.11 * s) + 0.4 * np.sin(0.43 * s),
        ],
        axis=1,
    )
    yaw = turns[:, 2]
    steps = (
        1.2
        / rate_hz
        * np.stack([np.cos(yaw), np.sin(yaw), 0.02 * np.sin(0.2 * s)], axis=1)
    )
    parent = se3.from_rotation_translation(
        se3.rotation_exp(turns), np.cumsum(steps, axis=0)
    )
    noise = rng.normal(size=(2, len(s), 6)) * np.repeat([0.003, 0.0008], 3)
    parent_measured = parent @ se3.exp(noise[0])
    child = parent @ mount @ se3.exp(noise[1])
    stamps_ns = START_NS + np.round(s * 1e9).astype(np.int64)
    return PosePairs(stamps_ns, parent_measured, child)


@pytest.fixture(scope="module")
def session():
    """Digest of a session of a forklift, ten minutes long."""
    monitor = MountMonitor(MOUNT, np.zeros((6, 6)))
    monitor.add(forklift(600.0, seed=1))
    digest = monitor.digest("lidar", "camera")
    assert digest is not None
    return digest


def weeks(session, seed, shift=None, since=60, n_weeks=100):
    """Digests of sessions a week apart, drawn from the evidence of one session.

    The offset of a session has the common-mode error of the digest; its score has the variance of
    the evidence.
    """
    rng = np.random.default_rng(seed)
    H = session.evidence[:, :6]
    root = np.linalg.cholesky(H + 1e-9 * np.trace(H) * np.eye(6))
    wander = np.linalg.cholesky(session.wander)
    constant = np.linalg.cholesky(session.covariance) @ rng.normal(size=6)
    digests = []
    for week in range(n_weeks):
        offset = constant + wander @ rng.normal(size=6)
        if shift is not None and week >= since:
            offset = offset + shift
        S = H @ offset + root @ rng.normal(size=6)
        start_ns = START_NS + week * WEEK_NS
        evidence = np.concatenate([H, S[:, None]], axis=1)
        changes = {
            "start_ns": start_ns,
            "end_ns": start_ns,
            "evidence": evidence,
        }
        digests.append(dataclasses.replace(session, **changes))
    return digests


def about_parent(axis, degrees):
    """Shift (6,) in the child's frame of a rotation about an axis of the parent."""
    turn = np.zeros(3)
    turn["xyz".index(axis)] = np.radians(degrees)
    return np.r_[np.zeros(3), MOUNT[:3, :3].T @ turn]


def arguments(*paths, json=False, installed=None, fleet=None):
    results = [str(path) for path in paths]
    return SimpleNamespace(
        results=results, json=json, installed=installed, fleet=fleet
    )


def test_a_digest_is_small_and_read_as_it_was_written(session, tmp_path):
    path = write_digest(tmp_path, session)
    assert path.parent == tmp_path / "digests"
    assert path.stat().st_size < 10_000
    loaded = read_digest(path)
    for name in ("installed", "covariance", "wander", "evidence"):
        assert_array_equal(getattr(loaded, name), getattr(session, name))
    assert (loaded.child_frame, loaded.seconds, loaded.day) == (
        "camera",
        session.seconds,
        session.day,
    )


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_shift_of_300_mdeg_in_week_60_is_found_within_three_sessions(
    session, axis
):
    for seed in range(7):
        digests = weeks(session, 100 + seed, about_parent(axis, 0.3))
        first = next(n for n in range(1, 101) if find_changes(digests[:n]))
        assert 60 < first <= 63, (axis, seed, first)
        changes = find_changes(digests)
        assert [changepoint.index for changepoint in changes] == [60]
        row = changes[0].shift.axes[
            {"x": "roll", "y": "pitch", "z": "yaw"}[axis]
        ]
        assert row.difference == pytest.approx(
            np.radians(0.3), abs=3.3 * row.sigma
        )


def test_no_false_alarm_in_20_histories_of_100_weeks(session):
    for seed in range(20):
        digests = weeks(session, seed)
        assert not any(find_changes(digests[:n]) for n in range(1, 101)), seed


def test_sessions_of_the_monitor_itself_show_when_the_mount_moved():
    turned = MOUNT @ se3.exp(about_parent("z", 0.5))
    digests = []
    for week, mount in enumerate([MOUNT] * 4 + [turned] * 2):
        monitor = MountMonitor(MOUNT, np.zeros((6, 6)))
        monitor.add(forklift(400.0, seed=10 + week, mount=mount))
        digest = monitor.digest("lidar", "camera")
        digests.append(
            dataclasses.replace(digest, start_ns=START_NS + week * WEEK_NS)
        )
    assert find_changes(digests[:4]) == []
    (changepoint,) = find_changes(digests)
    assert changepoint.index == 4
    assert changepoint.shift.axes["yaw"].difference == pytest.approx(
        np.radians(0.5), abs=0.002
    )


def test_two_changes_are_found(session):
    digests = weeks(session, 3, about_parent("z", 0.5), since=30, n_weeks=60)
    back = weeks(session, 3, None, n_weeks=60)
    digests[45:] = back[45:]
    assert [changepoint.index for changepoint in find_changes(digests)] == [
        30,
        45,
    ]


def test_compare_prints_the_history_of_a_folder(session, tmp_path, capsys):
    for digest in weeks(
        session, 5, about_parent("z", 0.5), since=6, n_weeks=10
    ):
        write_digest(tmp_path, digest)
    code = compare_digests(arguments(tmp_path))
    lines = capsys.readouterr().out.splitlines()
    assert code == 4
    assert lines[0].startswith(
        "Mount of camera on lidar: moved before 2023-12-26 22:13: "
    )
    assert "(10 sessions)" in lines[0]
    assert (
        len([line for line in lines if line.startswith("  -- moved before")])
        == 1
    )
    assert len(lines) == 1 + 1 + 10 + 1
    assert compare_digests(arguments(tmp_path, json=True)) == 4
    document = json.loads(capsys.readouterr().out)
    assert len(document["sessions"]) == 10
    assert [change["session"] for change in document["changes"]] == [
        "2023-12-26 22:13"
    ]
    with pytest.raises(ConfigError, match="omit --with"):
        compare_digests(arguments(tmp_path, installed="robot.urdf"))


def knocked(session):
    """Digest of a session in which the sensor is turned about z by 1.5 deg after 400 s."""
    monitor = MountMonitor(MOUNT, np.zeros((6, 6)))
    pairs = forklift(600.0, seed=2)
    is_later = pairs.stamps_ns >= START_NS + 400_000_000_000
    child = pairs.Ts_cw_c.copy()
    child[is_later] = child[is_later] @ se3.exp(about_parent("z", 1.5))
    monitor.add(PosePairs(pairs.stamps_ns, pairs.Ts_pw_p, child))
    digest = monitor.digest("lidar", "camera")
    # Of the same mount as the other sessions: their covariances are those of one drive.
    return dataclasses.replace(
        digest, covariance=session.covariance, wander=session.wander
    )


def test_a_session_with_an_alarm_is_divided_at_the_shift(session):
    digest = knocked(session)
    since_s = (digest.since_ns - START_NS) * 1e-9
    assert since_s == pytest.approx(400.0, abs=10.0)
    before, since = digest.parts()
    assert (before.alarm, since.alarm) == ("", digest.alarm)
    assert before.start_ns == digest.start_ns
    assert before.end_ns == since.start_ns == digest.since_ns
    assert before.seconds + since.seconds == digest.seconds
    assert_allclose(before.evidence + since.evidence, digest.evidence)
    offsets = History.of([digest]).offsets
    assert len(offsets) == 2
    assert abs(offsets[0].axes["yaw"].difference) < np.radians(0.2)
    row = offsets[1].axes["yaw"]
    assert row.difference == pytest.approx(np.radians(1.5), abs=3.3 * row.sigma)


def test_a_mount_that_had_moved_before_the_session_has_one_part():
    monitor = MountMonitor(MOUNT, np.zeros((6, 6)))
    pairs = forklift(600.0, seed=3)
    child = pairs.Ts_cw_c @ se3.exp(about_parent("z", 1.5))
    monitor.add(PosePairs(pairs.stamps_ns, pairs.Ts_pw_p, child))
    digest = monitor.digest("lidar", "camera")
    assert digest.alarm
    assert digest.parts() == [digest]
    assert_array_equal(digest.evidence_since, digest.evidence)


def test_the_row_of_a_vehicle_has_the_time_of_its_shift(
    session, tmp_path, capsys
):
    others = [
        dataclasses.replace(digest, start_ns=digest.start_ns - 5 * WEEK_NS)
        for digest in weeks(session, 5, n_weeks=4)
    ]
    digest = knocked(session)
    for item in (*others, digest):
        write_digest(tmp_path, item)
    assert compare_digests(arguments(tmp_path)) == 4
    lines = capsys.readouterr().out.splitlines()
    shifted_day = digest.parts()[1].day
    assert shifted_day > digest.day
    assert f": moved at {shifted_day}: " in lines[0]
    assert lines[0].endswith("(5 sessions)")
    # The session has a row before the shift and one since it.
    assert lines[-3].startswith(f"  {digest.day}")
    assert lines[-2].startswith(f"  -- moved at {shifted_day}: ")
    assert lines[-1].startswith(f"  {shifted_day}")
    document = History.of([*others, digest]).document()
    assert len(document["sessions"]) == 5
    assert [*document["alarms"]] == [shifted_day]


def test_an_alarm_of_a_session_is_printed_and_is_no_good_exit(
    session, tmp_path, capsys
):
    *others, last = weeks(session, 5, np.zeros(6), since=6, n_weeks=4)
    for digest in (
        *others,
        dataclasses.replace(last, alarm="about z by 1.5 deg"),
    ):
        write_digest(tmp_path, digest)
    assert compare_digests(arguments(tmp_path)) == 4
    lines = capsys.readouterr().out.splitlines()
    assert f"alarm at {last.day}: about z by 1.5 deg" in lines[0]
    assert lines[-2] == f"  -- alarm at {last.day}: about z by 1.5 deg"
    assert compare_digests(arguments(tmp_path, json=True)) == 4
    alarms = json.loads(capsys.readouterr().out)["alarms"]
    assert alarms == {last.day: "about z by 1.5 deg"}


def test_an_alarm_that_repeats_an_earlier_shift_is_no_new_event(session):
    digests = weeks(session, 912, about_parent("z", 0.6), since=3, n_weeks=8)
    digests[6] = dataclasses.replace(digests[6], alarm="about z by 0.6 deg")
    history = History.of(digests)
    assert [event.index for event in history.events] == [3]
    digests[1] = dataclasses.replace(digests[1], alarm="about z by 0.2 deg")
    kinds = [event.is_change for event in History.of(digests).events]
    assert kinds == [False, True]


def test_other_files_are_left_to_compare_and_unusable_digests_are_named(
    session, tmp_path
):
    other = tmp_path / "extrinsic.yaml"
    other.write_text("a: 1\n")
    assert compare_digests(arguments(other)) is None
    path = write_digest(tmp_path, session)
    path.write_text(path.read_text().replace('"seconds"', '"minutes"'))
    with pytest.raises(InputError, match="is no usable digest"):
        read_digest(path)
    moved = dataclasses.replace(
        session, installed=np.eye(4), start_ns=START_NS + WEEK_NS
    )
    write_digest(tmp_path / "b", session)
    write_digest(tmp_path / "b", moved)
    with pytest.raises(
        InputError, match="the installed transform changed before 2023-11-21"
    ):
        read_digests([tmp_path / "b"])


def write_fleet(session, folder):
    """Write the digests of three forklifts: one moved in week 60, one had an alarm, one is well."""
    shifts = {
        "forklift_1": None,
        "forklift_2": about_parent("z", 0.3),
        "forklift_3": None,
    }
    for seed, (vehicle, shift) in enumerate(shifts.items(), start=910):
        digests = weeks(session, seed, shift)
        if vehicle == "forklift_3":
            digests[-1] = dataclasses.replace(
                digests[-1], alarm="about z by 1.5 deg"
            )
        for digest in digests:
            write_digest(folder / vehicle, digest)
    return [folder / vehicle for vehicle in shifts]


def test_the_page_of_a_fleet_has_the_history_of_each_vehicle(
    session, tmp_path, capsys
):
    vehicles = write_fleet(session, tmp_path)
    page = tmp_path / "fleet.html"
    assert compare_digests(arguments(*vehicles, fleet=page)) == 4
    moved_week = dataclasses.replace(
        session, start_ns=START_NS + 60 * WEEK_NS
    ).day
    first, second, third = capsys.readouterr().out.splitlines()
    assert (
        first
        == "forklift_1: Mount of camera on lidar: no change in 100 sessions"
    )
    assert f"moved before {moved_week}" in second
    assert "alarm at" in third
    html = page.read_text()
    assert "<h1>2 of 3 mounts to check</h1>" in html
    # The newest event comes first, and the vehicle that is well comes last.
    order = re.findall(r'<th scope="row">(forklift_\d)</th>', html)
    assert order == ["forklift_3", "forklift_2", "forklift_1"]
    assert html.count('<figure class="card"') == 3
    assert f"<p>moved before {moved_week}: " in html
    assert compare_digests(arguments(vehicles[0], fleet=page, json=True)) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["forklift_1"]["changes"] == []
    assert "<h1>No mount moved</h1>" in page.read_text()


def test_the_offset_of_a_mount_becomes_more_precise_until_a_change(session):
    history = History.of(weeks(session, 911, about_parent("z", 0.3)))
    sigmas = [offset.axes["yaw"].sigma for offset in history.offsets]
    assert sigmas[59] < 0.5 * sigmas[0]
    assert sigmas[60] == pytest.approx(sigmas[0])
    assert sigmas[-1] < 0.5 * sigmas[60]


def test_a_page_of_a_fleet_needs_digests_of_every_vehicle(session, tmp_path):
    write_digest(tmp_path / "a", session)
    (tmp_path / "b").mkdir()
    with pytest.raises(
        ConfigError, match="--fleet needs digests.*b has none: the node writes"
    ):
        compare_digests(
            arguments(
                tmp_path / "a", tmp_path / "b", fleet=tmp_path / "page.html"
            )
        )
    assert not (tmp_path / "page.html").exists()
    with pytest.raises(
        ConfigError,
        match="no digests: .*digests has none.* with more than 120 s of motion",
    ):
        compare_digests(arguments(tmp_path / "b" / "digests"))
