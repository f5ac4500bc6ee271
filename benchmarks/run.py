"""Benchmarks against a checked-in baseline.

    OMP_NUM_THREADS=1 python benchmarks/run.py [--repeats N] [--json FILE] [--update]

One thread, because the matrices are small: the idle threads of a BLAS pool would widen the spread and save nothing.
Times depend on the machine, so what is compared with ``baseline.json`` is counts and ratios within this one run: how many times
faster the fast backend is than CasADi + Ipopt on the same pairs, and whether it ends no higher. A crash, a row that the baseline
has and the run has not, a changed count, or a ratio below a third of the baseline's is a failure (exit code 1). ``--update``
writes a new baseline.

The pairs are reference B5 of the two KITTI drives of Valimaki et al. 2023 where the published data is found in
``$HAND_EYE_CALIB_DATA`` or ``../shared/data``, otherwise of simulated drives of the same lengths.
"""

import argparse
import json
import os
import platform
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import casadi
import numpy as np
import scipy
from rich.console import Console
from rich.table import Table

from hand_eye_calib.geometry import se3
from hand_eye_calib.io.trajectory_files import read_trajectory
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers import quadratic_form
from hand_eye_calib.solvers.registry import solve

HERE = Path(__file__).resolve().parent
BASELINE = HERE / "baseline.json"
REFERENCE = "B5"
SIZES = {"short": 448, "long": 2343}  # synchronised poses; 443 and 2,338 pairs with B5
TOLERATED_RATIO = 1 / 3
# How far above Ipopt's the fast objective may end, relative: rounding.
TOLERATED_EXCESS = 1e-6


@dataclass(frozen=True)
class Row:
    """One measurement. ``seconds`` is the median; ``spread`` half the range of the repeats over the median."""

    name: str
    pairs: int
    seconds: float
    spread: float
    repeats: int
    objective: float | None = None


def measure(name, pairs, work, repeats):
    """Row for ``work()``, after one call that does not count; what it returns may have an ``objective``."""
    result = work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    median = float(np.median(times))
    spread = (max(times) - min(times)) / (2 * median)
    objective = getattr(result, "objective", None)
    return Row(name, pairs, median, spread, repeats, None if objective is None else float(objective))


def published_drives(folder):
    """Synchronised poses of both KITTI drives, the parent interpolated at the child's stamps as in the paper."""
    kitti = folder / "valimaki2023" / "kitti_tests"
    short, long = kitti / "2011_09_30_drive_0027", kitti / "2011_10_03_drive_0027"
    files = {
        "short": (short / "LIDAR_HDL64E" / "traj_HDL_aft_opt.csv", short / "cam01" / "KeyFrameTrajectory_TUM_Format.txt", 1),
        "long": (long / "cam01" / "KeyFrameTrajectory_TUM_Format.txt", long / "cam23" / "KeyFrameTrajectory_TUM_Format.txt", 0),
    }  # fmt: skip
    drives = {}
    for name, (parent_file, child_file, first) in files.items():
        child = read_trajectory(child_file)[first:]
        drives[name] = read_trajectory(parent_file).at(child.stamps_ns, extrapolate=True), child.poses
    return drives


def simulated_drives():
    """Drives of the same lengths: smooth motion of a road vehicle with noise on both sensors and a few jumps of the child."""
    return {name: simulated_drive(n_poses, seed) for seed, (name, n_poses) in enumerate(SIZES.items())}


