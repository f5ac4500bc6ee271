"""``python -m reproduction.partial rates`` and ``positions``: what streams of rates or positions
alone give, against the truth and against whole poses.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hand_eye_calib as hec
from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.cli.main import exit_code_of
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from reproduction import positions
from reproduction.coverage import motions
from reproduction.coverage.classes import VIO, slam, stamps_ns
from reproduction.coverage.sensor_errors import SensorErrors, draw, sigmas
from reproduction.positions import covers
from reproduction.recordings import CYCLE, real_rigs
from reproduction.writing import markdown_table, show, study_parser

_WHITE = SensorErrors(white=sigmas(0.003, 0.2))


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
    "hand-held, visual-inertial odometry": (motions.hand_held, VIO),
    "hand-held, white noise of 0.2 deg": (motions.hand_held, _WHITE),
    "drone, visual-inertial odometry": (motions.drone, VIO),
    "drone, SLAM": (motions.drone, slam(10.0, 0.05, 0.1)),
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
        Trajectory(stamps_ns(times_s), poses),
        Trajectory.from_rates(stamps_ns(fine_s - gyroscope.late_s), rates),
        rotation,
        gyroscope.late_s,
    )


def rate_rows(n_seeds: int) -> Iterator[dict[str, object]]:
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
        yield {
            "Motion, poses from": name,
            "Recordings": n_seeds,
            "Median error (deg)": f"{np.median(angles):.3f}",
            "Largest (deg)": f"{np.max(angles):.3f}",
            "Covers": covers(ratios),
            "Offset, median error (ms)": f"{1e3 * np.median(offsets):.2f}",
        }
    together = dict.fromkeys(("Median error (deg)", "Largest (deg)"), "")
    yield {"": "all", "Recordings": len(pooled), **together, "Covers": covers(pooled), "Offset": ""}


def tango_rows(data_folder: Path) -> Iterator[dict[str, object]]:
    """Rows of the table of recorded devices; none if the recordings are absent."""
    for rig in real_rigs(data_folder)[0]:
        if rig.name not in CYCLE:
            continue
        (recording,) = rig.recordings.values()
        whole = hec.calibrate(recording.parent, recording.child, time_offset="estimate")
        rates = differenced(recording.child)
        found = hec.calibrate(recording.parent, rates, time_offset="estimate")
        apart = whole.T_parent_child[:3, :3].T @ found.T_parent_child[:3, :3]
        yield {
            "Parent and child": rig.name.removeprefix("tango_"),
            "Apart (deg)": f"{np.degrees(se3.rotation_angle(apart)):.2f}",
            "Sigma, poses (deg)": f"{np.degrees(whole.sigmas[3:].max()):.2f}",
            "Sigma, rates (deg)": f"{np.degrees(found.sigmas[3:].max()):.2f}",
            "Offsets apart (ms)": f"{1e3 * (found.time_offset_s - whole.time_offset_s):.1f}",
        }


def differenced(trajectory: Trajectory) -> Trajectory:
    """The angular rates between the poses of a trajectory."""
    rotations, at_ns = trajectory.poses[:, :3, :3], trajectory.stamps_ns
    steps = se3.rotation_log(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    intervals_ns = np.diff(at_ns)
    middle_ns = at_ns[:-1] + intervals_ns // 2
    return Trajectory.from_rates(middle_ns, steps / (1e-9 * intervals_ns[:, None]))


def run(arguments: argparse.Namespace) -> int:
    """Make the tables; returns the exit code."""
    seeds, data_folder = arguments.seeds, arguments.data_folder
    rows = {"rates": rate_rows} if arguments.what == "rates" else {}
    recorded = {"tango": tango_rows}
    if arguments.what == "positions":
        rows = {"receivers": positions.simulated_rows}
        recorded = {"recorded": positions.recorded_rows}
    tables = {name: markdown_table(of(seeds)) for name, of in rows.items()}
    if data_folder:
        tables |= {name: markdown_table(of(data_folder)) for name, of in recorded.items()}
    show(arguments.page, tables)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; returns the exit code."""
    parser = study_parser("reproduction.partial", __doc__)
    parser.add_argument("what", choices=("rates", "positions"))
    parser.add_argument(
        "--seeds", type=int, default=40, help="recordings of each kind. Default: 40"
    )
    return exit_code_of(lambda: run(parser.parse_args(argv)))


if __name__ == "__main__":
    raise SystemExit(main())
