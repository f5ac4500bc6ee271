"""Experiments: statistics, comparison, what is stored and resumed, the command. On drives of our
own simulator.
"""

import dataclasses
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from hand_eye_calib.assessment import metrics
from hand_eye_calib.errors import InputError
from hand_eye_calib.solvers import park
from reproduction import comparison, results, runner
from reproduction.catalogue import ARTEFACTS, GROUPS
from reproduction.command import STUDIES, main
from reproduction.kitti_truth import RECTIFIED
from reproduction.published import LEVELS, REFERENCES, check_folder
from reproduction.rows import ALI_AS_PUBLISHED, METRICS, PUBLISHED, Cell, solve_cell, table_of
from reproduction.sources import SimulatedSource
from reproduction.tables import PRINTED
from reproduction.writing import put_into_page

ROOT = Path(__file__).resolve().parents[2]
SOURCE = SimulatedSource(seed=3, runs=2)
CELLS = [
    Cell("noise", 0.004, "park"),
    Cell("mixture", None, "dnl"),
    Cell("outliers", 10.0, ALI_AS_PUBLISHED),
]

ERRORS = (0.01, 0.5, 0.02, 0.3)
NAMES = {"dataset": "noise", "level": 0.002, "run": "run_01", "method": "dnl", "reference": "B1"}
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
    assert (summary.centre, summary.n, summary.is_median) == (2.5, 4, False)
    np.testing.assert_allclose(
        [summary.low, summary.high], [2.5 - 2.05426, 2.5 + 2.05426], atol=1e-5
    )


def test_quartiles_and_whiskers_leave_out_what_is_far():
    summary = results.quartile_summary([1.0, 2.0, 3.0, 4.0, 100.0])
    assert (summary.low, summary.centre, summary.high) == (2.0, 3.0, 4.0)
    assert summary.whiskers == (1.0, 4.0)


def test_rows_hold_the_errors_of_what_was_solved(rows):
    row = next(
        row
        for row in rows
        if (row["method"], row["run"], row["reference"]) == ("park", "run_02", "B5")
    )
    case = SOURCE.cases("noise", 0.004)[1]
    pairs = case.pairs("B5")
    expected = metrics.errors(pairs, park.solve(pairs).T_parent_child, case.T_parent_child)
    np.testing.assert_allclose(
        [row[metric] for metric in METRICS],
        np.array(dataclasses.astuple(expected)) * [1, 180 / np.pi, 1, 180 / np.pi],
    )
    np.testing.assert_array_equal(row["T_parent_child"], park.solve(pairs).T_parent_child.ravel())
    table = table_of([row])
    assert (table["case"][0], table["why"][0]) == ("noise/0.004/run_02", "")
    assert table["published_e_at"].isna().all()


def test_best_reference_is_by_mean_over_levels_and_by_median_in_the_mixture():
    def entries(dataset, level, reference, errors):
        names = {"dataset": dataset, "level": level, "method": "dnl", "reference": reference}
        return [names | dict.fromkeys(METRICS, 0.0) | {"e_at": error} for error in errors]

    found = []
    for reference in REFERENCES:
        by_level = (
            {0.0: [1.0, 1.0], 0.002: [5.0, 7.0]}
            if reference == "B10"
            else {0.0: [0.0, 0.0], 0.002: [9.0, 9.0]}
        )
        for level, errors in by_level.items():
            found += entries("noise", level, reference, errors)
        found += entries(
            "mixture", None, reference, [1.0, 1.0, 90.0] if reference == "C5" else [2.0, 2.0, 2.0]
        )
    table = results.Table(pd.DataFrame(found).astype({"level": float}))
    assert table.levels("noise", "dnl") == (0.0, 0.002)
    assert (table.best_reference("noise", "dnl"), table.score("noise", "dnl", "B10")) == (
        "B10",
        3.5,
    )
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
        ({**WITHOUT_OBJECTIVE, "method": "zhuang", "converged": False}, "not settle"),
        ({**WITHOUT_OBJECTIVE, "method": "park"}, "unexplained"),
        ({**OFF, **dict.fromkeys(PUBLISHED)}, ""),
    ],
)
def test_every_row_that_differs_says_why(changes, why):
    (said,) = table_of([A_ROW | changes])["why"]
    assert (why in said) if why else said == ""


def test_comparison_counts_lists_and_explains(tmp_path):
    table = table_of([A_ROW, A_ROW | {"e_at": 0.5, "e_aR": 30.0, "objective": 0.4}])
    text = comparison.describe_rows(table)
    assert "1 of 2 (50.00 %)" in text
    assert "| noise/0.002/run_01 | DNL | B1 | 0.5, 30 | 0.02, 0.3 | 0.4, 1 |" in text
    written = comparison.write_rows(tmp_path / "rows.csv", table).read_text().splitlines()
    assert len(written) == 3
    assert written[2].endswith(
        ",False,published answer is not the minimum: ours has the lower objective"
    )


