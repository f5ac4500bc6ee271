"""``python -m reproduction ID``: a figure or table of the paper, with a comparison with the
published results.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import note
from hand_eye_calib.cli.main import exit_code_of
from hand_eye_calib.cli.options import add_json_argument
from hand_eye_calib.errors import ConfigError, InputError
from reproduction.writing import data_folder, put_into_page

if TYPE_CHECKING:
    import pandas as pd

    from reproduction.catalogue import Artefact
    from reproduction.results import Results
    from reproduction.sources import PublishedSource, Source

Files = dict[str, list[Path]]

EXPERIMENTS = {
    "fig3": "errors of DNLO for every reference: noise, outliers, drift, mixture",
    "fig4": "components of the relative motions",
    "fig5": "the best variant of every method",
    "table1": "KITTI 2011_09_30_drive_0027, lidar and camera",
    "table2": "KITTI 2011_10_03_drive_0027, two cameras",
    "s-figures": "S1-S5: as fig3, for the other methods",
    "s-tables": "S1-S12: every method and reference on both drives",
    "adaptive": "study: adaptive and reference auto against the best choice with hindsight",
    "certificate": "study: which answers are proved to be global minima",
    "faults": "study: faults on purpose, what is found and what the verdict is",
    "all": "all figures and tables of the paper, its conclusions and our findings",
}
STUDIES = ("adaptive", "certificate", "faults")

_EPILOG = (
    "\n".join(f"{name:<13}{about}" for name, about in EXPERIMENTS.items())
    + """

Every figure is written as PNG, SVG and CSV, every table as Markdown and CSV. Beside each,
*_comparison.csv and *_comparison.md compare it with the published results, cell by cell.
Solved calibrations are kept in DIR/solved.jsonl: an interrupted run continues from there.

Published data: clone github.com/tau-alma/trajectory_calibration_experiments and name its
folder with --data-folder."""
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run an experiment; returns the exit code.

    Parameters
    ----------
    argv : list of str, optional
        Arguments; those of the process if left out.
    """
    parser = argparse.ArgumentParser(
        prog="python -m reproduction",
        description=__doc__,
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_EPILOG,
    )
    add = parser.add_argument
    add("id", metavar="ID", choices=tuple(EXPERIMENTS), help=", ".join(EXPERIMENTS))
    add(
        "--data",
        choices=("published", "simulated"),
        default="published",
        help="the published trajectories, or drives of our simulator. Default: published",
    )
    add(
        "--data-folder",
        metavar="DIR",
        type=Path,
        help="folder of the published data, or the one that holds it as valimaki2023. With --data "
        "simulated, what to compare with. Default: $HAND_EYE_CALIB_DATA",
    )
    add("--seed", type=int, help="with --data simulated: another seed, other drives. Default: 0")
    add(
        "--runs", type=int, metavar="N", help="with --data simulated: number of drives. Default: 38"
    )
    add(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("reproduced"),
        help="directory for the files. Default: reproduced",
    )
    add(
        "--page",
        metavar="FILE",
        type=Path,
        help="put the text of a study into this Markdown page, between its marked lines",
    )
    add(
        "--jobs",
        type=int,
        metavar="N",
        default=os.cpu_count() or 1,
        help="number of processes; the numbers do not depend on it. Default: all cores",
    )
    add("--clean", action="store_true", help="with faults: only the recordings without a fault")
    add_json_argument(parser)
    return exit_code_of(lambda: run(parser.parse_args(argv)))


def run(arguments: argparse.Namespace) -> int:
    """Run the experiment; returns the exit code."""
    from reproduction.catalogue import artefacts_of

    if arguments.clean and arguments.id != "faults":
        raise ConfigError(f"--clean is for faults; got {arguments.id}")
    if arguments.jobs < 1:
        raise ConfigError(f"--jobs must be at least 1; got {arguments.jobs}")
    if arguments.id == "faults":
        return _run_faults(arguments)
    source, theirs = _sources(arguments)
    if arguments.page is not None and arguments.id not in STUDIES:
        raise ConfigError(f"--page is for {', '.join(STUDIES)}; got {arguments.id}")
    artefacts, left_out = artefacts_of(arguments.id, source)
    if left_out:
        note(f"left out, since they need the published data: {', '.join(left_out)}")
    results, files = _made(artefacts, source, theirs, arguments)
    if arguments.page is not None:
        text = (arguments.out / f"{arguments.id}.md").read_text(encoding="utf-8")
        put_into_page(arguments.page, arguments.id, text)
    document = _document(arguments, results, files)
    as_json = arguments.json and json.dumps(document, indent=2, allow_nan=False)
    print(as_json or _text(document, files))
    return 0


def _run_faults(arguments: argparse.Namespace) -> int:
    """Run the study of faults, which has recordings of its own; returns the exit code."""
    from reproduction import faults

    folder = data_folder(arguments.data_folder)
    todo = faults.clean_cases(folder) if arguments.clean else faults.cases(folder)
    with _progress(len(todo)) as advance:
        print(faults.run(todo, folder, arguments.out, arguments.page, arguments.jobs, advance))
    return 0


