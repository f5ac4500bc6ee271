"""The studies of repeats and of drives unlike the paper's, on drives of our own."""

import csv
import dataclasses
import re

import numpy as np
import pytest
from motions import T_PARENT_CHILD, as_trajectory, child_of, disturbed, wandering_poses
from published_data import data_folder

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from reproduction import repeats, unlike
from reproduction.command import main
from reproduction.recordings import Recording, Rig
from reproduction.writing import put_into_page


def recording(seed, noise=0.004):
    parent = wandering_poses(400, seed)
    child = disturbed(child_of(parent), seed, noise, noise)
    return Recording(as_trajectory(parent), as_trajectory(child))


def rig(*drives):
    options = {"time_offset": "estimate", "scale": "auto"}
    return Rig(name="ours", recordings=dict(enumerate(drives)), options=options)


def test_ratios_of_right_sigmas_lie_in_the_band():
    ratios = []
    for seed in range(5):
        ratios += repeats.axis_ratios("ours", rig(recording(seed)), "adaptive")
    assert {ratio.axis for ratio in ratios} == {"x", "y", "z", "roll", "pitch", "yaw"}
    assert {ratio.freedom for ratio in ratios} == {3}
    pooled = np.sqrt(np.mean([ratio.ratio**2 for ratio in ratios]))
    assert 0.6 < pooled < 1.4
    low, high = repeats.band(3)
    assert np.mean([low < ratio.ratio < high for ratio in ratios]) > 0.8


def test_drives_are_repeats_of_each_other_and_a_changed_mount_shows():
    still = rig(recording(0), recording(1))
    shifted = dataclasses.replace(
        recording(1),
        child=as_trajectory(
            child_of(wandering_poses(400, 1), T_PARENT_CHILD @ se3.exp([0.3, 0, 0, 0, 0, 0]))
        ),
    )
    by_axis = [
        {ratio.axis: ratio for ratio in repeats.axis_ratios("ours", drives, "dnlo B10")}
        for drives in (still, rig(recording(0), shifted))
    ]
    assert {ratio.freedom for found in by_axis for ratio in found.values()} == {1}
    assert by_axis[0]["x"].ratio < 3
    assert max(ratio.ratio for ratio in by_axis[1].values()) > 10


def test_parts_share_no_child_pose_and_cover_them_all():
    whole = recording(0)
    for count in (2, 3):
        parts = whole.parts(count, 0.0)
        stamps = np.concatenate([part.child.stamps_ns for part in parts])
        assert len(parts) == count
        assert len(np.unique(stamps)) == len(whole.child)
        assert len(stamps) - len(whole.child) < count


def test_band_is_that_of_chi_square():
    # chi2 of two degrees of freedom is exponential: its quantiles are -2 ln(1 - p).
    np.testing.assert_allclose(repeats.band(2), np.sqrt(-np.log([0.975, 0.025])), rtol=1e-9)


@pytest.mark.parametrize(
    ("error", "of_thirds", "of_others", "said"),
    [
        (0.02, [0.0, 0.02, 0.04], [0.02, 0.02], ""),
        (0.2, [-0.2, 0.2, 0.6], [0.2, 0.21], "scatter of the thirds"),
        (0.2, [0.19, 0.2, 0.21], [-0.1, 0.3], "depends on the reference"),
        (0.2, [0.19, 0.2, 0.21], [0.19, 0.21], "ground truth"),
    ],
)
def test_reasons_of_large_z_scores(error, of_thirds, of_others, said):
    reason = repeats.reason(error, 0.01, np.array(of_thirds), np.array(of_others))
    assert said in reason
    assert bool(reason) == bool(said)


def test_sets_that_are_absent_are_named(tmp_path):
    assert repeats.recorded_sets(tmp_path) == ({}, ["valimaki2023", "zxl19", "asl_tango_easy"])


def test_every_set_of_the_study_is_among_the_rigs():
    sets, absent = repeats.recorded_sets(data_folder())
    assert absent == []
    assert list(sets) == [
        *("kitti_short", "kitti_long", "zxl19"),
        *("tango C<-M", "tango M<-N", "tango N<-C"),
    ]
    assert [len(found.recordings) for found in sets.values()] == [1, 1, 3, 1, 1, 1]


@pytest.mark.parametrize("scenario", unlike.SCENARIOS)
def test_scenarios_have_the_errors_they_claim(scenario):
    source = unlike.UnlikeSource(seed=1, runs=1)
    (case,) = source.cases(scenario, None)
    (again,) = source.cases(scenario, None)
    np.testing.assert_array_equal(case.child.poses, again.child.poses)
    # The child's world in the parent's is constant but for the errors.
    Ts_pw_cw = case.parent.poses @ case.T_parent_child @ se3.inverse(case.child.poses)
    wander = se3.log(se3.inverse(Ts_pw_cw[:1]) @ Ts_pw_cw)
    assert 1e-3 < np.abs(wander).max() < 50.0
    motion = se3.log(se3.inverse(case.parent.poses[:1]) @ case.parent.poses)
    assert np.linalg.norm(motion, axis=1).max() > 0.5


def test_commands_are_told_which_data_they_need(tmp_path, capsys):
    assert main(["repeats", "--data", "simulated", "--out", str(tmp_path)]) == 2
    assert "--data published" in capsys.readouterr().err


def test_a_page_must_have_the_marks_of_the_study(tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("no marks")
    with pytest.raises(
        InputError, match="has no lines <!-- unlike: begin --> and <!-- unlike: end"
    ):
        put_into_page(page, "unlike", "| table |")
    with pytest.raises(InputError, match="absent.md: No such file"):
        put_into_page(tmp_path / "absent.md", "unlike", "| table |")
    assert page.read_text() == "no marks"
    assert main(["fig4", "--data", "simulated", "--page", str(page)]) == 2
    assert (
        "--page is for adaptive, repeats, unlike, certificate, faults; got fig4"
        in capsys.readouterr().err
    )


def test_unlike_writes_and_prints_its_table(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(unlike, "SCENARIOS", {"handheld": unlike.SCENARIOS["handheld"]})
    page = tmp_path / "page.md"
    page.write_text("# Ours\n\n<!-- unlike: begin -->\nold\n<!-- unlike: end -->\n\nThe rest.\n")
    command = ["unlike", "--data", "simulated", "--runs", "2", "--jobs", "1"]
    assert main([*command, "--out", str(tmp_path), "--page", str(page)]) == 0
    assert "| handheld |" in capsys.readouterr().out
    text = page.read_text()
    assert text.startswith("# Ours\n\n<!-- unlike: begin -->\n\nMedians over 2 drives")
    assert "old" not in text
    assert re.search(r"\| handheld \|.*\n\n<!-- unlike: end -->\n\nThe rest\.\n$", text)
    with open(tmp_path / "unlike.csv", encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert float(row["adaptive: translation (m)"]) < 0.05
