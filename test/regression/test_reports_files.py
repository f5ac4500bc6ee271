"""Trajectory files rebuilt from public bug reports give the truth, or one line with the cause."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from report_inputs import calibrated, reports_folder

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.offline.cli.main import main

# Translation (m) and roll, pitch, yaw (deg) of the child in the parent.
ON_CAMERA = ([0.42, -0.11, 0.25], [-88.0, 3.0, -92.0])
ON_LIDAR = ([-1.2, 0.3, -0.4], [0.5, -0.8, 2.0])

RIGHT = [
    ("p.tum", "nan.tum", ON_CAMERA),
    ("p.tum", "empty.csv", ON_CAMERA),
    ("p.tum", "date_dash_13.txt", ON_CAMERA),
    ("p.tum", "lamar_nocov.txt", ON_CAMERA),
    ("p.tum", "plotjuggler.csv", ON_CAMERA),
    ("p.tum", "r_then_t_13.txt", ON_CAMERA),
    ("lidar.tum", "ecef_pos_enu_quat.tum", ON_LIDAR),
]
# With the offset of the clocks: of GPS time, of the start of a recording, of a week.
RIGHT_WITH_OFFSET = [
    ("lidar.tum", "week_sow.csv", ON_LIDAR, -18.0),
    ("lidar.tum", "sow.csv", ON_LIDAR, 1_699_747_182.0),
    ("lidar.tum", "ie_geo.txt", ON_LIDAR, 1_699_747_182.0),
    ("p.tum", "pos_log.txt", ON_CAMERA, 1_700_000_000.215),
    ("cam.tum", "motive.csv", ON_CAMERA, 1_700_000_000.215),
]
CAUSES = [
    ("p.tum", "sci.tum", "the timestamps have whole seconds only"),
    ("p.tum", "r_then_t.txt", "the poses have no stamps"),
]


@pytest.fixture
def run_files(capsys):
    """Runs calibrate on two files of the reports; exit code, document and what is said."""
    folder = reports_folder("files")

    def run(parent, child, *options):
        files = [str(folder / parent), str(folder / child)]
        return calibrated(capsys, *files, *options)

    return run


def assert_is(document, truth):
    translation, rpy_deg = truth
    T = np.array(document["T_parent_child"]["matrix"])
    R = se3.rotation_from_rpy(np.radians([rpy_deg]))[0]
    assert document["verdict"] != "DO_NOT_USE"
    assert_allclose(T[:3, 3], translation, atol=0.02)
    assert np.degrees(se3.rotation_angle(R.T @ T[:3, :3])) < 0.2


@pytest.mark.parametrize(("parent", "child", "truth"), RIGHT)
def test_the_truth_is_found(run_files, parent, child, truth):
    code, document, _ = run_files(parent, child)
    assert code == 0
    assert_is(document, truth)


@pytest.mark.parametrize(
    ("parent", "child", "truth", "offset_s"), RIGHT_WITH_OFFSET
)
def test_the_truth_is_found_with_clocks_of_other_epochs(
    run_files, parent, child, truth, offset_s
):
    code, document, _ = run_files(parent, child, "--time-offset", "estimate")
    assert code == 0
    assert_is(document, truth)
    assert document["time_offset_s"] == pytest.approx(offset_s, abs=0.01)


def test_motions_in_place_of_poses_are_named(run_files):
    _, document, _ = run_files("p.tum", "relative.tum")
    assert document["verdict"] == "DO_NOT_USE"
    assert "motions from pose to pose" in document["reasons"][0]["sentence"]


@pytest.mark.parametrize(("parent", "child", "cause"), CAUSES)
def test_the_cause_is_one_line(run_files, parent, child, cause):
    code, document, output = run_files(parent, child)
    assert (code, document) == (1, None)
    *_, last = output.splitlines()
    assert cause in last
    assert child in last


def test_check_reads_both_streams_as_calibrate_does(capsys):
    folder = reports_folder("files")
    assert (
        main(["check", str(folder / "p.tum"), str(folder / "motive.csv")]) == 1
    )
    out = capsys.readouterr().out
    # Before the choice between both readings, the check proposed to invert both streams.
    assert out.startswith(
        "DO NOT USE these streams unchanged: calibrate with --time-offset estimate."
    )
    assert "inverse" not in out