def _sources(arguments: argparse.Namespace) -> tuple[Source, PublishedSource | None]:
    """The source of the cases, and the published source to compare with or None."""
    from reproduction import sources

    folder = data_folder(arguments.data_folder)
    published = sources.PublishedSource(sources.find_folder(folder)) if folder else None
    given = {name: getattr(arguments, name) for name in ("seed", "runs")}
    given = {name: value for name, value in given.items() if value is not None}
    if arguments.data == "published":
        if published is None:
            raise ConfigError(
                "--data published needs the published data: clone "
                "github.com/tau-alma/trajectory_calibration_experiments and name its "
                "folder with --data-folder or $HAND_EYE_CALIB_DATA, or use --data simulated"
            )
        if given:
            raise ConfigError(
                "--seed and --runs are for --data simulated; the published trajectories are given"
            )
        return published, published
    simulated = sources.SimulatedSource(**given)
    if simulated.seed < 0 or simulated.runs < 2:
        raise ConfigError(
            f"--seed must be at least 0 and --runs at least 2; got {simulated.seed} and "
            f"{simulated.runs}"
        )
    return simulated, published


def _made(
    artefacts: Sequence[Artefact],
    source: Source,
    theirs: PublishedSource | None,
    arguments: argparse.Namespace,
) -> tuple[Results, Files]:
    """Solve what is not stored in the output directory yet and write the files; gives what was
    solved, and the paths of the files by artefact.
    """
    from reproduction import runner
    from reproduction.results import Results
    from reproduction.rows import solve_cell, table_of

    if any(artefact.name.startswith("fig") for artefact in artefacts):
        # If Matplotlib is missing, say so before minutes of solving, not after.
        from reproduction import paper_figures  # noqa: F401
    cells = {cell.name: (source, cell) for artefact in artefacts for cell in artefact.cells}
    configuration = {**source.configuration(), **runner.versions()}
    store = runner.Store(arguments.out / "solved.jsonl", configuration)
    with _progress(len(cells) + len(artefacts)) as advance:
        solved = runner.solve(solve_cell, cells, arguments.jobs, store, advance)
        rows = table_of([row for rows in solved.values() for row in rows])
        results, files = Results(source, theirs, rows, arguments.out, arguments.jobs), Files()
        for artefact in artefacts:
            try:
                files[artefact.name] = artefact.write(artefact.name, results)
            except OSError as error:
                raise InputError(
                    f"cannot write {error.filename}: {error.strerror}; choose another "
                    "directory with --out"
                ) from None
            advance(artefact.name)
    return results, files


@contextmanager
def _progress(total: int) -> Iterator[Callable[[str], None]]:
    """A function that advances the progress bar by one; there is a bar on a terminal only."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(file=sys.stderr)
    if not console.is_terminal:  # older releases of rich end with an empty line there
        yield lambda what: None
        return
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("", total=total)
        yield lambda what: bar.update(task, advance=1, description=what)


def _document(arguments: argparse.Namespace, results: Results, files: Files) -> dict[str, Any]:
    document = {
        "experiment": arguments.id,
        "data": results.source.configuration()["data"],
        "runs": results.n_runs,
        "files": {name: [str(path) for path in paths] for name, paths in files.items()},
        "rows": len(results.rows),
    }
    if results.same_cases:
        document["agreement"] = [
            _agreement(str(method), rows) for method, rows in results.rows.groupby("method")
        ]
    return document


def _agreement(method: str, rows: pd.DataFrame) -> dict[str, Any]:
    differing = rows["why"][~rows["agrees"]].value_counts().to_dict()
    found = {"method": method, "rows": len(rows), "agreeing": int(rows["agrees"].sum())}
    found["differing"] = differing
    if method == "dnlo":
        verdicts = ("lower", "equal", "higher")
        found["objective"] = {each: int((rows["verdict"] == each).sum()) for each in verdicts}
    return found


def _text(document: dict[str, Any], files: Files) -> str:
    from reproduction.rows import TITLES

    lines = []
    if len(files) == 1:
        # A single artefact: print its text.
        ((name, paths),) = files.items()
        texts = [path for path in paths if path.name == f"{name}.md"]
        lines += [path.read_text(encoding="utf-8") for path in texts]
    for agreement in document.get("agreement", ()):
        reasons = "; ".join(f"{count} {why}" for why, count in agreement["differing"].items())
        lines.append(
            f"{TITLES[agreement['method']]:<20}{agreement['agreeing']:>6} of "
            f"{agreement['rows']:>5} rows as published" + (f"; {reasons}" if reasons else "")
        )
    n_files = sum(len(paths) for paths in files.values())
    folder = next(iter(files.values()))[0].parent
    return "\n".join([*lines, f"{n_files} files written to {folder}: {', '.join(files)}"])
