"""``python -m reproduction.coverage``: the coverage study from one command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from hand_eye_calib.cli.console import note
from hand_eye_calib.cli.main import exit_code_of
from hand_eye_calib.config import METHODS as KNOWN_METHODS
from hand_eye_calib.errors import ConfigError
from reproduction.coverage import study
from reproduction.coverage.measures import worsened
from reproduction.coverage.page import page
from reproduction.coverage.real_sets import Rig, real_rigs
from reproduction.coverage.scores import METHODS

_METHODS = tuple(name for name in METHODS if name in KNOWN_METHODS)
_SEEDS = 10


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; returns the exit code: 1 if a row got worse."""
    parser = argparse.ArgumentParser(
        prog="python -m reproduction.coverage", description=__doc__, allow_abbrev=False
    )
    _add_arguments(parser)
    return int(exit_code_of(lambda: run(parser.parse_args(argv))))


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data-folder",
        metavar="DIR",
        type=Path,
        help="folder of the real recordings (valimaki2023, euroc_vio, ...). Default: "
        "$HAND_EYE_CALIB_DATA; without it, simulated recordings only",
    )
    parser.add_argument(
        "--methods", default=",".join(_METHODS), help=f"Default: {','.join(_METHODS)}"
    )
    parser.add_argument(
        "--seeds", type=int, default=_SEEDS, help=f"recordings per class. Default: {_SEEDS}"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--page", metavar="FILE", type=Path, help="write the page there")
    parser.add_argument("--rows", metavar="FILE", type=Path, help="write the rows there (JSON)")
    parser.add_argument(
        "--update-baseline", action="store_true", help="store the rows instead of comparing"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the study; returns the exit code."""
    methods = arguments.methods.split(",")
    _check(arguments, methods)
    rigs, absent = _rigs(arguments.data_folder)
    rows = study.measure(rigs, methods, arguments.seeds, arguments.jobs)
    text = page(rows, study.load(study.VERSION_0_1), absent, arguments.seeds)
    print(text)
    if arguments.page:
        arguments.page.write_text(text, encoding="utf-8")
    if arguments.rows:
        study.save(rows, arguments.rows)
    if arguments.update_baseline:
        study.save(rows, study.BASELINE)
        return 0
    worse = worsened(rows, study.load(study.BASELINE))
    for one in worse:
        note(f"worse: {one}")
    return 1 if worse else 0


def _check(arguments: argparse.Namespace, methods: Sequence[str]) -> None:
    unknown = [method for method in methods if method not in _METHODS]
    if unknown:
        raise ConfigError(f"--methods must be of {', '.join(_METHODS)}; got {unknown[0]}")
    if arguments.seeds < 1 or arguments.jobs < 1:
        raise ConfigError("--seeds and --jobs must be at least 1")
    if arguments.update_baseline and set(methods) != set(_METHODS):
        raise ConfigError("--update-baseline stores all methods; leave out --methods")


def _rigs(folder: Path | None) -> tuple[list[Rig], list[str]]:
    given = folder or os.environ.get("HAND_EYE_CALIB_DATA")
    return real_rigs(Path(given)) if given else ([], ["every real recording"])


if __name__ == "__main__":
    sys.exit(main())
