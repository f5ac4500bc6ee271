"""Experiments: statistics, comparison, what is kept, the command. On drives of our own
simulator.
"""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.solvers.all_pairs import solve_park
from reproduction import comparison, metrics, results, runner
from reproduction.__main__ import EXPERIMENTS, GROUPS, main
from reproduction.published import REFERENCES
from reproduction.rows import (
    ALI_AS_PUBLISHED,
    METRICS,
    PUBLISHED,
    Cell,
    solve_cell,
    table_of,
)
from reproduction.sources import SimulatedSource
from reproduction.writing import put_into_page

SOURCE = SimulatedSource(seed=3, runs=2)
CELLS = [
    Cell("noise", 0.004, "park"),
    Cell("mixture", None, "dnl"),
    Cell("outliers", 10.0, ALI_AS_PUBLISHED),
]

ERRORS = (0.01, 0.5, 0.02, 0.3)
NAMES = {
    "dataset": "noise",
    "level": 0.002,
    "run": "run_01",
    "method": "dnl",
    "reference": "B1",
}
A_ROW = (
    {**NAMES, "converged": True, "objective": 1.0, "published_objective": 1.0}
    | dict(zip(METRICS, ERRORS, strict=True))
    | dict(zip(PUBLISHED, ERRORS, strict=True))
)


@pytest.fixture(autouse=True)
def no_published_data(monkeypatch):
    monkeypatch.delenv("HAND_EYE_CALIB_DATA", raising=False)


@pytest.fixture(scope="module")
def rows():
    return [row for cell in CELLS for row in solve_cell(SOURCE, cell)]


def test_mean_has_students_confidence_interval():
    summary = results.mean_summary([1.0, 2.0, 3.0, 4.0])
    # t(0.975, 3) = 3.18245 and s = 1.290994
    assert (summary.centre, summary.n) == (2.5, 4)
    assert_allclose([summary.low, summary.high], [0.44574, 4.55426], atol=1e-5)
    # Quartiles and whiskers leave out what is far.
    summary = results.quartile_summary([1.0, 2.0, 3.0, 4.0, 100.0])
    assert (summary.low, summary.centre, summary.high) == (2.0, 3.0, 4.0)
    assert summary.whiskers == (1.0, 4.0)


def test_rows_hold_the_errors_of_what_was_solved(rows):
    wanted = {"method": "park", "run": "run_02", "reference": "B5"}
    row = next(row for row in rows if row.items() >= wanted.items())
    case = SOURCE.cases("noise", 0.004)[1]
    pairs = case.pairs("B5")
    expected = metrics.errors(
        pairs, solve_park(pairs).T_parent_child, case.T_parent_child
    )
    assert_allclose(
        [row[metric] for metric in METRICS],
        np.array(expected) * [1, 180 / np.pi, 1, 180 / np.pi],
    )
    assert_array_equal(
        row["T_parent_child"], solve_park(pairs).T_parent_child.ravel()
    )
    table = table_of([row])
    assert (table["case"][0], table["why"][0]) == ("noise/0.004/run_02", "")
    assert table["published_e_at"].isna().all()


def test_best_reference_is_by_mean_over_levels_and_by_median_in_the_mixture():
    def entries(dataset, level, reference, errors):
        names = {
            "dataset": dataset,
            "level": level,
            "method": "dnl",
            "reference": reference,
        }
        return [
            names | dict.fromkeys(METRICS, 0.0) | {"e_at": error}
            for error in errors
        ]

    rows = []
    for reference in REFERENCES:
        levels = (
            ((1.0, 1.0), (5.0, 7.0))
            if reference == "B10"
            else ((0.0, 0.0), (9.0, 9.0))
        )
        mixture = [1.0, 1.0, 90.0] if reference == "C5" else [2.0, 2.0, 2.0]
        for level, errors in zip((0.0, 0.002), levels, strict=True):
            rows += entries("noise", level, reference, errors)
        rows += entries("mixture", None, reference, mixture)
    table = results.Table(pd.DataFrame(rows).astype({"level": float}))
    assert table.levels("noise", "dnl") == (0.0, 0.002)
    assert table.best_reference("noise", "dnl") == "B10"
    assert table.score("noise", "dnl", "B10") == 3.5
    assert table.best_reference("mixture", "dnl") == "C5"


