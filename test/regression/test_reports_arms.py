"""Arms of public bug reports: the right answer, or a refusal that names the cause.

The inputs are rebuilt from reports, with known truth; without the folder the tests are skipped.
"""

import numpy as np
import pytest
from report_inputs import calibrated, reports_folder

from hand_eye_calib.core.geometry import se3


def pose(position, rpy_deg):
    rotation = se3.rotation_from_rpy(np.radians(rpy_deg))
    return se3.from_rotation_translation(rotation, np.array(position))


IN_HAND = pose((0.06, -0.03, 0.09), (2.0, -3.0, 88.0))
BESIDE = pose((1.1, 0.2, 0.8), (-150.0, 4.0, 85.0))

# Errors of twenty stops with noise of 1 mm and 0.1 deg; five standard deviations.
WITHIN_M = 0.005
WITHIN_DEG = 0.3


@pytest.fixture
def arms():
    return reports_folder("arms")


def run(arms, capsys, command):
    """Exit code, document (None after an error) and what was written to stderr."""
    words = [
        str(arms / word) if (arms / word).exists() else word
        for word in command.split()
    ]
    return calibrated(capsys, *words)


def off(document, truth):
    """Errors of the position (m) and of the rotation (deg)."""
    estimate = np.array(document["T_parent_child"]["matrix"])
    error = se3.inverse(estimate) @ truth
    angle_deg = float(np.degrees(se3.rotation_angle(error[:3, :3])))
    return float(np.linalg.norm(error[:3, 3])), angle_deg


def told(document):
    """Everything that the result tells in words."""
    findings = [finding["what"] for finding in document["findings"]]
    return " ".join([*findings, *document["warnings"]])


# Command, truth, frames of the result, and what has to be said.
RIGHT = [
    ("own.npz", IN_HAND, "hand", "read as a camera on the hand"),
    ("eye_to.npz", BESIDE, "base", "read as a camera beside the robot"),
    ("q7w.npz", IN_HAND, "hand", "w x y z"),
    (
        "robot_mm.npz",
        IN_HAND,
        "hand",
        "parent stream's lengths are millimetres",
    ),
    ("track_mm.npz", IN_HAND, "hand", "child stream's lengths are millimetres"),
    ("s_to_2.0.npz --scale estimate", BESIDE, "base", "read as a camera"),
    ("s_in_2.0.npz --scale estimate", IN_HAND, "hand", "read as a camera"),
    ("s_in_0.5.npz --scale estimate", IN_HAND, "hand", "read as a camera"),
    ("opencv.npz", IN_HAND, "hand", "read as a camera on the hand"),
    (
        "H.npy C.npy --order none --pair-by row --child-invert poses",
        IN_HAND,
        "parent",
        "",
    ),
    ("H.npy C.npy --order none --child-invert poses", IN_HAND, "parent", ""),
    (
        "ur.csv camT.csv --order none",
        IN_HAND,
        "parent",
        "both hold inverse poses",
    ),
    (
        "inv_both.npz --parent-invert poses --child-invert poses",
        IN_HAND,
        "hand",
        "",
    ),
    ("inv_track.npz --child-invert poses", IN_HAND, "hand", ""),
]


@pytest.mark.parametrize(("command", "truth", "frame", "text"), RIGHT)
def test_the_answer_is_the_truth_and_says_what_was_repaired(
    arms, capsys, command, truth, frame, text
):
    code, document, _ = run(arms, capsys, command)
    assert code == 0
    off_m, off_deg = off(document, truth)
    assert off_m < WITHIN_M
    assert off_deg < WITHIN_DEG
    assert document["parent_frame"] == frame
    assert text in told(document)
    assert document["verdict"] in ("USE", "USE_WITH_CARE")


@pytest.mark.parametrize("command", ["own.npz", "eye_to.npz"])
def test_clean_samples_have_no_findings(arms, capsys, command):
    _, document, _ = run(arms, capsys, command)
    assert document["findings"] == []
    assert document["verdict"] == "USE"


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("shifted.npz", "moved down by 1 row"),
        ("inv_both.npz", "one side or both have inverse poses"),
        (
            "robot_mm.npz --scale 1000",
            "the parent stream's lengths are millimetres",
        ),
        ("H.npy C.npy --order none", "one of the two files has inverse poses"),
    ],
)
def test_what_contradicts_is_refused_with_its_cause(
    arms, capsys, command, text
):
    code, document, _ = run(arms, capsys, command)
    assert code == 3
    assert document["verdict"] == "DO_NOT_USE"
    assert text in document["headline"]


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("T.npz", "the matrix is transposed"),
        ("unequal.npz", "20 poses of the robot, 18 of the target"),
    ],
)
def test_what_cannot_be_read_is_one_line(arms, capsys, command, text):
    code, document, err = run(arms, capsys, command)
    assert (code, document) == (1, None)
    assert text in err
    assert len(err.splitlines()) == 1


def test_both_readings_of_inverse_poses_are_stated(arms, capsys):
    _, document, _ = run(arms, capsys, "inv_track.npz")
    assert "read as a camera beside the robot" in told(document)
    assert "parent_invert poses (robot), child_invert poses (target)" in told(
        document
    )


def test_rotations_alone_have_no_position(arms, capsys):
    code, document, _ = run(arms, capsys, "rot0.csv rotc0.tum --order none")
    assert code == 0
    assert "x, y and z are out of reach" in document["headline"]
    assert off(document, IN_HAND)[1] < WITHIN_DEG
    assert document["T_parent_child"]["translation"] == [None, None, None]


@pytest.mark.parametrize(
    "name", ["s_to_2.0.npz", "s_in_2.0.npz", "s_in_0.5.npz"]
)
def test_a_target_of_another_size_is_refused_and_its_scale_named(
    arms, capsys, name
):
    code, document, _ = run(arms, capsys, name)
    assert code == 3
    assert "multiplied by" in document["findings"][0]["what"]
    assert document["findings"][0]["options"] == {"scale": "estimate"}
