"""``python -m reproduction.partial rates`` and ``positions``: what streams of rates or positions
alone give, against the truth and against whole poses.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hand_eye_calib as hec
from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.cli.main import exit_code_of
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from reproduction import positions
from reproduction.coverage import motions
from reproduction.coverage.sensor_errors import GaussMarkov, SensorErrors, draw, sigmas
from reproduction.recordings import recorded_sets
from reproduction.writing import markdown_table, put_into_page

_START_NS = 1_700_000_000_000_000_000
_QUANTILE_90 = 1.645

_VIO = SensorErrors(white=sigmas(0.0008, 0.03), walk=sigmas(0.004, 0.06))
_WHITE = SensorErrors(white=sigmas(0.003, 0.2))
_SLAM = SensorErrors(
    white=sigmas(0.008, 0.03), slow=(GaussMarkov(10.0, sigmas(0.05, 0.1), in_world=True),)
)


@dataclass(frozen=True)
class Gyroscope:
    """A consumer gyroscope: rate (Hz), noise per sample, bias and its walk (rad/s, per root s), and
    by how much its stamps are late (s).
    """

    rate_hz: float = 200.0
    noise: float = float(np.radians(0.1))
    bias: float = 0.01
    walk: float = float(np.radians(0.002))
    late_s: float = 0.005


_RATES: dict[str, tuple[Callable[..., motions.Motion], SensorErrors]] = {
    "hand-held, visual-inertial odometry": (motions.hand_held, _VIO),
    "hand-held, white noise of 0.2 deg": (motions.hand_held, _WHITE),
    "drone, visual-inertial odometry": (motions.drone, _VIO),
    "drone, SLAM": (motions.drone, _SLAM),
}


def simulated_rates(
    name: str, seed: int, duration_s: float = 60.0, rate_hz: float = 20.0
) -> tuple[Trajectory, Trajectory, FloatArray, float]:
    """Poses of the parent, rates of the child, the rotation (3, 3) between them and the time
    offset (s).
    """
    kind, errors = _RATES[name]
    gyroscope = Gyroscope()
    motion_rng, mount_rng, parent_rng, child_rng = np.random.default_rng(seed).spawn(4)
    motion = kind(motion_rng, duration_s)
    rotation = se3.rotation_exp(mount_rng.uniform(-np.pi, np.pi, 3) / np.sqrt(3))
    times_s: FloatArray = np.arange(round(duration_s * rate_hz)) / rate_hz
    poses = draw(errors, motion.at(times_s), motion.twists(times_s), 1 / rate_hz, parent_rng).poses
    fine_s: FloatArray = np.arange(round(duration_s * gyroscope.rate_hz)) / gyroscope.rate_hz
    rates = motion.twists(fine_s)[:, 3:] @ rotation
    rates += gyroscope.bias * child_rng.standard_normal(3)
    rates += gyroscope.noise * child_rng.standard_normal(rates.shape)
    steps = child_rng.standard_normal(rates.shape) / np.sqrt(gyroscope.rate_hz)
    rates += gyroscope.walk * np.cumsum(steps, axis=0)
    return (
        Trajectory(_stamps_ns(times_s), poses),
        Trajectory.from_rates(_stamps_ns(fine_s - gyroscope.late_s), rates),
        rotation,
        gyroscope.late_s,
    )


def _stamps_ns(times_s: FloatArray) -> IntArray:
    return _START_NS + np.round(times_s * 1e9).astype(np.int64)


def rate_rows(n_seeds: int) -> Iterator[list[object]]:
    """Rows of the table of simulated gyroscopes."""
    pooled = []
    for name in _RATES:
        angles, ratios, offsets = [], [], []
        for seed in range(n_seeds):
            parent, child, rotation, late_s = simulated_rates(name, seed)
            result = hec.calibrate(parent, child)
            error = se3.rotation_log(rotation @ result.T_parent_child[:3, :3].T)
            angles.append(np.degrees(np.linalg.norm(error)))
            ratios.append(error / result.sigmas[3:])
            offsets.append(abs(result.time_offset_s - late_s))
        pooled += ratios
        yield [
            name,
            n_seeds,
            f"{np.median(angles):.3f}",
            f"{np.max(angles):.3f}",
            f"{_covers(ratios):.0%}",
            f"{1e3 * np.median(offsets):.2f}",
        ]
    yield ["all", len(pooled), "", "", f"{_covers(pooled):.0%}", ""]


def _covers(ratios: Sequence[FloatArray]) -> float:
    return float(np.mean(np.abs(ratios) < _QUANTILE_90))


def tango_rows(data_folder: Path) -> Iterator[list[object]]:
    """Rows of the table of recorded devices; none if the recordings are absent."""
    for recorded in recorded_sets(data_folder)[0]:
        if not recorded.name.startswith("tango"):
            continue
        recording = recorded.drives[0]
        whole = hec.calibrate(recording.parent, recording.child, time_offset="estimate")
        rates = differenced(recording.child)
        found = hec.calibrate(recording.parent, rates, time_offset="estimate")
        apart = whole.T_parent_child[:3, :3].T @ found.T_parent_child[:3, :3]
        yield [
            recorded.name,
            f"{np.degrees(se3.rotation_angle(apart)):.2f}",
            f"{np.degrees(whole.sigmas[3:].max()):.2f}",
            f"{np.degrees(found.sigmas[3:].max()):.2f}",
            f"{1e3 * (found.time_offset_s - whole.time_offset_s):.1f}",
        ]


def differenced(trajectory: Trajectory) -> Trajectory:
    """The angular rates between the poses of a trajectory."""
    rotations, stamps_ns = trajectory.poses[:, :3, :3], trajectory.stamps_ns
    steps = se3.rotation_log(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    intervals_ns = np.diff(stamps_ns)
    return Trajectory.from_rates(
        stamps_ns[:-1] + intervals_ns // 2, steps / (1e-9 * intervals_ns[:, None])
    )


_RATE_HEADER = (
    *("Motion, poses from", "Recordings", "Median error (deg)", "Largest (deg)", "Covers"),
    "Offset, median error (ms)",
)
_TANGO_HEADER = (
    *("Parent <- child", "Apart (deg)", "Sigma, poses (deg)", "Sigma, rates (deg)"),
    "Offsets apart (ms)",
)


def run(arguments: argparse.Namespace) -> int:
    """Make the tables; returns the exit code."""
    seeds, data_folder = arguments.seeds, arguments.data_folder
    if arguments.what == "rates":
        tables = {"rates": markdown_table(_RATE_HEADER, rate_rows(seeds))}
        if data_folder:
            tables["tango"] = markdown_table(_TANGO_HEADER, tango_rows(data_folder))
    else:
        rows = positions.simulated_rows(seeds)
        tables = {"receivers": markdown_table(positions.SIMULATED_HEADER, rows)}
        if data_folder:
            rows = positions.recorded_rows(data_folder)
            tables["recorded"] = markdown_table(positions.RECORDED_HEADER, rows)
            rows = positions.parts_rows(data_folder)
            tables["parts"] = markdown_table(positions.PARTS_HEADER, rows)
    for name, table in tables.items():
        print(f"{table}\n")
        if arguments.page:
            put_into_page(arguments.page, name, table)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m reproduction.partial", description=__doc__)
    parser.add_argument("what", choices=("rates", "positions"))
    parser.add_argument(
        "--seeds", type=int, default=40, help="recordings of each kind. Default: 40"
    )
    parser.add_argument("--data-folder", type=Path, help="folder of recordings with known answers")
    parser.add_argument("--page", type=Path, help="put the tables into this Markdown page")
    return exit_code_of(lambda: run(parser.parse_args(argv)))


if __name__ == "__main__":
    raise SystemExit(main())