OFF = {"e_at": 0.021}
WITHOUT_OBJECTIVE = {**OFF, "published_objective": None}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, ""),
        ({"e_at": 0.020019}, ""),
        ({**OFF, "objective": 0.9}, "lower objective"),
        ({**OFF, "objective": 1.0 + 5e-7}, "flat"),
        ({**OFF, "objective": 1.0 + 2e-6}, "our objective is higher"),
        ({**WITHOUT_OBJECTIVE, "method": "ali"}, "never normalised"),
        (
            {**WITHOUT_OBJECTIVE, "method": "zhuang", "converged": False},
            "not settle",
        ),
        ({**WITHOUT_OBJECTIVE, "method": "park"}, "unexplained"),
        ({**OFF, **dict.fromkeys(PUBLISHED)}, ""),
    ],
)
def test_every_row_that_differs_says_why(changes, why):
    (reason,) = table_of([A_ROW | changes])["why"]
    assert (why in reason) if why else reason == ""


def test_comparison_counts_lists_and_explains(tmp_path):
    table = table_of(
        [A_ROW, A_ROW | {"e_at": 0.5, "e_aR": 30.0, "objective": 0.4}]
    )
    text = comparison.describe_rows(table)
    assert "1 of 2 (50.00 %)" in text
    assert (
        "| noise/0.002/run_01 | DNL | B1 | 0.5, 30 | 0.02, 0.3 | 0.4, 1 |"
        in text
    )
    written = (
        comparison.write_rows(tmp_path / "rows.csv", table)
        .read_text()
        .splitlines()
    )
    assert len(written) == 3
    assert written[2].endswith(
        ",False,published answer is not the minimum: ours has the lower objective"
    )


def tasks_of(cells):
    return {cell.method: (SOURCE, cell) for cell in cells}


def test_what_is_kept_is_not_solved_again_and_processes_do_not_matter(
    tmp_path, rows
):
    path = tmp_path / "new" / "solved.jsonl"
    kept_rows = runner.kept(path, solve_cell, tasks_of(CELLS[:2]), 2)
    assert [
        row for name in tasks_of(CELLS[:2]) for row in kept_rows[name]
    ] == rows[: -len(rows) // 3]
    # What was kept shows in a mark that no solver makes; a line that was cut off is solved again.
    first, second = path.read_text().splitlines()[1:]
    path.write_text(f"\n{first.replace('run_01', 'kept')}\n{second[:-5]}")
    kept_rows = runner.kept(path, solve_cell, tasks_of(CELLS), 1)
    marked = {
        name
        for name, some in kept_rows.items()
        if any(row["run"] == "kept" for row in some)
    }
    assert marked == {CELLS[0].method}
    assert len(kept_rows) == len(CELLS)


def test_everything_in_the_article_is_there():
    names = {f"figS{number}" for number in range(1, 6)}
    names |= {f"tableS{number}" for number in range(1, 13)}
    names |= {"fig3", "fig4", "fig5", "table1", "table2"}
    assert names <= {item.name for item in GROUPS["all"]}
    assert set(EXPERIMENTS) - {"faults"} <= set(GROUPS)


def test_a_text_is_put_between_the_marks_of_its_study(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# Ours\n\n<!-- study: begin -->\nold\n<!-- study: end -->\n\nThe rest.\n"
    )
    put_into_page(page, "study", "# Title\n\n| table |\n")
    assert page.read_text().splitlines()[2::2] == [
        *(
            "<!-- study: begin -->",
            "| table |",
            "<!-- study: end -->",
            "The rest.",
        )
    ]
    with pytest.raises(
        InputError,
        match="has no lines <!-- other: begin --> and <!-- other: end",
    ):
        put_into_page(page, "other", "| table |")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["table1", "--data", "simulated"], 2, "KITTI"),
        (["fig3"], 2, "--data-folder"),
        (
            ["fig3", "--data-folder", "{tmp}"],
            1,
            "trajectory_calibration_experiments",
        ),
        (["fig3", "--data", "simulated", "--runs", "1"], 2, "--runs"),
    ],
)
def test_misuse_is_told_in_one_line(tmp_path, capsys, arguments, code, message):
    arguments = [
        "--out",
        str(tmp_path / "out"),
        *(argument.format(tmp=tmp_path) for argument in arguments),
    ]
    assert main(arguments) == code
    captured = capsys.readouterr()
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert message in captured.err
