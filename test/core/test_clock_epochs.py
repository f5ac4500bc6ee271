"""Clocks that count from other epochs: unix time, start of the computer, GPS week."""

import numpy as np
import pytest
from findings import codes_of
from motions import (
    as_trajectory,
    child_of,
    disturbed,
    walked,
    wandering_poses,
    write_pair,
)
from numpy.testing import assert_allclose

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    NotEnoughDataError,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.offline.cli.main import main

# Seconds to add to the child's stamps.
EPOCHS = {
    "unix and start of the computer": 1_699_999_988.2151,
    "start of the computer and unix": -1_699_999_988.2151,
    "unix and GPS week": 1_699_747_181.999,
    "unix and GPS time": 315_964_782.0,
    "unix and 1904": -2_082_844_800.25,
    "GPS time and UTC": -18.0,
}


def pair(offset_s):
    """Two streams of one rig; the parent's clock is unix time unless the child's is."""
    poses = wandering_poses(400)
    parent = as_trajectory(disturbed(poses, 1, 0.002, 0.001))
    child = as_trajectory(disturbed(child_of(poses), 2, 0.002, 0.001))
    shift_ns = round(offset_s * 1e9)
    if offset_s < -1e6:
        parent_ns = parent.stamps_ns + shift_ns
        parent = Trajectory(parent_ns, parent.poses)
    else:
        child_ns = child.stamps_ns - shift_ns
        child = Trajectory(child_ns, child.poses)
    return parent, child


@pytest.mark.parametrize("offset_s", EPOCHS.values(), ids=EPOCHS)
@pytest.mark.parametrize(
    "options", [{"time_offset": "estimate"}, {}], ids=["estimate", "nothing"]
)
def test_the_offset_of_any_two_epochs_is_estimated(offset_s, options):
    expected_codes = [] if options else ["time_offset"]
    expected_verdict = "USE" if options else "USE WITH CARE"
    same_clock = hec.calibrate(*pair(0.0))

    result = hec.calibrate(*pair(offset_s), **options)

    assert result.time_offset_s == pytest.approx(offset_s, abs=2e-3)
    assert_allclose(result.T_parent_child, same_clock.T_parent_child, atol=2e-3)
    assert codes_of(result.findings) == expected_codes
    assert result.verdict.value == expected_verdict


def test_an_offset_of_another_epoch_is_obeyed_and_read_back(tmp_path, capsys):
    offset_s = EPOCHS["unix and start of the computer"]
    parent, child = pair(offset_s)
    files = write_pair(tmp_path, parent, child)
    out = tmp_path / "out"
    options = ["--time-offset", str(offset_s), "--out", str(out)]

    code = main(["calibrate", *files, *options])

    result = load_result(out / "extrinsic.yaml")
    assert code == 0
    assert result.time_offset_s == pytest.approx(offset_s, abs=1e-4)


def test_an_offset_that_is_twelve_seconds_off_names_the_way_on():
    parent, child = pair(EPOCHS["unix and start of the computer"])
    start_of_child = child[:100]
    with pytest.raises(NotEnoughDataError, match="set time_offset to estimate"):
        hec.calibrate(parent, start_of_child, time_offset=1.6e9, checks=False)


def test_an_offset_beyond_64_bits_is_one_line():
    _, child = pair(0.0)
    with pytest.raises(InputError, match="beyond 64 bits of nanoseconds"):
        child.shifted(9e9)
    with pytest.raises(
        ConfigError, match="time_offset must be at most 9200000000.0 s"
    ):
        CalibratorConfig(time_offset=1e10)
    assert CalibratorConfig(time_offset=1.7e9).time_offset == 1.7e9


def figures_of_eight():
    """Poses of a vehicle whose turns repeat nearly every 14 s, ten a second."""
    seconds = np.arange(549) / 10.0
    wobble = 0.3 * np.sin(seconds / 5.0)
    sizes = 1.0 + 0.7 * np.sin(seconds / 9.0 + wobble)
    phases = 2.0 * np.pi * seconds / 14.0
    steps = np.zeros((549, 6))
    steps[:, 0] = 0.2
    steps[:, 3] = 0.004 * np.sin(seconds)
    steps[:, 4] = 0.004 * np.cos(1.3 * seconds)
    steps[:, 5] = 0.04 * sizes * np.sin(phases)
    return walked(se3.exp(steps))


@pytest.mark.parametrize("frozen", ["parent", "child"])
def test_a_stream_that_froze_does_not_hide_the_offset(frozen):
    """As long as it repeats its pose, its angular rate says nothing of the clock."""
    offset_s = EPOCHS["unix and start of the computer"]
    poses = figures_of_eight()
    child_poses = disturbed(child_of(poses), 2, 0.002, 0.001)
    streams = {
        "parent": as_trajectory(disturbed(poses, 1, 0.002, 0.001)),
        "child": as_trajectory(child_poses).shifted(-offset_s),
    }
    stamps_ns = streams[frozen].stamps_ns
    frozen_poses = streams[frozen].poses.copy()
    frozen_poses[200:255] = frozen_poses[200]
    streams[frozen] = Trajectory(stamps_ns, frozen_poses)

    result = hec.calibrate(**streams, time_offset="estimate")

    assert result.time_offset_s == pytest.approx(offset_s, abs=0.02)
    assert result.verdict.value == "DO NOT USE"
    (freeze,) = (
        finding for finding in result.findings if finding.code == "frozen"
    )
    assert freeze.stream == frozen
    assert freeze.severity.value == "error"
