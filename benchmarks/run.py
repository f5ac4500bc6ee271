"""Benchmarks against a checked-in baseline.

    OMP_NUM_THREADS=1 python benchmarks/run.py [--full] [--page FILE] [--update]

One thread, because the matrices are small: the idle threads of a BLAS pool would widen the spread
and save nothing. Processor time, so that other programs on the machine count little; of whole
processes the wall time as well. Each row is the median of several repeats, with half their range
beside it.

Times depend on the machine, so what is compared with ``baseline.json`` are ratios within this one
run: how many times faster the fast backend is than CasADi + Ipopt and OpenCV on the same pairs,
how near everything is to the floor, one pass of numpy over the same bytes, and whether the fast
backend ends no higher than Ipopt. A crash, a ratio that is missing or below a third of the
baseline's is a failure (exit code 1). ``--update`` writes a new baseline, of a run without
``--full``.

The 443 and 2,338 pairs are reference B5 of the two KITTI drives of Valimaki et al. 2023 where the
published data is found in ``$HAND_EYE_CALIB_DATA`` or ``../shared/data``, otherwise of simulated
drives of these lengths.
"""

import argparse
import json
import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

sys.path[:0] = [
    str(Path(__file__).resolve().parent),
    str(Path(__file__).resolve().parents[1]),
]

from suite import baseline, processes, rows, table  # noqa: E402
from suite.data import LONG, MESSAGES, SHORT, drives  # noqa: E402

BASELINE = Path(__file__).resolve().parent / "baseline.json"
USUAL = (100, SHORT, LONG, 10_000, 100_000)
FULL = (1_000_000,)


def everything(is_full):
    """Where the drives come from, all rows, and the memory by number of pairs."""
    sizes = USUAL + (FULL if is_full else ())
    source, found = drives(sizes)
    measured = []
    for drive in found.values():
        measured += rows.solver_rows(drive, is_full)
    measured += rows.opencv_rows(found)
    measured += rows.engine_rows(MESSAGES)
    measured += rows.bag_rows(MESSAGES)
    measured += processes.process_rows(found)
    return source, measured, processes.memory(sizes[4:])


def versions():
    """What the times depend on."""
    found = [f"python {platform.python_version()}", f"cores {os.cpu_count()}"]
    for name in (
        "numpy",
        "scipy",
        "casadi",
        "rosbags",
        "opencv-python-headless",
    ):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


def main(arguments=None):
    """Run everything; exit code."""
    parser = argparse.ArgumentParser(
        description="Benchmarks of hand_eye_calib against the checked-in baseline."
    )
    parser.add_argument(
        "--full",
        action="store_true",
        help="10^6 pairs, and the slow methods on 10^5 as well",
    )
    parser.add_argument(
        "--page",
        type=Path,
        metavar="FILE",
        help="put the tables into this page",
    )
    parser.add_argument(
        "--update",
        action="store_true",
        help="write a new baseline instead of comparing",
    )
    options = parser.parse_args(arguments)
    if options.update and options.full:
        parser.error("the baseline is of a run without --full")

    source, measured, memory = everything(options.full)
    tables = table.tables(source, measured, memory)
    table.show(tables)
    if options.page:
        typed = " ".join(
            ["python benchmarks/run.py", *(arguments or sys.argv[1:])]
        )
        note = f"Measured by `OMP_NUM_THREADS=1 {typed}` with {versions()}.\n"
        table.write(tables, options.page, note)
    known = json.loads(BASELINE.read_text(encoding="utf-8"))
    ratios = baseline.ratios(measured, memory)
    if options.update:
        known[source] = {
            name: float(f"{ratio:.2g}") for name, ratio in ratios.items()
        }
        BASELINE.write_text(
            json.dumps(known, indent=2) + "\n", encoding="utf-8"
        )
        return 0
    found = baseline.failures(measured, ratios, known[source])
    told = "\n".join(found) or f"all {len(measured)} rows within the baseline"
    print(told, file=sys.stderr if found else sys.stdout)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
