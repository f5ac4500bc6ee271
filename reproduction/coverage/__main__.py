"""``python -m reproduction.coverage``: the coverage study from one command."""

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hand_eye_calib.cli.main import exit_code_of
from hand_eye_calib.errors import ConfigError
from reproduction.coverage import study
from reproduction.coverage.measures import KINDS
from reproduction.coverage.page import page
from reproduction.coverage.scores import METHODS
from reproduction.recordings import real_rigs
from reproduction.writing import study_parser, write_csv

_METHODS = tuple(METHODS)
_SEEDS = 10


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; returns the exit code."""
    parser = study_parser("reproduction.coverage", __doc__, page="write the page there")
    for name, known in (("--methods", _METHODS), ("--tables", study.TABLES)):
        parser.add_argument(name, default=",".join(known), help=f"Default: {','.join(known)}")
    parser.add_argument(
        "--seeds", type=int, default=_SEEDS, help=f"recordings per class. Default: {_SEEDS}"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--rows", metavar="FILE", type=Path, help="write all rows there (CSV)")
    return int(exit_code_of(lambda: run(parser.parse_args(argv))))


def run(arguments: argparse.Namespace) -> int:
    """Run the study; returns the exit code."""
    plan, absent = _plan(arguments)
    rows = study.measure(plan, arguments.jobs)
    text = page(rows, absent, arguments.seeds)
    print(text)
    if arguments.page:
        arguments.page.write_text(text, encoding="utf-8")
    if arguments.rows:
        names = ("table", "name", "method")
        named = [{name: getattr(row, name) for name in names} for row in rows]
        values = [{kind: row.value(kind) for kind in KINDS} for row in rows]
        write_csv(arguments.rows, [{**a, **b} for a, b in zip(named, values, strict=True)])
    return 0


def _plan(arguments: argparse.Namespace) -> tuple[study.Plan, list[str]]:
    """What to measure, and the folders of recordings that are absent."""
    methods = _chosen("--methods", arguments.methods, _METHODS)
    tables = _chosen("--tables", arguments.tables, study.TABLES)
    if arguments.seeds < 1 or arguments.jobs < 1:
        raise ConfigError("--seeds and --jobs must be at least 1")
    given = arguments.data_folder
    plan = study.Plan(methods=methods, tables=tables, seeds=arguments.seeds)
    if not given:
        return plan, ["every real recording"]
    rigs, absent = real_rigs(given)
    published = None if "valimaki2023" in absent else given / "valimaki2023"
    return replace(plan, rigs=tuple(rigs), published=published), absent


def _chosen(option: str, text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    chosen = tuple(text.split(","))
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise ConfigError(f"{option} must be of {', '.join(known)}; got {unknown[0]}")
    return chosen


if __name__ == "__main__":
    sys.exit(main())
