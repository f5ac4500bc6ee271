"""What an experiment has solved, for those who write its files."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from reproduction import statistics
from reproduction.published import LEVELS, METHODS, SIMULATED
from reproduction.rows import ALI_AS_PUBLISHED, Row
from reproduction.sources import PublishedSource, Source
from reproduction.statistics import Table

SIMULATION_METHODS = (*METHODS, ALI_AS_PUBLISHED)


@dataclass(frozen=True)
class Results:
    """Solved rows and the output directory."""

    source: Source
    # Source of the published results to compare with.
    theirs_source: PublishedSource | None
    rows: list[Row]
    out: Path
    # Number of processes of the studies, which are not solved cell by cell.
    jobs: int = 1

    @property
    def same_cases(self) -> bool:
        """Whether ours and the published results are of the same trajectories."""
        return self.source == self.theirs_source

    @property
    def n_runs(self) -> int:
        """Number of runs per level of the simulated data sets."""
        return self.source.runs

    @cached_property
    def ours(self) -> Table:
        """:class:`~reproduction.statistics.Table` of our errors."""
        return statistics.of_rows(self.rows)

    @cached_property
    def theirs(self) -> Table | None:
        """Table of the published errors; None without published data."""
        if self.same_cases:
            return statistics.of_rows(self.rows, "published")
        if self.theirs_source is None:
            return None
        cases = (
            case
            for dataset in SIMULATED
            for level in LEVELS[dataset]
            for case in self.theirs_source.cases(dataset, level)
        )
        return statistics.theirs_of_cases(cases, SIMULATION_METHODS)

    def of(self, dataset: str, method: str) -> list[Row]:
        """Rows of a method on a data set."""
        return [row for row in self.rows if (row.dataset, row.method) == (dataset, method)]
