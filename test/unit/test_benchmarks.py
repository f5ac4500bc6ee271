"""The benchmark suite fails when it should. How fast anything is, is not tested here."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

from suite import baseline, data, figure, opencv, table  # noqa: E402
from suite.measuring import Row  # noqa: E402

from hand_eye_calib.geometry import se3  # noqa: E402
from hand_eye_calib.solvers.registry import Method  # noqa: E402

ROWS = [
    Row("dnlo fast", 443, 0.01, 0.1, 5, 2.0),
    Row("dnlo ipopt", 443, 1.0, 0.1, 5, 2.0),
    Row("opencv, the fastest", 443, 2.0, 0.1, 2),
]
MEMORY = {443: (50, 150, 80)}
KNOWN = {
    "rows": [row.key for row in ROWS],
    "ratios": {
        "dnlo ipopt / dnlo fast, 443": 120.0,
        "opencv, the fastest / dnlo fast, 443": 200.0,
        "memory of the pairs / of solving them, 443": 0.8,
    },
}


@pytest.mark.parametrize(
    ("changes", "failures"),
    [
        (
            {"seconds": 0.026},
            ["dnlo ipopt / dnlo fast, 443: 38.5, below a third of the baseline's 120"],
        ),
        ({"objective": 2.0001}, ["dnlo fast, 443: objective 2.0001 is above ipopt's 2"]),
        (
            {"size": 442},
            [
                "dnlo fast, 443: row is missing",
                "dnlo fast, 442: not in the baseline; run with --update",
                "dnlo ipopt / dnlo fast, 443: ratio is missing",
                "opencv, the fastest / dnlo fast, 443: ratio is missing",
            ],
        ),
    ],
)
def test_a_row_that_falls_short_is_a_failure(changes, failures):
    rows = [dataclasses.replace(ROWS[0], **changes), *ROWS[1:]]
    assert baseline.failures(rows, MEMORY, KNOWN) == failures


def test_only_opencv_may_be_missing_and_only_a_full_run_may_have_more():
    assert baseline.failures(ROWS, MEMORY, baseline.summary(ROWS, MEMORY)) == []
    assert baseline.failures(ROWS[:2], MEMORY, KNOWN) == []
    assert baseline.failures([ROWS[0], ROWS[2]], MEMORY, KNOWN) == [
        "dnlo ipopt, 443: row is missing",
        "dnlo ipopt / dnlo fast, 443: ratio is missing",
    ]
    more = [*ROWS, Row("park", 10**6, 1.0, 0.1, 2)]
    assert baseline.failures(more, MEMORY, KNOWN) == [
        "park, 1000000: not in the baseline; run with --update"
    ]
    assert baseline.failures(more, MEMORY, KNOWN, is_more=True) == []


def test_baseline_covers_both_sources_with_equal_rows():
    known = json.loads((BENCHMARKS / "baseline.json").read_text(encoding="utf-8"))
    assert set(known) == {"published", "simulated"}
    assert known["published"]["rows"] == known["simulated"]["rows"]
    assert known["published"]["ratios"].keys() == known["simulated"]["ratios"].keys()
    assert {"dnlo ipopt / dnlo fast, 443", "opencv, the fastest / dnlo fast, 2338"} <= known[
        "published"
    ]["ratios"].keys()


def test_simulated_drives_have_a_known_answer_and_as_many_pairs_as_asked_for():
    drive = data.simulated_drive(data.SHORT + 5)
    assert len(drive.pairs) == data.SHORT
    found = Method("dnlo").solve(drive.pairs).T_parent_child
    np.testing.assert_allclose(found, drive.T_parent_child, atol=0.05)


@pytest.mark.parametrize("method", opencv.METHODS)
def test_opencv_is_given_what_it_expects(method):
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed")
    random = np.random.default_rng(3)
    Ts_pw_p = np.array(
        [se3.exp(np.r_[random.normal(size=3), random.normal(size=3)]) for _ in range(12)]
    )
    T_cw_pw = se3.exp(np.array([3.0, -2.0, 1.0, 0.5, 0.2, -2.0]))
    found = opencv.calibrate(cv2, method, Ts_pw_p, T_cw_pw @ Ts_pw_p @ data.T_PARENT_CHILD)
    np.testing.assert_allclose(found, data.T_PARENT_CHILD, atol=1e-6)


def test_tables_replace_those_of_an_earlier_run_in_the_page(tmp_path):
    page = tmp_path / "page.md"
    page.write_text((BENCHMARKS.parent / "docs" / "benchmarks.md").read_text("utf-8"), "utf-8")
    for seconds in ("1.5 ms", "2.5 ms"):
        growth = table.Table("Growth", ["443"], [["dnlo fast", seconds]])
        table.write([growth], page, f"Measured, {seconds}.\n")
    text = page.read_text("utf-8")
    assert "### Growth\n\n|  | 443 |\n| --- | ---: |\n| dnlo fast | 2.5 ms |\n" in text
    assert "1.5 ms" not in text
    assert text.startswith("# Benchmarks")


def test_tables_and_figure_show_every_row(tmp_path, capsys):
    rows = [
        dataclasses.replace(row, size=size, error_m=0.1, error_rad=0.01)
        for size in (443, 2338)
        for row in (Row(baseline.FLOOR, 443, 1e-6, 0.0, 5), *ROWS)
    ]
    figure.draw(rows, tmp_path / "images" / "growth.png")
    assert (tmp_path / "images" / "growth.png").read_bytes().startswith(b"\x89PNG")
    rows.append(Row("add_pose, median", 40_000, 1.25e-6, 0.1, 5))
    table.show(table.tables("published", rows, MEMORY))
    shown = capsys.readouterr().out
    aims = ("What is aimed at", "dnlo ipopt / dnlo fast, 443")
    assert all(words in shown for words in ("10 ms ± 10%", "0.573", "1.25 us", *aims))
