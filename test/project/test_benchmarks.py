"""The benchmark suite fails when it should. How fast anything is, is not tested here."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

from suite import baseline, data, rows  # noqa: E402
from suite.measuring import Row  # noqa: E402

from hand_eye_calib.core.geometry import se3  # noqa: E402
from hand_eye_calib.core.solvers.registry import Method  # noqa: E402

ROWS = [
    Row("dnlo fast", 443, 0.01, 0.1, 5, 2.0),
    Row("dnlo ipopt", 443, 1.0, 0.1, 5, 2.0),
    Row("opencv, the fastest", 443, 2.0, 0.1, 2),
]
MEMORY = {443: (50, 150, 80)}
KNOWN = {
    "dnlo ipopt / dnlo fast, 443": 120.0,
    "opencv, the fastest / dnlo fast, 443": 200.0,
    "memory of the pairs / of solving them, 443": 0.8,
}


@pytest.mark.parametrize(
    ("measured", "failures"),
    [
        (ROWS, []),
        (ROWS[:2], []),  # only OpenCV may be missing
        (ROWS[::2], ["dnlo ipopt / dnlo fast, 443: ratio is missing"]),
        (
            [dataclasses.replace(ROWS[0], seconds=0.026), *ROWS[1:]],
            [
                "dnlo ipopt / dnlo fast, 443: 38.5, below a third of the baseline's 120"
            ],
        ),
        (
            [dataclasses.replace(ROWS[0], objective=2.0001), *ROWS[1:]],
            ["dnlo fast, 443: objective 2.0001 is above ipopt's 2"],
        ),
    ],
)
def test_a_row_that_falls_short_is_a_failure(measured, failures):
    assert (
        baseline.failures(measured, baseline.ratios(measured, MEMORY), KNOWN)
        == failures
    )


def test_baseline_covers_both_sources_with_equal_ratios():
    baseline = json.loads(
        (BENCHMARKS / "baseline.json").read_text(encoding="utf-8")
    )
    assert baseline["published"].keys() == baseline["simulated"].keys()
    ratios = {
        "dnlo ipopt / dnlo fast, 443",
        "opencv, the fastest / dnlo fast, 2338",
    }
    assert ratios <= baseline["published"].keys()


def test_simulated_drives_have_a_known_answer_and_as_many_pairs_as_asked_for():
    drive = data.simulated_drive(data.SHORT + 5)
    assert len(drive.pairs) == data.SHORT
    T_parent_child = Method("dnlo").solve(drive.pairs).T_parent_child
    assert_allclose(T_parent_child, drive.T_parent_child, atol=0.05)


@pytest.mark.parametrize("method", rows.OPENCV_METHODS)
def test_opencv_is_given_what_it_expects(method):
    cv2 = pytest.importorskip(
        "cv2", reason="opencv-python-headless is not installed"
    )
    Ts_pw_p = se3.exp(np.random.default_rng(3).normal(size=(12, 6)))
    T_cw_pw = se3.exp(np.array([3.0, -2.0, 1.0, 0.5, 0.2, -2.0]))
    T_parent_child = rows.opencv(
        cv2, method, Ts_pw_p, T_cw_pw @ Ts_pw_p @ data.T_PARENT_CHILD
    )
    assert_allclose(T_parent_child, data.T_PARENT_CHILD, atol=1e-6)
