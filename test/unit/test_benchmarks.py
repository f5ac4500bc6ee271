"""The benchmark suite fails when it should. How fast anything is, is not tested here."""

import dataclasses
import importlib.util
import json
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def suite():
    spec = importlib.util.spec_from_file_location("benchmark_suite", BENCHMARKS / "run.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def rows(suite):
    return [
        suite.Row("short dnlo fast", 443, 0.01, 0.1, 5, 2.0),
        suite.Row("short dnlo ipopt", 443, 1.0, 0.1, 5, 2.0),
    ]


BASELINE = {"pairs": {"short dnlo fast": 443, "short dnlo ipopt": 443}, "ratios": {"short dnlo ipopt / fast": 120.0}}


def test_rows_like_the_baseline_are_good(suite, rows):
    assert suite.failures(rows, BASELINE) == []


@pytest.mark.parametrize(
    ("changes", "failure"),
    [
        ({"seconds": 0.026}, "short dnlo ipopt / fast: 38, below a third of the baseline's 120"),
        ({"objective": 2.0001}, "short dnlo fast: objective 2.0001 is above ipopt's 2"),
        ({"pairs": 442}, "short dnlo fast: 442 pairs, baseline has 443"),
    ],
)
def test_a_row_that_falls_short_is_a_failure(suite, rows, changes, failure):
    assert suite.failures([dataclasses.replace(rows[0], **changes), rows[1]], BASELINE) == [failure]


def test_a_missing_or_unknown_row_is_a_failure(suite, rows):
    assert suite.failures(rows[1:], BASELINE) == [
        "short dnlo fast: row is missing",
        "short dnlo ipopt / fast: ratio is missing",
    ]
    unknown = dataclasses.replace(rows[1], name="long pairs")
    assert suite.failures([*rows, unknown], BASELINE) == ["long pairs: not in the baseline; run with --update"]


def test_baseline_covers_both_sources_with_equal_rows():
    baselines = json.loads((BENCHMARKS / "baseline.json").read_text(encoding="utf-8"))
    assert set(baselines) == {"published", "simulated"}
    assert baselines["published"]["pairs"] == baselines["simulated"]["pairs"]
    assert set(baselines["published"]["pairs"].values()) == {443, 2338}


def test_simulated_drive_gives_as_many_pairs_as_the_published_one(suite):
    parent, child = suite.simulated_drive(suite.SIZES["short"], seed=0)
    assert len(suite.motion_pairs(parent, child, suite.REFERENCE)) == 443
