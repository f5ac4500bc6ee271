"""Experiments by name: the cells each needs and the files it writes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hand_eye_calib.errors import ConfigError, InputError
from reproduction import (
    certificate,
    conclusions,
    figures,
    findings,
    hindsight,
    runner,
    tables,
)
from reproduction.published import KITTI, METHODS, SIMULATED
from reproduction.results import SIMULATION_METHODS, Results
from reproduction.rows import Cell, Row, cells, solve_plain
from reproduction.sources import PublishedSource, Source

Files = dict[str, list[Path]]


@dataclass(frozen=True)
class Artefact:
    """A figure, a table or a text, with its comparison."""

    # Files begin with it.
    name: str
    # What must be solved for it.
    cells: list[Cell]
    # Given the name and :class:`Results`, writes the files and returns their paths.
    write: Callable[[str, Results], list[Path]]
    # The kinds of source it can be made from.
    data: tuple[str, ...] = ("published", "simulated")

    def fits(self, source: Source) -> bool:
        """Whether a source has what it needs."""
        return source.data in self.data and all(
            cell.dataset in source.datasets for cell in self.cells
        )


def _artefacts() -> dict[str, Artefact]:
    everything = cells(SIMULATED, SIMULATION_METHODS) + cells(KITTI, METHODS)
    found = [
        Artefact("fig4", [], figures.write_components),
        *(
            Artefact(name, cells(SIMULATED, methods), figures.write_error_figure)
            for name, methods in figures.FIGURE_METHODS.items()
        ),
        *(
            Artefact(name, cells([dataset], METHODS), tables.write_summary_table)
            for name, dataset in tables.SUMMARY_TABLES.items()
        ),
        *(
            Artefact(name, cells([dataset], [method]), tables.write_variant_table)
            for name, (dataset, method) in tables.VARIANT_TABLES.items()
        ),
        Artefact("conclusions", everything, conclusions.write),
        Artefact("findings", everything, findings.write),
        Artefact("adaptive", [], hindsight.write),
        Artefact("certificate", [], certificate.write),
    ]
    return {artefact.name: artefact for artefact in found}


ARTEFACTS = _artefacts()
_S_FIGURES = tuple(name for name in figures.FIGURE_METHODS if name.startswith("figS"))
EXPERIMENTS = {
    **{name: (name,) for name in ("fig3", "fig4", "fig5", "table1", "table2")},
    "s-figures": _S_FIGURES,
    "s-tables": tuple(tables.VARIANT_TABLES),
    "adaptive": ("adaptive",),
    "certificate": ("certificate",),
    "all": (
        *("fig3", "fig4", "fig5", *_S_FIGURES, "table1", "table2", *tables.VARIANT_TABLES),
        *("conclusions", "findings"),
    ),
}


class Experiment:
    """An experiment of :data:`EXPERIMENTS` on a source of cases, compared with a published source
    if there is one. Raises ConfigError if the source has no cases of it.
    """

    def __init__(
        self, name: str, source: Source, theirs_source: PublishedSource | None = None
    ) -> None:
        artefacts = [ARTEFACTS[artefact] for artefact in EXPERIMENTS[name]]
        self.artefacts = [artefact for artefact in artefacts if artefact.fits(source)]
        self.left_out = [artefact.name for artefact in artefacts if artefact not in self.artefacts]
        if not self.artefacts:
            only = artefacts[0].data[0]
            raise ConfigError(
                f"{name} is about simulated drives; use --data simulated"
                if only == "simulated"
                else f"{name} is about recorded drives (KITTI), which are not simulated; use "
                "--data published"
            )
        self.cells = list(
            dict.fromkeys(cell for artefact in self.artefacts for cell in artefact.cells)
        )
        self._source, self._theirs_source = source, theirs_source

    def run(
        self,
        out: Path,
        jobs: int,
        on_done: Callable[[str], object] = lambda name: None,
    ) -> tuple[Results, Files]:
        """Solve what is not solved yet, and write the files into a directory; the solved cells are
        kept in ``solved.jsonl`` there. ``on_done`` is called with every cell's, then with every
        artefact's name. Gives the results, and the paths of the files of every artefact. Raises
        InputError if data cannot be read or files cannot be written.
        """
        if any(artefact.name.startswith("fig") for artefact in self.artefacts):
            # If Matplotlib is missing, say so before minutes of solving, not after.
            from reproduction import paper_figures  # noqa: F401
        configuration = {**self._source.configuration(), **runner.versions()}
        store = runner.Store(out / "solved.jsonl", configuration)
        tasks = {cell.name: (self._source, cell) for cell in self.cells}
        solved = runner.solve(solve_plain, tasks, jobs, store, on_done)
        rows = [Row.from_plain(row) for rows in solved.values() for row in rows]
        results = Results(self._source, self._theirs_source, rows, out, jobs)
        files = {}
        for artefact in self.artefacts:
            try:
                files[artefact.name] = artefact.write(artefact.name, results)
            except OSError as error:
                raise InputError(
                    f"cannot write {error.filename}: {error.strerror}; choose another "
                    "directory with --out"
                ) from None
            on_done(artefact.name)
        return results, files
