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
from hand_eye_calib.core.base.errors import ConfigError, InputError, NotEnoughDataError
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
        return Trajectory(parent.stamps_ns + shift_ns, parent.poses), child
    return parent, Trajectory(child.stamps_ns - shift_ns, child.poses)


@pytest.mark.parametrize("offset_s", EPOCHS.values(), ids=EPOCHS)
@pytest.mark.parametrize(
    "options", [{"time_offset": "estimate"}, {}], ids=["estimate", "nothing"]
)
def test_the_offset_of_any_two_epochs_is_estimated(offset_s, options):
    result = hec.calibrate(*pair(offset_s), **options)
    assert result.time_offset_s == pytest.approx(offset_s, abs=2e-3)
    same_clock = hec.calibrate(*pair(0.0))
    assert_allclose(result.T_parent_child, same_clock.T_parent_child, atol=2e-3)
    codes = set(codes_of(result.findings))
    assert codes == (set() if options else {"time_offset"})
    expected = "USE" if options else "USE WITH CARE"
    assert result.verdict.value == expected


def test_an_offset_of_another_epoch_is_obeyed_and_read_back(tmp_path, capsys):
    offset_s = EPOCHS["unix and start of the computer"]
    files = write_pair(tmp_path, *pair(offset_s))
    out = tmp_path / "out"
    options = ["--time-offset", str(offset_s), "--out", str(out)]
    assert main(["calibrate", *map(str, files), *options]) == 0
    assert load_result(out / "extrinsic.yaml").time_offset_s == pytest.approx(
        offset_s, abs=1e-4
    )


def test_an_offset_that_is_twelve_seconds_off_names_the_way_on():
    parent, child = pair(EPOCHS["unix and start of the computer"])
    with pytest.raises(NotEnoughDataError, match="set time_offset to estimate"):
        hec.calibrate(parent, child[:100], time_offset=1.6e9, checks=False)


def test_an_offset_beyond_64_bits_is_one_line():
    _, child = pair(0.0)
    with pytest.raises(InputError, match="beyond 64 bits of nanoseconds"):
        child.shifted(9e9)
    with pytest.raises(ConfigError, match="time_offset must be at most 9200000000.0 s"):
        CalibratorConfig(time_offset=1e10)
    assert CalibratorConfig(time_offset=1.7e9).time_offset == 1.7e9


def figures_of_eight():
    """Poses of a vehicle whose turns repeat nearly every 14 s, ten a second."""
    seconds = np.arange(549) / 10.0
    sizes = 1.0 + 0.7 * np.sin(seconds / 9.0 + 0.3 * np.sin(seconds / 5.0))
    steps = np.zeros((549, 6))
    steps[:, 0] = 0.2
    steps[:, 3] = 0.004 * np.sin(seconds)
    steps[:, 4] = 0.004 * np.cos(1.3 * seconds)
    steps[:, 5] = 0.04 * sizes * np.sin(2.0 * np.pi * seconds / 14.0)
    return walked(se3.exp(steps))


@pytest.mark.parametrize("frozen", ["parent", "child"])
def test_a_stream_that_froze_does_not_hide_the_offset(frozen):
    """As long as it repeats its pose, its angular rate says nothing of the clock."""
    offset_s = EPOCHS["unix and start of the computer"]
    poses = figures_of_eight()
    parent = as_trajectory(disturbed(poses, 1, 0.002, 0.001))
    child = as_trajectory(disturbed(child_of(poses), 2, 0.002, 0.001)).shifted(
        -offset_s
    )
    streams = {"parent": parent, "child": child}
    held = streams[frozen].poses.copy()
    held[200:255] = held[200]
    streams[frozen] = Trajectory(streams[frozen].stamps_ns, held)
    result = hec.calibrate(**streams, time_offset="estimate")
    assert result.time_offset_s == pytest.approx(offset_s, abs=0.02)
    assert result.verdict.value == "DO NOT USE"
    freezes = [finding for finding in result.findings if finding.code == "frozen"]
    assert [(finding.stream, finding.severity.value) for finding in freezes] == [
        (frozen, "error")
    ]
