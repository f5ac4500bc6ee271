"""``python -m reproduction.gate``: did a change make errors or stated uncertainties worse?

The gate calibrates simulated recordings of every class of the coverage study and of random
platforms. With --data-folder, it also calibrates real recordings with a known extrinsic, whole and
in pieces. A stored baseline contains scores of the same recordings. The exit code is 1 if new
scores are worse than the baseline by more than a tolerance.

--against FOLDER compares with another version of the package instead, on new recordings. FOLDER
contains ``hand_eye_calib``.
"""

import os
import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.offline.cli.main import exit_code_of
from hand_eye_calib.offline.cli.options import note
from reproduction.coverage.classes import CLASSES
from reproduction.coverage.mixed import MIXED
from reproduction.gate import against
from reproduction.gate.baseline import (
    Baseline,
    Comparison,
    compare,
    compare_new_draw,
)
from reproduction.gate.cases import real_cases, simulated_cases
from reproduction.gate.scores import Score, score, score_simulated
from reproduction.runner import in_parallel
from reproduction.writing import markdown_table, seed_of, show, study_parser

BASELINE = Path(__file__).with_name("baseline.json")

# Number of recordings of each family.
USUAL = dict.fromkeys(CLASSES, 10) | dict.fromkeys(MIXED, 16)
QUICK = dict.fromkeys(CLASSES, 3) | dict.fromkeys(MIXED, 6)
_NEW_DRAW = dict.fromkeys(MIXED, 12)
# Number of pieces of each real recording.
_PIECES = 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run the gate, and return the exit code."""
    parser = study_parser("reproduction.gate", __doc__)
    add = parser.add_argument
    add(
        "--quick",
        action="store_true",
        help="fewer recordings, simulated ones only: one minute",
    )
    add(
        "--update",
        action="store_true",
        help="store the scores as the new baseline",
    )
    add(
        "--baseline",
        metavar="FILE",
        type=Path,
        default=BASELINE,
        help="default: the stored one",
    )
    add(
        "--jobs",
        type=int,
        default=os.cpu_count() or 1,
        help="processes. Default: all cores",
    )
    add(
        "--against",
        metavar="FOLDER",
        type=Path,
        help="folder with another version",
    )
    add(
        "--pieces",
        type=int,
        default=_PIECES,
        help="with --against: pieces of each real recording",
    )
    add(
        "--repeats",
        type=int,
        default=4,
        help="with --against: recordings of each platform",
    )
    add(
        "--seed",
        type=int,
        help="with --update or --against: draw other recordings",
    )
    return exit_code_of(lambda: _run(parser.parse_args(argv)))


def _run(arguments: Namespace) -> int:
    if arguments.against:
        return _against(arguments)
    if arguments.update:
        return _update(arguments)
    if arguments.seed is not None:
        raise ConfigError(
            "--seed goes with --update or --against: the baseline has a seed"
        )
    return _check(arguments)


def _check(arguments: Namespace) -> int:
    """Compare with the baseline; return 1 if a value is worse."""
    baseline = Baseline.read(arguments.baseline)
    numbers = QUICK if arguments.quick else USUAL
    folder = None if arguments.quick else arguments.data_folder
    scores = measure(baseline.seed, numbers, folder, arguments.jobs)
    unknown = [
        score.name for score in scores if score.name not in baseline.scores
    ]
    if unknown:
        raise ConfigError(
            f"the baseline has no score of {unknown[0]} and {len(unknown) - 1} other recordings. "
            "Add them with --update"
        )
    comparisons = compare(scores, baseline)
    if not arguments.quick:
        new_scores = measure(seed_of(None), _NEW_DRAW, None, arguments.jobs)
        old_scores = [
            score for score in baseline.scores.values() if score.family in MIXED
        ]
        comparisons.append(compare_new_draw(new_scores, old_scores))
    show(arguments.page, {"baseline": _report(comparisons, baseline)})
    return 1 if any(comparison.failures for comparison in comparisons) else 0


def _report(comparisons: Sequence[Comparison], baseline: Baseline) -> str:
    failures: list[str] = []
    for comparison in comparisons:
        failures += comparison.failures
    table = markdown_table([comparison.row for comparison in comparisons])
    lines = [
        table,
        "",
        f"In brackets: the baseline, seed {baseline.seed}, {baseline.versions}.",
    ]
    if failures:
        lines += [f"Worse than the baseline ({versions()}):"]
        lines += [f"- {failure}" for failure in failures]
        lines += [
            "If that is meant, store new scores: make gate GATE_ARGS=--update"
        ]
    else:
        lines += ["Not worse than the baseline."]
    return "\n".join(lines)


def _update(arguments: Namespace) -> int:
    """Store scores. Scores of recordings that are not solved here are kept if the seed is kept."""
    stored: dict[str, Score] = {}
    seed = arguments.seed
    if arguments.baseline.exists():
        baseline = Baseline.read(arguments.baseline)
        if seed in (None, baseline.seed):
            seed = baseline.seed
            stored = baseline.scores
    seed = seed_of(seed)
    scores = measure(seed, USUAL, arguments.data_folder, arguments.jobs)
    measured = {score.name: score for score in scores}
    kept = len(stored.keys() - measured.keys())
    if kept:
        note(
            f"{kept} scores are kept: their recordings are not on this computer"
        )
    Baseline(seed, versions(), stored | measured).write(arguments.baseline)
    print(f"{len(measured)} scores in {arguments.baseline}")
    return 0


def measure(
    seed: int, numbers: Mapping[str, int], folder: Path | None, jobs: int
) -> list[Score]:
    """Score simulated recordings, then real ones if there is a folder of them."""
    draws: list[tuple[str, int, int]] = []
    for family, count in numbers.items():
        draws += [(family, seed, number) for number in range(count)]
    scores = [*in_parallel(score_simulated, draws, jobs)]
    if folder is not None:
        cases = real_cases(folder, _PIECES, np.random.default_rng(seed))
        scores += in_parallel(score, [(case,) for case in cases], jobs)
    return scores


def _against(arguments: Namespace) -> int:
    """Compare with another version; differences do not change the exit code."""
    seed = seed_of(arguments.seed)
    cases = [*simulated_cases(seed, arguments.repeats)]
    if arguments.data_folder:
        rng = np.random.default_rng(seed)
        cases = [
            *real_cases(arguments.data_folder, arguments.pieces, rng),
            *cases,
        ]
    package = Path(__file__).resolve().parents[2]
    table = against.table(cases, package, arguments.against)
    show(
        arguments.page,
        {"gate": f"Seed {seed}, {len(cases)} recordings.\n\n{table}"},
    )
    return 0


def versions() -> str:
    """Return the versions of Python, NumPy and SciPy, which change the last bits of results."""
    names = [f"{name} {version(name)}" for name in ("numpy", "scipy")]
    return ", ".join([f"python {sys.version.split()[0]}", *names])


if __name__ == "__main__":
    sys.exit(main())