def simulated_drive(n_poses, seed):
    """Poses (N, 4, 4) of parent and child."""
    random = np.random.default_rng(seed)
    phase = np.linspace(0, 2 * np.pi * n_poses / 100, n_poses)
    twists = np.zeros((n_poses, 6))
    twists[:, 0] = 1.0
    for axis, (amplitude, frequency) in enumerate([(0.01, 0.7), (0.01, 1.1), (0.08, 0.3)]):
        twists[:, 3 + axis] = amplitude * np.sin(frequency * phase + random.uniform(0, 6))
    Ts_pw_p = np.empty((n_poses, 4, 4))
    Ts_pw_p[0] = np.eye(4)
    for k, step in enumerate(se3.exp(twists[1:]), start=1):
        Ts_pw_p[k] = Ts_pw_p[k - 1] @ step
    T_parent_child = se3.exp(np.array([0.3, -0.1, 0.2, 0.3, -0.5, 1.2]))
    Ts_cw_c = se3.inverse(T_parent_child) @ Ts_pw_p @ T_parent_child
    sigma = np.repeat([0.01, 0.002], 3)
    Ts_pw_p, Ts_cw_c = (Ts @ se3.exp(random.normal(size=(n_poses, 6)) * sigma) for Ts in (Ts_pw_p, Ts_cw_c))
    for start in random.choice(n_poses, n_poses // 50, replace=False):
        Ts_cw_c[start:, :3, 3] += random.normal(size=3) * 0.5
    return Ts_pw_p, Ts_cw_c


def drives():
    """Where the poses come from, and the poses."""
    folder = Path(os.environ.get("HAND_EYE_CALIB_DATA", HERE.parents[1] / "shared" / "data"))
    if (folder / "valimaki2023" / "kitti_tests").is_dir():
        return "published", published_drives(folder)
    return "simulated", simulated_drives()


def solver_rows(drive, Ts_pw_p, Ts_cw_c, repeats):
    """Rows of everything between synchronised poses and the answer."""
    pairs = motion_pairs(Ts_pw_p, Ts_cw_c, REFERENCE)

    def row(name, work, n):
        return measure(f"{drive} {name}", len(pairs), work, n)

    yield row("pairs", lambda: motion_pairs(Ts_pw_p, Ts_cw_c, REFERENCE), 10 * repeats)
    yield row("condense", lambda: quadratic_form.condense(pairs), 10 * repeats)
    for method in ("dnl", "dnlo"):
        yield row(f"{method} fast", lambda method=method: solve(method, pairs, backend="fast"), 3 * repeats)
        yield row(f"{method} ipopt", lambda method=method: solve(method, pairs, backend="ipopt"), repeats)


def ratios(rows):
    """How many times faster fast is than ipopt, for every pair of such rows."""
    seconds = {row.name: row.seconds for row in rows}
    fast = [name.removesuffix(" fast") for name in seconds if name.endswith(" fast")]
    return {f"{name} ipopt / fast": seconds[f"{name} ipopt"] / seconds[f"{name} fast"] for name in fast}


def failures(rows, baseline):
    """One line per way in which the rows fall short of the baseline."""
    found = []
    by_name = {row.name: row for row in rows}
    for name, count in baseline["pairs"].items():
        if name not in by_name:
            found.append(f"{name}: row is missing")
        elif by_name[name].pairs != count:
            found.append(f"{name}: {by_name[name].pairs} pairs, baseline has {count}")
    found += [f"{name}: not in the baseline; run with --update" for name in by_name if name not in baseline["pairs"]]
    measured = ratios(rows)
    for name, ratio in baseline["ratios"].items():
        if name not in measured:
            found.append(f"{name}: ratio is missing")
        elif measured[name] < ratio * TOLERATED_RATIO:
            found.append(f"{name}: {measured[name]:.0f}, below a third of the baseline's {ratio:.0f}")
    for name, row in by_name.items():
        slow = by_name.get(name.replace(" fast", " ipopt"))
        if name.endswith(" fast") and slow and row.objective > slow.objective * (1 + TOLERATED_EXCESS):
            found.append(f"{name}: objective {row.objective:.9g} is above ipopt's {slow.objective:.9g}")
    return found


def show(source, rows):
    """Print the table."""
    table = Table(title=f"{source} poses, reference {REFERENCE}")
    for heading in ("benchmark", "pairs", "median ms", "+/- %", "repeats", "objective"):
        table.add_column(heading, justify="left" if heading == "benchmark" else "right")
    for row in rows:
        objective = "" if row.objective is None else f"{row.objective:.6f}"
        cells = f"{row.seconds * 1e3:.3f}", f"{row.spread * 100:.0f}", str(row.repeats), objective
        table.add_row(row.name, str(row.pairs), *cells)
    speed = Table(title="times faster than the paper's formulation")
    speed.add_column("benchmark")
    speed.add_column("ratio", justify="right")
    for name, ratio in ratios(rows).items():
        speed.add_row(name, f"{ratio:.0f}")
    console = Console(width=None if sys.stdout.isatty() else 110)
    console.print(table)
    console.print(speed)


def versions():
    """What the times depend on."""
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "casadi": casadi.__version__,
        "cores": os.cpu_count(),
    }


def main(arguments=None):
    """Run everything; exit code."""
    parser = argparse.ArgumentParser(description="Benchmarks of hand_eye_calib against the checked-in baseline.")
    parser.add_argument("--repeats", type=int, default=5, help="timed repeats of the slow rows; quick ones get more")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--update", action="store_true", help="write a new baseline instead of comparing")
    options = parser.parse_args(arguments)

    source, poses = drives()
    rows = [row for name, (Ts_pw_p, Ts_cw_c) in poses.items() for row in solver_rows(name, Ts_pw_p, Ts_cw_c, options.repeats)]
    show(source, rows)
    if options.json:
        document = {"source": source, "versions": versions(), "rows": [asdict(row) for row in rows], "ratios": ratios(rows)}
        options.json.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    baselines = json.loads(BASELINE.read_text(encoding="utf-8")) if BASELINE.exists() else {}
    if options.update:
        # Two digits: a third of a ratio is all that is compared.
        rounded = {name: float(f"{ratio:.2g}") for name, ratio in ratios(rows).items()}
        baselines[source] = {"pairs": {row.name: row.pairs for row in rows}, "ratios": rounded}
        BASELINE.write_text(json.dumps(baselines, indent=2) + "\n", encoding="utf-8")
        return 0
    if source not in baselines:
        print(f"no baseline for {source} poses in {BASELINE.name}; run with --update", file=sys.stderr)
        return 1
    found = failures(rows, baselines[source])
    print("\n".join(found) if found else f"all {len(rows)} rows within the baseline", file=sys.stderr if found else sys.stdout)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
