"""``python -m reproduction.session``: the studies of docs/session.md.

stop: is a session that is told to stop good enough? compare: do recordings of one rig agree, and
are shifts found? alarms, delays, loops, memory: of the mount monitor.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from hand_eye_calib.cli.main import exit_code_of
from hand_eye_calib.errors import ConfigError
from reproduction.coverage.real_sets import Rig, real_rigs
from reproduction.runner import in_parallel
from reproduction.session import mount, pairs, prefixes, stop_rule
from reproduction.writing import markdown_table, put_into_page

_METHOD = "auto"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a study; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m reproduction.session", description=__doc__, allow_abbrev=False
    )
    parser.add_argument("study", choices=tuple(STUDIES))
    parser.add_argument(
        "--data-folder",
        metavar="DIR",
        type=Path,
        help="folder of the real recordings. Default: $HAND_EYE_CALIB_DATA",
    )
    parser.add_argument(
        "--rows",
        metavar="DIR",
        type=Path,
        default=Path("reproduced"),
        help="where results are kept; what is there is not solved again. Default: reproduced",
    )
    parser.add_argument("--seeds", type=int, default=4, help="recordings of a class. Default: 4")
    parser.add_argument(
        "--hours", type=float, default=5.0, help="simulated hours of a class. Default: 5"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes. Default: 1")
    parser.add_argument("--page", metavar="FILE", type=Path, help="put the tables into this page")
    return int(exit_code_of(lambda: run(parser.parse_args(argv))))


def run(arguments: argparse.Namespace) -> int:
    """Run the study; returns the exit code."""
    arguments.rows.mkdir(parents=True, exist_ok=True)
    text = STUDIES[arguments.study](arguments)
    print(text)
    if arguments.page:
        put_into_page(arguments.page, f"session {arguments.study}", text)
    return 0


def _rigs(arguments: argparse.Namespace) -> list[Rig]:
    folder = arguments.data_folder or os.environ.get("HAND_EYE_CALIB_DATA")
    if not folder:
        raise ConfigError("this study needs --data-folder: the folder of the real recordings")
    return real_rigs(Path(folder))[0]


def _stop(arguments: argparse.Namespace) -> str:
    simulated = stop_rule.solve(
        prefixes.simulated(arguments.seeds), arguments.rows / "stop_simulated.jsonl", _METHOD
    )
    real = stop_rule.solve(
        prefixes.real(_rigs(arguments)), arguments.rows / "stop_real.jsonl", _METHOD
    )
    tables = [
        stop_rule.table([stop_rule.stopped(kept, f) for kept in group for f in stop_rule.FACTORS])
        for group in (simulated, real)
    ]
    return "\n\n".join(["Simulated:", tables[0], "Real, cut off in the same way:", tables[1]])


def _compare(arguments: argparse.Namespace) -> str:
    rigs = [rig for rig in _rigs(arguments) if not rig.is_refused]
    found = pairs.compared(pairs.solve(rigs, arguments.rows / "compare.jsonl"))
    return f"{pairs.summary(found)}\n\n{pairs.table(found)}"


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
    rows = [
        (w.name, f"{w.hours:g}", w.alarms, f"{w.long_run:.1f}", *_visible(w.visible)) for w in found
    ]
    hours, alarms = sum(w.hours for w in found), sum(w.alarms for w in found)
    header = ("recordings", "hours", "alarms", "f", "x, y, z (cm)", "roll, pitch, yaw (deg)")
    return (
        f"{alarms} alarms in {hours:g} h of motion without a shift. The last columns: which shift "
        "ten minutes of motion would show nine times out of ten.\n\n" + markdown_table(header, rows)
    )


def _visible(visible: np.ndarray) -> tuple[str, str]:
    def told(values: np.ndarray, most: float) -> str:
        return ", ".join(f"{value:.2g}" if value < most else "-" for value in values)

    return told(100 * visible[:3], 100.0), told(np.degrees(visible[3:]), 17.0)


def _delays(arguments: argparse.Namespace) -> str:
    tasks = [(kind, seed) for kind in mount.SHIFTED for seed in range(arguments.seeds)]
    return _delay_table(sum(in_parallel(mount.delays, tasks, arguments.jobs), []))


def _delay_table(found: Sequence[mount.Delay]) -> str:
    rows = [
        (kind, size, *_delay_row([d for d in found if (d.kind, d.size) == (kind, size)]))
        for kind in mount.SHIFTED
        for size in mount.SHIFTS
    ]
    header = ("motion", "shift", "said to be seen", "of these seen", "median (s)", "90 % (s)",
              "others seen")  # fmt: skip
    return markdown_table(header, rows)


def _delay_row(found: Sequence[mount.Delay]) -> tuple[object, ...]:
    said = np.array([d.seconds for d in found if d.announced <= 1.0])
    others = np.array([d.seconds for d in found if d.announced > 1.0])
    seen = np.isfinite(said)
    told = [
        f"{value:.0f}" if np.isfinite(value) else "> 1800"
        for value in (np.quantile(said, [0.5, 0.9], method="higher") if len(said) else ())
    ]
    return (
        f"{len(said)} of {len(found)}", int(seen.sum()) if len(said) else "-",
        *(told or ("-", "-")), f"{int(np.isfinite(others).sum())} of {len(others)}",
    )  # fmt: skip


def _memory(arguments: argparse.Namespace) -> str:
    early, late = mount.memory_mb("agv_long", 1000.0)
    return (
        f"Largest memory of the process: {early:.0f} MB after 10 hours, {late:.0f} MB after 1,000 "
        "hours of a robot that drives for a minute of each."
    )


STUDIES: dict[str, Callable[[argparse.Namespace], str]] = {
    "stop": _stop,
    "compare": _compare,
    "alarms": _alarms,
    "loops": _loops,
    "delays": _delays,
    "memory": _memory,
}

if __name__ == "__main__":
    sys.exit(main())
