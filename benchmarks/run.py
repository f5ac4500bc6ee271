"""Benchmarks against a checked-in baseline.

    OMP_NUM_THREADS=1 python benchmarks/run.py [--full] [--all] [--json FILE] [--figure FILE]
    [--page FILE] [--update]

One thread, because the matrices are small: the idle threads of a BLAS pool would widen the spread
and save nothing. Processor time, so that other programs on the machine count little; of whole
processes the wall time as well. Each row is the median of several repeats, with half their range
beside it.

Times depend on the machine, so what is compared with ``baseline.json`` is which rows there are and
ratios within this one run: how many times faster the fast backend is than CasADi + Ipopt and OpenCV
on the same pairs, how near everything is to the floor, one pass of numpy over the same bytes, and
whether the fast backend ends no higher than Ipopt. A crash, a row that the baseline has and the run
has not, or a ratio below a third of the baseline's is a failure (exit code 1). ``--update`` writes
a new baseline, of a run without ``--full`` and ``--all``.

The 443 and 2,338 pairs are reference B5 of the two KITTI drives of Valimaki et al. 2023 where the
published data is found in ``$HAND_EYE_CALIB_DATA`` or ``../shared/data``, otherwise of simulated
drives of these lengths.
"""

import argparse
import json
import os
import platform
import sys
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]

from suite import baseline, figure, processes, rows, table  # noqa: E402
from suite.data import BAG_MESSAGES, ENGINE_MESSAGES, LONG, SHORT, drives  # noqa: E402

BASELINE = Path(__file__).resolve().parent / "baseline.json"
USUAL, FULL = (100, SHORT, LONG, 10_000, 100_000), (1_000_000,)


def everything(options):
    """Where the drives come from, all rows, and the memory by number of pairs."""
    sizes = USUAL + (FULL if options.full else ())
    source, found = drives(sizes)
    measured = []
    for drive in found.values():
        measured += rows.solver_rows(drive, options.full)
    measured += rows.opencv_rows(found, options.all)
    measured += rows.engine_rows(ENGINE_MESSAGES)
    measured += processes.process_rows(found)
    measured += processes.bag_rows(BAG_MESSAGES)
    return source, measured, processes.memory(sizes[4:])


def versions():
    """What the times depend on."""
    found = {"python": platform.python_version(), "cores": os.cpu_count()}
    for name in ("numpy", "scipy", "casadi", "rosbags", "opencv-python-headless"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


def main(arguments=None):
    """Run everything; exit code."""
    parser = argparse.ArgumentParser(
        description="Benchmarks of hand_eye_calib against the checked-in baseline."
    )
    parser.add_argument(
        "--full", action="store_true", help="10^6 pairs, and the slow methods on 10^5 as well"
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="all methods of OpenCV on the long drive, not only its fastest",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to this file")
    parser.add_argument(
        "--figure", type=Path, metavar="FILE", help="draw the growth curves into this file"
    )
    parser.add_argument(
        "--page",
        type=Path,
        metavar="FILE",
        help="put the tables into this page of the documentation",
    )
    parser.add_argument(
        "--update", action="store_true", help="write a new baseline instead of comparing"
    )
    options = parser.parse_args(arguments)
    if options.update and (options.full or options.all):
        parser.error("the baseline is of a run without --full and --all")

    source, measured, memory = everything(options)
    tables = table.tables(source, measured, memory)
    table.show(tables)
    if options.json:
        document = {
            "source": source,
            "versions": versions(),
            "rows": list(map(asdict, measured)),
            "memory": memory,
        }
        document["ratios"] = baseline.ratios(measured, memory)
        options.json.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    if options.figure:
        figure.draw(measured, options.figure)
    if options.page:
        used = ", ".join(f"{name} {number}" for name, number in versions().items() if number)
        typed = " ".join(
            ["python benchmarks/run.py", *(sys.argv[1:] if arguments is None else arguments)]
        )
        table.write(tables, options.page, f"Measured by `OMP_NUM_THREADS=1 {typed}` with {used}.\n")
    known = json.loads(BASELINE.read_text(encoding="utf-8")) if BASELINE.exists() else {}
    if options.update:
        known[source] = baseline.summary(measured, memory)
        BASELINE.write_text(json.dumps(known, indent=2) + "\n", encoding="utf-8")
        return 0
    if source not in known:
        print(
            f"no baseline for {source} drives in {BASELINE.name}; run with --update",
            file=sys.stderr,
        )
        return 1
    found = baseline.failures(measured, memory, known[source], is_more=options.full or options.all)
    print(
        "\n".join(found) if found else f"all {len(measured)} rows within the baseline",
        file=sys.stderr if found else sys.stdout,
    )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
