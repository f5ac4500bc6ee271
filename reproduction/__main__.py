"""``python -m reproduction ID``: make a figure or table of the paper, and compare it with the
published results.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.offline.cli.main import exit_code_of
from hand_eye_calib.offline.cli.options import note
from reproduction import (
    certificate,
    conclusions,
    faults,
    figures,
    findings,
    published,
    tables,
)
from reproduction.published import KITTI, METHODS, SIMULATED
from reproduction.results import SIMULATION_METHODS, Results
from reproduction.rows import TITLES, Cell, cells, solve_cell, table_of
from reproduction.runner import in_parallel
from reproduction.sources import PublishedSource, SimulatedSource, Source
from reproduction.writing import put_into_page, study_parser

EXPERIMENTS = {
    "fig3": "errors of DNLO for every reference: noise, outliers, drift, mixture",
    "fig4": "components of the relative motions",
    "fig5": "the best variant of every method",
    "table1": "KITTI 2011_09_30_drive_0027, lidar and camera",
    "table2": "KITTI 2011_10_03_drive_0027, two cameras",
    "s-figures": "S1-S5: as fig3, for the other methods",
    "s-tables": "S1-S12: every method and reference on both drives",
    "certificate": "study: which answers are proved to be global minima",
    "faults": "study: deliberate faults, with their findings and verdicts",
    "all": "all figures and tables of the paper, its conclusions and our findings",
}

_EPILOG = (
    "\n".join(f"{name:<13}{about}" for name, about in EXPERIMENTS.items())
    + """

Every figure is written as PNG, SVG and CSV, every table as Markdown and CSV. The files
*_comparison.csv and *_comparison.md compare them with the published results, cell by cell.
Published data: clone github.com/tau-alma/trajectory_calibration_experiments and name its
folder with --data-folder."""
)


@dataclass(frozen=True)
class Artefact:
    """A figure, a table or a text, with its comparison; its files begin with its name."""

    name: str
    # Cells that must be solved before the files can be written.
    cells: list[Cell]
    # ``write(name, results)`` writes the files and returns their paths.
    write: Callable[[str, Results], list[Path]]


_EVERYTHING = cells(SIMULATED, SIMULATION_METHODS) + cells(KITTI, METHODS)
_FIGURES = [
    Artefact(name, cells(SIMULATED, methods), figures.write_error_figure)
    for name, methods in figures.FIGURE_METHODS.items()
]
_VARIANTS = [
    Artefact(name, cells([dataset], [method]), tables.write_variant_table)
    for name, (dataset, method) in tables.VARIANT_TABLES.items()
]
_PAPER = [
    Artefact("fig4", [], figures.write_components),
    *_FIGURES,
    *(
        Artefact(name, cells([dataset], METHODS), tables.write_summary_table)
        for name, dataset in tables.SUMMARY_TABLES.items()
    ),
    *_VARIANTS,
    Artefact("conclusions", _EVERYTHING, conclusions.write),
    Artefact("findings", _EVERYTHING, findings.write),
]
GROUPS = {artefact.name: [artefact] for artefact in _PAPER} | {
    "s-figures": [
        artefact for artefact in _FIGURES if artefact.name.startswith("figS")
    ],
    "s-tables": _VARIANTS,
    "certificate": [Artefact("certificate", [], certificate.write)],
    "all": _PAPER,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run an experiment and return the exit code."""
    parser = study_parser(
        "reproduction",
        f"{__doc__}\n{_EPILOG}",
        "put the tables of certificate or faults into this page",
    )
    add = parser.add_argument
    add(
        "id",
        metavar="ID",
        choices=tuple(EXPERIMENTS),
        help=", ".join(EXPERIMENTS),
    )
    add(
        "--data",
        choices=("published", "simulated"),
        default="published",
        help="published trajectories, or drives of our simulator. Default: published",
    )
    add(
        "--seed",
        type=int,
        default=0,
        help="seed of simulated drives, also those of faults. Default: 0",
    )
    add(
        "--runs",
        type=int,
        default=published.N_RUNS,
        help="simulated drives. Default: 38",
    )
    add(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("reproduced"),
        help="directory for the files. Default: reproduced",
    )
    add(
        "--jobs",
        type=int,
        default=os.cpu_count() or 1,
        help="processes. Default: all cores",
    )
    add(
        "--clean",
        action="store_true",
        help="with faults: only the recordings without a fault",
    )
    return exit_code_of(lambda: run(parser.parse_args(argv)))