def test_other_trajectories_agree_where_intervals_overlap():
    ours, near, far = (
        results.mean_summary(np.array([1.0, 2.0, 3.0]) + shift) for shift in (0.0, 1.0, 9.0)
    )
    assert comparison.compare_summaries(ours, near, same_cases=False)
    assert not comparison.compare_summaries(ours, near, same_cases=True)
    assert not comparison.compare_summaries(ours, far, same_cases=False)


def kept_in(folder, source=SOURCE):
    return runner.Store(folder / "solved.jsonl", source.configuration())


def solved(folder, jobs, on_done=lambda name: None):
    tasks = {cell.name: (SOURCE, cell) for cell in CELLS}
    found = runner.solve(solve_cell, tasks, jobs, kept_in(folder), on_done)
    assert list(found) == list(tasks)
    return [row for rows in found.values() for row in rows]


def test_the_number_of_processes_does_not_matter(tmp_path, rows):
    for jobs in (1, 2):
        assert solved(tmp_path / str(jobs), jobs) == rows


def test_an_interrupted_run_goes_on_where_it_ended(tmp_path, rows):
    def interrupt(name):
        raise KeyboardInterrupt

    others = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt):
        solved(tmp_path, 1, interrupt)
    assert not set(multiprocessing.active_children()) - others
    (kept,) = kept_in(tmp_path).found
    # That the kept cell is not solved again shows in a mark that no solver makes.
    path = tmp_path / "solved.jsonl"
    path.write_text(path.read_text().replace("run_01", "kept"))
    marks = {row["method"] for row in solved(tmp_path, 2) if row["run"] == "kept"}
    assert len(marks) == 1
    assert kept.endswith(marks.pop())
    assert len(kept_in(tmp_path).found) == len(CELLS)


def test_a_changed_configuration_starts_anew(tmp_path):
    kept_in(tmp_path).keep("a cell", [1.5])
    assert kept_in(tmp_path).found == {"a cell": [1.5]}
    assert kept_in(tmp_path, dataclasses.replace(SOURCE, seed=4)).found == {}


def test_a_line_that_was_cut_off_is_solved_again(tmp_path):
    store = kept_in(tmp_path)
    for name in ("whole", "cut"):
        store.keep(name, [1.5])
    path = tmp_path / "solved.jsonl"
    path.write_text(path.read_text()[:-5])
    again = kept_in(tmp_path)
    assert again.found == {"whole": [1.5]}
    again.keep("next", [2.5])
    assert kept_in(tmp_path).found == {"whole": [1.5], "next": [2.5]}


def test_a_file_that_is_not_ours_is_left_alone(tmp_path):
    (tmp_path / "solved.jsonl").write_text("years of work")
    with pytest.raises(InputError, match="move it"):
        kept_in(tmp_path)
    assert (tmp_path / "solved.jsonl").read_text() == "years of work"


def test_simulated_cases_have_the_noise_of_their_level():
    for dataset, factor in (("noise", 1.0), ("outliers", 0.01), ("drift", 1.0)):
        quiet, loud = (SOURCE.cases(dataset, LEVELS[dataset][k])[0] for k in (0, -1))
        truth = quiet.child.poses @ np.linalg.inv(quiet.T_parent_child)
        np.testing.assert_allclose(
            np.linalg.inv(truth[0]) @ truth,
            np.linalg.inv(quiet.parent.poses[0]) @ quiet.parent.poses,
            atol=1e-9,
        )
        assert (
            np.abs(loud.child.poses - quiet.child.poses).max() > 0.1 * factor * LEVELS[dataset][-1]
        )
        np.testing.assert_array_equal(loud.T_parent_child, quiet.T_parent_child)
    assert [case.run for case in SOURCE.cases("mixture", None)] == ["run_01", "run_02"]


def test_everything_in_the_article_is_there():
    names = {f"figS{number}" for number in range(1, 6)}
    names |= {f"tableS{number}" for number in range(1, 13)}
    names |= {"fig3", "fig4", "fig5", "table1", "table2"}
    assert names <= {each.name for each in GROUPS["all"]} == set(ARTEFACTS) - set(STUDIES)


def test_rectified_truth_of_the_long_drive_is_beside_the_camera_and_parallel():
    np.testing.assert_array_equal(RECTIFIED["kitti_long"][:3, :3], np.eye(3))
    np.testing.assert_allclose(
        RECTIFIED["kitti_long"][:3, 3], [-0.0599, 0.0011, -0.0038], atol=5e-5
    )


def test_printed_gains_are_those_of_variants_other_than_b1():
    for table in PRINTED.values():
        assert {method: row[0] == "B1" for method, row in table.items()} == {
            method: row[5] is None for method, row in table.items()
        }


