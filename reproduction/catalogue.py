"""Experiments by name: the cells each needs and the files it writes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hand_eye_calib.errors import ConfigError
from reproduction import certificate, conclusions, figures, findings, hindsight, tables
from reproduction.published import KITTI, METHODS, SIMULATED
from reproduction.results import SIMULATION_METHODS, Results
from reproduction.rows import Cell, cells
from reproduction.sources import Source


@dataclass(frozen=True)
class Artefact:
    """A figure, a table or a text, with its comparison."""

    # Files begin with it.
    name: str
    # What must be solved for it.
    cells: list[Cell]
    # Given the name and :class:`Results`, writes the files and returns their paths.
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
_STUDIES = [
    Artefact("adaptive", [], hindsight.write),
    Artefact("certificate", [], certificate.write),
]
ARTEFACTS = {artefact.name: artefact for artefact in [*_PAPER, *_STUDIES]}
GROUPS = {
    "s-figures": [each for each in _FIGURES if each.name.startswith("figS")],
    "s-tables": _VARIANTS,
    "all": _PAPER,
}


def artefacts_of(identifier: str, source: Source) -> tuple[list[Artefact], list[str]]:
    """The artefacts of an experiment that can be made from a source, and the names of the others.
    Raises ConfigError if there are none.
    """
    wanted = GROUPS.get(identifier) or [ARTEFACTS[identifier]]
    fitting = [
        artefact
        for artefact in wanted
        if all(cell.dataset in source.datasets for cell in artefact.cells)
    ]
    if not fitting:
        raise ConfigError(
            f"{identifier} is about the KITTI drives, and the simulator has none; use "
            "--data published"
        )
    return fitting, [artefact.name for artefact in wanted if artefact not in fitting]
