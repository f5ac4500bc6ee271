"""``python -m reproduction.fleet``: a batch of many recordings in three ways, with the same rows.

On one worker, on two of which one is killed half-way, and on a Dask cluster of two of which one is
killed.

Twenty vehicles drive ten times each. On one the mount moves, on another one recording is off.
"""

import argparse
import dataclasses
import multiprocessing
import os
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.cli.batch.results import write_rows
from hand_eye_calib.cli.batch.run import write_summary
from hand_eye_calib.cli.batch.tasks import Task, read_batch
from hand_eye_calib.cli.batch.vehicles import Vehicle, vehicles_of
from hand_eye_calib.cli.batch.workers import Outcome, Workers, on_cores, on_dask, work
from hand_eye_calib.cli.console import with_progress
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.bags import write_bag
from hand_eye_calib.simulation.drive import simulate_drive
from hand_eye_calib.simulation.options import HILLY_DRIVE, NoiseConfig
from reproduction.writing import markdown_table, show

_ODOMETRY = "nav_msgs/msg/Odometry"
_TOPICS = ("/lidar/odometry", "/camera/odometry")
_POSES = 300  # half a minute
_DRIVE = dataclasses.replace(HILLY_DRIVE, poses=_POSES)
_NOISE = NoiseConfig(gaussian=0.003)
_DAY_NS = 86_400_000_000_000
# A degree about the parent's vertical axis.
_KNOCK = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(1.0)]))
_MOVED, _MOVED_FROM = 3, 6
_OFF, _OFF_RECORDING = 7, 4


class Run(NamedTuple):
    """What a batch took, and its rows as text."""

    name: str
    seconds: float
    cpu_s: float
    killed: int
    rows: str
    outcomes: list[Outcome]


def make_fleet(folder: Path, n_vehicles: int, n_recordings: int) -> Path:
    """Simulate the recordings; returns the batch file."""
    path = folder / "fleet.yaml"
    if path.exists():
        return path
    wanted = [(v, r) for v in range(n_vehicles) for r in range(n_recordings)]
    for vehicle, recording in with_progress(wanted, len(wanted), "simulating"):
        _record(folder / f"truck_{vehicle:02}" / f"day_{recording:02}", vehicle, recording)
    bags = [
        {"bag": f"truck_{vehicle:02}/*", "vehicle": f"truck_{vehicle:02}"}
        for vehicle in range(n_vehicles)
    ]
    names = dict(zip(("parent_topic", "child_topic"), _TOPICS, strict=True))
    document = {"options": {"method": "dnlo", "reference": "B10"}, **names, "bags": bags}
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    return path


def _record(path: Path, vehicle: int, recording: int) -> None:
    """A bag of one recording of a vehicle."""
    drive = simulate_drive((11, vehicle, recording), _DRIVE, _NOISE)
    X = extrinsic_of(vehicle, recording)
    mounted = drive.child.poses @ se3.inverse(drive.T_parent_child) @ X
    late_ns = recording * _DAY_NS + vehicle * 1_000_000_000
    streams = {}
    for topic, frame, trajectory, poses in (
        (_TOPICS[0], "lidar", drive.parent, drive.parent.poses),
        (_TOPICS[1], "camera", drive.child, mounted),
    ):
        stamps_ns = trajectory.stamps_ns + late_ns
        moved = Trajectory(stamps_ns, poses, sensor_frame=frame, world_frame="odom")
        streams[topic] = (moved, _ODOMETRY)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bag(path, streams)


def extrinsic_of(vehicle: int, recording: int) -> FloatArray:
    """The true extrinsic of a vehicle in a recording."""
    random = np.random.default_rng((12, vehicle))
    X = se3.exp(np.r_[random.uniform(-1, 1, 3), random.normal(0, 0.5, 3)])
    is_moved = vehicle == _MOVED and recording >= _MOVED_FROM
    is_off = vehicle == _OFF and recording == _OFF_RECORDING
    return _KNOCK @ X if is_moved or is_off else X


def run_on(
    name: str,
    workers: AbstractContextManager[Workers],
    tasks: Sequence[Task],
    kill: Callable[[], None] | None,
    out: Path,
) -> Run:
    """Do all tasks; with ``kill``, call it when half of them are done."""
    started, cpu_s, killed = time.monotonic(), _cpu_s(), 0
    found: dict[str, Outcome] = {}
    with workers as do:
        for task, outcome in with_progress(do(tasks), len(tasks), name):
            found[task.name] = outcome
            if kill and len(found) == len(tasks) // 2:
                kill()
                killed += 1
    outcomes = [found[task.name] for task in tasks]
    write_rows(out / f"{name}.csv", outcomes)
    rows = (out / f"{name}.csv").read_text(encoding="utf-8")
    return Run(name, time.monotonic() - started, _cpu_s() - cpu_s, killed, rows, outcomes)


def _cpu_s() -> float:
    """Processor time of this process and of its children that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def kill_a_process() -> None:
    """Kill one worker of the pool."""
    multiprocessing.active_children()[0].kill()


@contextmanager
def dask_with_two_workers() -> Iterator[tuple[str, Callable[[], None]]]:
    """Address of a cluster on this machine, and what kills one of its workers."""
    from dask.distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:

        def kill() -> None:
            os.kill(next(iter(cluster.workers.values())).pid, 9)

        yield cluster.scheduler_address, kill


def runs_of(tasks: Sequence[Task], out: Path) -> Iterator[Run]:
    """The same batch in three ways."""
    yield run_on("one worker", on_cores(1, work), tasks, None, out)
    yield run_on("two workers", on_cores(2, work), tasks, kill_a_process, out)
    with dask_with_two_workers() as (address, kill):
        yield run_on("dask", on_dask(address, work), tasks, kill, out)


def page_text(runs: Sequence[Run], vehicles: Sequence[Vehicle]) -> str:
    """The tables of the page."""
    ways = markdown_table(
        {
            "Run": run.name,
            "Workers killed": run.killed,
            "Recordings": len(run.outcomes),
            "Failed": sum(bool(outcome["error"]) for outcome in run.outcomes),
            "Rows as with one worker": "all" if run.rows == runs[0].rows else "not all",
            "s": f"{run.seconds:.0f}",
            "CPU s": f"{run.cpu_s:.0f}",
        }
        for run in runs
    )
    said = [vehicle for vehicle in vehicles if vehicle.agreement.kind.value != "agree"]
    lines = [f"- {vehicle.name}: {vehicle.sentence}" for vehicle in said]
    agree = f"{len(vehicles) - len(said)} of {len(vehicles)} vehicles agree. The others:"
    return "\n\n".join([ways, agree, "\n".join(lines)])


def main() -> None:
    """Simulate, run, compare and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of bags and results")
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--recordings", type=int, default=10, help="of each vehicle")
    parser.add_argument("--page", type=Path, help="Markdown page to put the tables into")
    arguments = parser.parse_args()
    batch = make_fleet(arguments.out, arguments.vehicles, arguments.recordings)
    tasks = read_batch(batch, {}, {}, with_fingerprints=True)
    runs = list(runs_of(tasks, arguments.out))
    vehicles = vehicles_of(runs[0].outcomes)
    write_summary(arguments.out / "summary", str(batch), runs[0].outcomes, vehicles)
    show(arguments.page, {"fleet": page_text(runs, vehicles)})


if __name__ == "__main__":
    main()
