"""One command gives the paper's tables and figures from the published trajectories, and says what
differs.
"""

import csv
import dataclasses

import pytest
from published_data import FALSE_MINIMA_OF_DNL, data_folder

from reproduction import __main__ as command
from reproduction import paper_figures
from reproduction.published import METHODS, find_folder
from reproduction.sources import PublishedSource
from reproduction.tables import PRINTED

# Levels of the simulated cases that are solved here: ``make paper`` takes a minute for all.
LEVELS = {
    "noise": (0.0, 0.01),
    "outliers": (10.0,),
    "drift": (0.05,),
    "mixture": (None,),
}
N_LEVELS = sum(map(len, LEVELS.values()))
# Of one method: 38 drives at each level and both KITTI drives, with six references.
ROWS = (38 * N_LEVELS + 2) * 6


def made(identifier, folder, jobs=2):
    """What an experiment on the published data solved, and its files."""
    source = PublishedSource(find_folder(data_folder()))
    results, files = command.solve_and_write(identifier, source, folder, jobs)
    return results.rows, files


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Rows and folder of all tables of both KITTI drives."""
    folder = tmp_path_factory.mktemp("tables")
    with pytest.MonkeyPatch.context() as patch:
        names = ("table1", "table2", "s-tables")
        both = [
            experiment for name in names for experiment in command.GROUPS[name]
        ]
        patch.setitem(command.GROUPS, "s-tables", both)
        return made("s-tables", folder, 1)[0], folder


def read(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("name", "drive"), [("table1", "kitti_short"), ("table2", "kitti_long")]
)
def test_tables_1_and_2_are_as_printed(tables, name, drive):
    folder = tables[1]
    best = {
        line["method"].lower(): line for line in read(folder / f"{name}.csv")
    }
    assert {method: line["variant"] for method, line in best.items()} == {
        method: PRINTED[drive][method][0] for method in METHODS
    }
    compared = read(folder / f"{name}_comparison.csv")
    assert len(compared) == 36
    differing = {
        line["method"]: line for line in compared if line["agrees"] == "False"
    }
    assert set(differing) == {"DNLO"}
    assert "lower objective" in differing["DNLO"]["why"]
    for method in METHODS:
        if method != "dnlo":
            printed = [
                value
                for value in PRINTED[drive][method][1:]
                if value is not None
            ]
            ours = [
                float(value)
                for value in list(best[method].values())[2:8]
                if value
            ]
            assert ours == pytest.approx(printed, abs=5.1e-4)


def test_rectified_truth_explains_the_rotation_error_of_the_long_drive(tables):
    """Against the unrectified cameras every good method seems 0.43 deg off; against what the SLAM
    saw it is within 0.06 deg.
    """
    errors = {line["method"]: line for line in read(tables[1] / "table2.csv")}
    assert float(errors["DNL"]["e_aR (deg)"]) > 0.4
    assert float(errors["DNL"]["rectified: e_aR (deg)"]) < 0.06


def test_variant_tables_hold_every_method_on_both_drives(tables):
    rows, folder = tables
    agreeing = rows.groupby("method")["agrees"].sum().to_dict()
    assert agreeing.pop("dnlo") < 12
    assert agreeing == dict.fromkeys(
        ("ali", "dnl", "park", "taylor", "zhuang"), 12
    )
    for number in range(1, 13):
        assert len(read(folder / f"tableS{number}.csv")) == 6


@pytest.fixture
def few_levels(monkeypatch):
    """Solve some levels only."""

    some = [
        dataclasses.replace(
            experiment,
            cells=[
                cell
                for cell in experiment.cells
                if cell.level in LEVELS.get(cell.dataset, (None,))
            ],
        )
        for experiment in command.GROUPS["all"]
    ]
    monkeypatch.setitem(command.GROUPS, "all", some)


@pytest.fixture
def one_error_figure(monkeypatch):
    """Draw the first of the eight figures of errors only: they take as long as all the solves."""
    drawn = []
    draw = paper_figures.draw_errors

    def draw_first(*arguments):
        if not drawn:
            drawn.extend(draw(*arguments))
            return list(drawn)
        return []

    monkeypatch.setattr(paper_figures, "draw_errors", draw_first)
    return drawn


@pytest.mark.statistics
def test_everything_from_one_command(tmp_path, few_levels, one_error_figure):
    rows, files = made("all", tmp_path)
    four = rows[rows["method"].isin(["park", "taylor", "zhuang", "dnl"])]
    assert len(four) == 4 * ROWS
    assert four["agrees"].mean() >= 0.995
    # What differs must be explained, and our objectives must not be above the published answers'.
    assert not set(four["why"]) & {"unexplained", "our objective is higher"}
    differing = {}
    for line in read(tmp_path / "rows.csv"):
        if line["agrees"] == "False":
            differing.setdefault(line["method"], []).append(line)
    assert not {"park", "taylor", "ali_as_published"} & set(differing)
    assert {
        (line["case"], line["reference"]) for line in differing["dnl"]
    } <= FALSE_MINIMA_OF_DNL
    for line in differing["dnl"]:
        assert float(line["objective"]) < 0.1 * float(
            line["objective_at_published"]
        ), line["case"]
    # The last of 500 steps of an iteration that never settles may depend on rounding.
    assert all(
        "does not settle" in line["why"] for line in differing.get("zhuang", ())
    )
    assert rows["agrees"][rows["method"] == "ali"].sum() >= 12
    objective = rows["verdict"][rows["method"] == "dnlo"].value_counts()
    assert objective.sum() == ROWS
    assert "higher" not in objective
    assert objective["lower"] > 250
    shares = {
        "figS1": 1.0,
        "figS2": 0.9,
        "figS3": 1.0,
        "figS4": 1.0,
        "figS5": 0.99,
        "fig3": 0.5,
    }
    for figure, exact in shares.items():
        points = [
            line["agrees"] == "True"
            for line in read(tmp_path / f"{figure}_comparison.csv")
        ]
        assert len(points) == N_LEVELS * 6 * 4
        assert sum(points) >= exact * len(points), figure
    assert [path.suffix for path in one_error_figure] == [".png", ".svg"]
    verdicts = [line["verdict"] for line in read(tmp_path / "conclusions.csv")]
    assert len(verdicts) == 21
    assert "Does not hold" not in verdicts
    assert all(
        path.stat().st_size for paths in files.values() for path in paths
    )
