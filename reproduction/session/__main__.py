"""``python -m reproduction.session``: the studies of docs/measurements.md.

stop: is a session that is told to stop good enough? together: several recordings of one rig, for
one result. alarms, delays, loops: of the mount monitor.
"""

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from hand_eye_calib.cli.main import exit_code_of
from hand_eye_calib.errors import ConfigError
from reproduction.recordings import Rig, real_rigs
from reproduction.runner import Store, in_parallel, solve
from reproduction.session import mount, stop, together
from reproduction.writing import markdown_table, show, study_parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a study; returns the exit code."""
    parser = study_parser("reproduction.session", __doc__)
    parser.add_argument("study", choices=tuple(STUDIES))
    parser.add_argument(
        "--rows",
        metavar="DIR",
        type=Path,
        default=Path("reproduced"),
        help="where results are kept; what is there is not solved again. Default: reproduced",
    )
    parser.add_argument("--seeds", type=int, default=4, help="recordings of a class. Default: 4")
    parser.add_argument("--first-seed", type=int, default=0, help="fresh recordings. Default: 0")
    parser.add_argument(
        "--hours", type=float, default=5.0, help="simulated hours of a class. Default: 5"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes. Default: 1")
    return int(exit_code_of(lambda: run(parser.parse_args(argv))))


def run(arguments: argparse.Namespace) -> int:
    """Run the study; returns the exit code."""
    text = STUDIES[arguments.study](arguments)
    show(arguments.page, {f"session {arguments.study}": text})
    return 0


def _rigs(arguments: argparse.Namespace) -> list[Rig]:
    if arguments.data_folder is None:
        raise ConfigError("this study needs --data-folder: the folder of the real recordings")
    return real_rigs(arguments.data_folder)[0]


def _stop(arguments: argparse.Namespace) -> str:
    tables = []
    for name, recordings in (
        ("simulated", stop.simulated(arguments.seeds)),
        ("real", stop.real(_rigs(arguments))),
    ):
        store = Store(arguments.rows / f"stop_{name}.jsonl", {"study": "stop"})
        tasks = {recorded.name: (recorded,) for recorded in recordings}
        found = solve(stop.stops, tasks, arguments.jobs, store).values()
        tables.append(
            stop.table(
                [stop.Stop(**each) for plain in found for each in plain], name == "simulated"
            )
        )
    return "\n\n".join(["Simulated:", tables[0], "Real, cut off in the same way:", tables[1]])


def _together(arguments: argparse.Namespace) -> str:
    store = Store(arguments.rows / "together.jsonl", {"study": "together"})
    tasks = {
        f"{name} {seed}": (name, seed)
        for name in together.SIMULATED
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    }
    simulated = solve(together.simulated, tasks, arguments.jobs, store)
    rigs = [rig for rig in _rigs(arguments) if not rig.is_refused and len(rig.recordings) > 1]
    recorded = {f"{rig.name} {name}": (rig, name) for rig in rigs for name in rig.recordings}
    found = solve(together.real, recorded, arguments.jobs, store)
    return together.tables([*together.rigs_of(simulated, rigs, found)], arguments.first_seed)


def _alarms(arguments: argparse.Namespace) -> str:
    tasks = [(name, arguments.hours) for name in mount.WATCHED]
    return _watched(in_parallel(mount.false_alarms, tasks, arguments.jobs))


def _loops(arguments: argparse.Namespace) -> str:
    tasks = [
        (rig, name, arguments.hours)
        for rig in _rigs(arguments)
        if not rig.is_refused
        for name in rig.recordings
    ]
    return _watched(in_parallel(mount.real_loop, tasks, arguments.jobs))


def _watched(found: Sequence[mount.Watched]) -> str:
    def told(values: np.ndarray, most: float) -> str:
        return ", ".join(f"{value:.2g}" if value < most else "-" for value in values)

    groups: dict[str, list[mount.Watched]] = {}
    for each in found:
        groups.setdefault(re.split("[ _]", each.name)[0], []).append(each)
    rows = []
    for name, group in groups.items():
        visible = np.max([each.visible for each in group], axis=0)
        rows.append(
            {
                "recordings": f"{name} ({len(group)})",
                "hours": f"{sum(each.hours for each in group):g}",
                "alarms": sum(each.alarms for each in group),
                "x, y, z (cm)": told(100 * visible[:3], 100.0),
                "about x, y, z (deg)": told(np.degrees(visible[3:]), 17.0),
            }
        )
    hours, alarms = sum(each.hours for each in found), sum(each.alarms for each in found)
    return (
        f"{alarms} alarms in {hours:g} h of motion without a shift. The last columns: which shift "
        f"ten minutes of any of them would show nine times out of ten.\n\n{markdown_table(rows)}"
    )


def _delays(arguments: argparse.Namespace) -> str:
    tasks = [(kind, seed) for kind in mount.SHIFTED for seed in range(arguments.seeds)]
    found: list[mount.Delay] = sum(in_parallel(mount.delays, tasks, arguments.jobs), [])
    return markdown_table(
        {"motion": kind, "shift": size}
        | _delay_row([each for each in found if (each.kind, each.size) == (kind, size)])
        for kind in mount.SHIFTED
        for size in mount.SHIFTS
    )


def _delay_row(found: Sequence[mount.Delay]) -> dict[str, object]:
    said = np.array([each.seconds for each in found if each.announced <= 1.0])
    others = np.array([each.seconds for each in found if each.announced > 1.0])
    told = ["-", "-"]
    if len(said):
        quantiles = np.quantile(said, [0.5, 0.9], method="higher")
        told = [f"{value:.0f}" if np.isfinite(value) else "> 1800" for value in quantiles]
    return {
        "said to be seen": f"{len(said)} of {len(found)}",
        "of these seen": int(np.isfinite(said).sum()) if len(said) else "-",
        "median (s)": told[0],
        "90 % (s)": told[1],
        "others seen": f"{int(np.isfinite(others).sum())} of {len(others)}",
    }


STUDIES: dict[str, Callable[[argparse.Namespace], str]] = {
    "stop": _stop,
    "together": _together,
    "alarms": _alarms,
    "loops": _loops,
    "delays": _delays,
}

if __name__ == "__main__":
    sys.exit(main())