def test_command_draws_and_says_what_it_has_no_numbers_for(tmp_path, capsys):
    arguments = [
        "fig3",
        "--data",
        "simulated",
        "--runs",
        "3",
        "--seed",
        "1",
        "--jobs",
        "1",
        "--json",
    ]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["experiment"], document["data"], document["runs"]) == ("fig3", "simulated", 3)
    assert document["rows"] == 19 * 3 * 6
    assert {Path(path).name for path in document["files"]["fig3"]} == {
        "fig3.png",
        "fig3.svg",
        "fig3.csv",
        "fig3_comparison.md",
    }
    assert (tmp_path / "fig3.png").read_bytes().startswith(b"\x89PNG")
    text = " ".join(ElementTree.parse(tmp_path / "fig3.svg").getroot().itertext())
    assert all(reference in text for reference in REFERENCES)
    lines = (tmp_path / "fig3.csv").read_text().splitlines()
    assert len(lines) == 1 + 19 * len(REFERENCES) * len(METRICS)
    assert "--data-folder" in (tmp_path / "fig3_comparison.md").read_text()


def test_components_of_the_motions_need_no_solver(tmp_path, capsys):
    assert main(["fig4", "--data", "simulated", "--runs", "2", "--out", str(tmp_path)]) == 0
    assert "fig4" in capsys.readouterr().out
    medians = {}
    for line in (tmp_path / "fig4.csv").read_text().splitlines()[1:]:
        component, reference, _, median, *_ = line.split(",")
        medians[component, reference] = float(median)
    # Half a metre per second for half a second, seen from either end of an arc.
    assert 0.05 < np.hypot(medians["x", "B5"], medians["y", "B5"]) <= 0.3
    assert medians["z", "B5"] < medians["x", "B5"]
    assert medians["roll", "B5"] < medians["yaw", "B5"]


def test_a_text_is_put_between_the_marks_of_its_study(tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("# Ours\n\n<!-- study: begin -->\nold\n<!-- study: end -->\n\nThe rest.\n")
    put_into_page(page, "study", "# Title\n\n| table |\n")
    assert page.read_text() == (
        "# Ours\n\n<!-- study: begin -->\n\n| table |\n\n<!-- study: end -->\n\nThe rest.\n"
    )
    with pytest.raises(InputError, match="has no lines <!-- other: begin --> and <!-- other: end"):
        put_into_page(page, "other", "| table |")
    with pytest.raises(InputError, match=r"absent\.md: No such file"):
        put_into_page(tmp_path / "absent.md", "study", "| table |")
    assert main(["fig4", "--data", "simulated", "--page", str(page)]) == 2
    assert "--page is for adaptive, certificate, faults; got fig4" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["table1", "--data", "simulated"], 2, "KITTI"),
        (["fig3"], 2, "--data-folder"),
        (["fig3", "--data-folder", "{tmp}"], 1, "trajectory_calibration_experiments"),
        (["fig3", "--data", "simulated", "--runs", "1"], 2, "--runs"),
        (["fig3", "--data", "simulated", "--jobs", "0"], 2, "--jobs"),
        (["fig4", "--data", "simulated", "--runs", "2", "--out", "{tmp}/file/out"], 1, "--out"),
    ],
)
def test_misuse_is_told_in_one_line(tmp_path, capsys, arguments, code, said):
    (tmp_path / "file").write_text("in the way")
    assert (
        main(["--out", str(tmp_path / "out"), *(text.format(tmp=tmp_path) for text in arguments)])
        == code
    )
    captured = capsys.readouterr()
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert said in captured.err


def test_options_of_simulated_drives_are_refused_for_the_published_ones(tmp_path, capsys):
    for folder in ("kitti_tests", "simulation_tests", "calib"):
        (tmp_path / folder).mkdir()
    assert check_folder(tmp_path) == tmp_path
    assert main(["fig3", "--data-folder", str(tmp_path), "--runs", "5"]) == 2
    assert "--data simulated" in capsys.readouterr().err
    (tmp_path / "calib").rmdir()
    with pytest.raises(InputError, match="published or calib"):
        check_folder(tmp_path)


def test_ctrl_c_ends_the_command_at_once_and_keeps_what_is_solved(tmp_path):
    arguments = ["fig3", "--data", "simulated", "--runs", "20", "--jobs", "2", "--out"]
    # As from a terminal: all processes get the signal.
    running = subprocess.Popen(
        [sys.executable, "-m", "reproduction", *arguments, str(tmp_path)],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    path = tmp_path / "solved.jsonl"
    with running as process:
        while not path.exists() or len(path.read_text().splitlines()) < 2:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        errors = process.communicate()[1]
    assert (process.returncode, errors) == (130, "")
    _, *kept = path.read_text().splitlines()
    assert 0 < len(kept) < 19
    assert all(json.loads(line)["name"].endswith("dnlo") for line in kept)
