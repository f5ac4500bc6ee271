"""``python -m reproduction.session``: studies of docs/measurements.md.

stop: errors at the end of a session. ramps: the same for vehicles that drive over ramps.
together: one result from several recordings of a rig. alarms: false alarms of the mount monitor.
delays: time until the mount monitor detects a shift.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hand_eye_calib.offline.cli.main import exit_code_of
from reproduction.recordings import Rig, real_rigs
from reproduction.runner import in_parallel, kept
from reproduction.session import mount, ramps, stop, together
from reproduction.writing import (
    add_seed_options,
    seeds_of,
    show,
    study_parser,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a study, and return the exit code."""
    parser = study_parser("reproduction.session", __doc__)
    add = parser.add_argument
    add("study", choices=tuple(STUDIES))
    out = Path("reproduced")
    about = "folder of stored results, which are not computed again"
    add(
        "--rows",
        metavar="DIR",
        type=Path,
        default=out,
        help=f"{about}. Default: {out}",
    )
    add_seed_options(parser, 4)
    add(
        "--hours",
        type=float,
        default=5.0,
        help="simulated hours of a class. Default: 5",
    )
    add("--jobs", type=int, default=1, help="processes. Default: 1")
    return int(exit_code_of(lambda: run(parser.parse_args(argv))))


def run(arguments: argparse.Namespace) -> int:
    """Run the study, print its text, and return the exit code."""
    text = STUDIES[arguments.study](arguments)
    show(arguments.page, {f"session {arguments.study}": text})
    return 0


def _rigs(arguments: argparse.Namespace) -> list[Rig]:
    return real_rigs(arguments.data_folder)[0] if arguments.data_folder else []


_ABOUT_RULES = (
    "Other rules on the same simulated results. The cells contain, for each target: the sessions "
    "that ended; the share whose worst axis was within its target; the largest error as a "
    "multiple of the target; the median of the seconds beyond the earliest end."
)


def _stop(arguments: argparse.Namespace) -> str:
    tables = []
    rules = ""
    for name, recordings in (
        ("simulated", stop.simulated(arguments.seeds, arguments.first_seed)),
        ("real", stop.real(_rigs(arguments))),
    ):
        tasks = {recorded.name: (recorded,) for recorded in recordings}
        path = arguments.rows / f"stop_{name}.jsonl"
        records = kept(path, stop.stops, tasks, arguments.jobs).values()
        stops = [stop.Stop(**fields) for plain in records for fields in plain]
        tables.append(stop.table(stops, name))
        if name == "simulated":
            rules = stop.rules_table(stops)
    texts = [
        "Simulated:",
        tables[0],
        "Real, cut off in the same way:",
        tables[1],
    ]
    return "\n\n".join([*texts, _ABOUT_RULES, rules])


def _ramps(arguments: argparse.Namespace) -> str:
    seeds = seeds_of(arguments)
    rows_of_seeds = in_parallel(
        ramps.ends, [(seed,) for seed in seeds], arguments.jobs
    )
    return ramps.table([row for rows in rows_of_seeds for row in rows])


def _together(arguments: argparse.Namespace) -> str:
    seeds = seeds_of(arguments)
    tasks = {
        f"{name} {seed}": (name, seed)
        for name in together.SIMULATED
        for seed in seeds
    }
    path = arguments.rows / "together_simulated.jsonl"
    jobs = arguments.jobs
    simulated = kept(path, together.simulated, tasks, jobs)
    rigs = [
        rig
        for rig in _rigs(arguments)
        if not rig.is_refused and len(rig.recordings) > 1
    ]
    recorded = {
        f"{rig.name} {name}": (rig, name)
        for rig in rigs
        for name in rig.recordings
    }
    rigs_solved = kept(
        arguments.rows / "together_real.jsonl", together.real, recorded, jobs
    )
    return together.tables(
        [*together.rigs_of(simulated, rigs, rigs_solved)], arguments.first_seed
    )


def _alarms(arguments: argparse.Namespace) -> str:
    tasks = [(name, arguments.hours) for name in mount.WATCHED]
    return mount.alarm_table(
        [*in_parallel(mount.false_alarms, tasks, arguments.jobs)]
    )


def _delays(arguments: argparse.Namespace) -> str:
    tasks = [
        (kind, seed)
        for kind in mount.SHIFTED
        for seed in range(arguments.seeds)
    ]
    delays_of_tasks = in_parallel(mount.delays, tasks, arguments.jobs)
    return mount.delay_table(
        [delay for several in delays_of_tasks for delay in several]
    )


STUDIES: dict[str, Callable[[argparse.Namespace], str]] = {
    "stop": _stop,
    "ramps": _ramps,
    "together": _together,
    "alarms": _alarms,
    "delays": _delays,
}

if __name__ == "__main__":
    sys.exit(main())
