"""Benchmarks against a checked-in baseline.

    OMP_NUM_THREADS=1 python benchmarks/run.py [--full] [--page FILE] [--update]

The benchmarks use one thread: the matrices are small, and idle threads of a BLAS pool would only
scatter the times. They measure processor time, which other programs hardly change. For whole
processes, they also measure wall time. A row is the median of several repeats, with half of their
range.

Times depend on the machine, so only ratios within this run are compared with ``baseline.json``:

- how many times faster the fast backend is than CasADi + Ipopt, and than OpenCV, on the same pairs;
- how near each row is to the floor, which is one pass of numpy over the same bytes.

The objective of the fast backend must not be above that of Ipopt. The exit code is 1 after a
crash, or if a ratio is missing or below a third of the baseline's. ``--update`` writes a new
baseline, from a run without ``--full``.

443 and 2,338 are the numbers of pairs of reference B5 in the two KITTI drives of Valimaki et al.
2023. Without the published data in ``$HAND_EYE_CALIB_DATA`` or ``../shared/data``, simulated drives
of the same lengths are used.
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
    """Return the source of the drives, all rows, and the memory by number of pairs."""
    sizes = USUAL + (FULL if is_full else ())
    source, drive_of_size = drives(sizes)
    measured = []
    for drive in drive_of_size.values():
        measured += rows.solver_rows(drive, is_full)
    measured += rows.opencv_rows(drive_of_size)
    measured += rows.engine_rows(MESSAGES)
    measured += rows.bag_rows(MESSAGES)
    measured += processes.process_rows(drive_of_size)
    return source, measured, processes.memory(sizes[4:])


def versions():
    """Return the versions of Python and packages, and the number of cores."""
    texts = [f"python {platform.python_version()}", f"cores {os.cpu_count()}"]
    for name in (
        "numpy",
        "scipy",
        "casadi",
        "rosbags",
        "opencv-python-headless",
    ):
        try:
            texts.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(texts)


def main(arguments=None):
    """Run all benchmarks, and return the exit code."""
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
        command = " ".join(
            ["python benchmarks/run.py", *(arguments or sys.argv[1:])]
        )
        note = f"Measured by `OMP_NUM_THREADS=1 {command}` with {versions()}.\n"
        table.write(tables, options.page, note)
    stored = json.loads(BASELINE.read_text(encoding="utf-8"))
    ratios = baseline.ratios(measured, memory)
    if options.update:
        stored[source] = {
            name: float(f"{ratio:.2g}") for name, ratio in ratios.items()
        }
        BASELINE.write_text(
            json.dumps(stored, indent=2) + "\n", encoding="utf-8"
        )
        return 0
    failures = baseline.failures(measured, ratios, stored[source])
    if failures:
        print("\n".join(failures), file=sys.stderr)
        return 1
    print(f"all {len(measured)} rows within the baseline")
    return 0


if __name__ == "__main__":
    sys.exit(main())