def run(arguments: argparse.Namespace) -> int:
    """Run the experiment and return the exit code."""
    if arguments.jobs < 1 or arguments.runs < 2:
        raise ConfigError("--jobs must be at least 1, --runs at least 2")
    if arguments.id == "faults":
        text = faults.run(arguments)
    else:
        results, files = solve_and_write(
            arguments.id, _source(arguments), arguments.out, arguments.jobs
        )
        text = summary_of(results, files)
        if arguments.page is not None:
            page = (arguments.out / f"{arguments.id}.md").read_text(
                encoding="utf-8"
            )
            put_into_page(arguments.page, arguments.id, page)
    print(text)
    return 0


def _source(arguments: argparse.Namespace) -> Source:
    if arguments.data == "simulated":
        return SimulatedSource(arguments.seed, arguments.runs)
    if arguments.data_folder is None:
        raise ConfigError(
            "--data published needs the published data: clone "
            "github.com/tau-alma/trajectory_calibration_experiments and name its "
            "folder with --data-folder or $HAND_EYE_CALIB_DATA, or use --data simulated"
        )
    return PublishedSource(published.find_folder(arguments.data_folder))


def solve_and_write(
    identifier: str, source: Source, out: Path, jobs: int
) -> tuple[Results, dict[str, list[Path]]]:
    """Solve an experiment and write its files; return the results, and paths by artefact.

    Artefacts that need data sets which the source does not have are left out. Raises ConfigError if
    no artefact is left.
    """
    wanted = GROUPS[identifier]
    artefacts = []
    for artefact in wanted:
        datasets = {cell.dataset for cell in artefact.cells}
        if datasets <= set(source.datasets):
            artefacts.append(artefact)
    if not artefacts:
        raise ConfigError(
            f"{identifier} is about the KITTI drives: use --data published"
        )
    if len(artefacts) < len(wanted):
        note(
            "figures and tables of the KITTI drives are left out: they need the published data"
        )
    out.mkdir(parents=True, exist_ok=True)
    # Artefacts may share cells. The keys of a dictionary keep their order.
    different: dict[Cell, None] = {}
    for artefact in artefacts:
        different |= dict.fromkeys(artefact.cells)
    tasks = [(source, cell) for cell in different]
    rows: list[dict[str, Any]] = []
    for rows_of_cell in in_parallel(solve_cell, tasks, jobs):
        rows += rows_of_cell
    results = Results(source, table_of(rows), out, jobs)
    return results, {
        artefact.name: artefact.write(artefact.name, results)
        for artefact in artefacts
    }


def summary_of(results: Results, files: dict[str, list[Path]]) -> str:
    """Return the text of a single artefact, the number of rows that agree, and the folder."""
    lines = []
    if len(files) == 1:
        (name,) = files
        for path in files[name]:
            if path.name == f"{name}.md":
                lines.append(path.read_text(encoding="utf-8"))
    if results.source.is_published:
        for method, rows in results.rows.groupby("method"):
            n_agreeing = rows["agrees"].sum()
            lines.append(
                f"{TITLES[method]:<20}{n_agreeing:>6} of {len(rows):>5} rows agree"
            )
    count = sum(len(paths) for paths in files.values())
    lines.append(f"{count} files written to {results.out}: {', '.join(files)}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
