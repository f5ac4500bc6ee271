"""``python -m reproduction.shown_from``: are errors of the stated sizes detected?

A result states the sizes of errors that its recording would reveal ("shown from"). This study
simulates the same drive again with other noise, and injects errors of these sizes into the
extrinsic, the clock, the lengths and the mount. An injected shift of the mount counts as detected
if the whole calibration reports it. Real recordings have no second drive, so they are used twice.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

import hand_eye_calib as hec
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.engine.snapshot import Snapshot, whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.extras.detectability import injection
from hand_eye_calib.extras.detectability.record import Detectability
from hand_eye_calib.offline.cli.main import exit_code_of
from reproduction.coverage.classes import CLASSES, REFUSED, simulate
from reproduction.recordings import real_rigs
from reproduction.runner import in_parallel
from reproduction.writing import markdown_table, seed_of

_KINDS = [name for name in sorted(CLASSES) if name not in REFUSED]
# Durations of drives, as multiples of the duration of their class.
_LENGTHS = (0.5, 1.0, 2.0)
# The mount shifts between these shares of a recording.
_MIDDLE = (0.35, 0.65)


class Outcome(NamedTuple):
    """Tests of the sizes that the result of a recording states.

    Attributes
    ----------
    platform : str
    exceeds : (K,) bool array
        For each axis with a stated size: whether the true error exceeds it.
    errors : (K,) bool array
        For each axis with a stated size: whether an injected error of this size is detected.
    streams : (2,) bool array
        Whether injected errors of the clock and of the lengths are detected.
    shift : (0 or 1,) bool array
        Whether the calibration reports an injected shift of the mount, on a random axis.
    cost : float
        Time of the computation of the sizes, divided by the time of a solve.
    is_undetectable : bool
        Whether the verdict has the reason ``undetectable``.
    """

    platform: str
    exceeds: BoolArray
    errors: BoolArray
    streams: BoolArray
    shift: BoolArray
    cost: float
    is_undetectable: bool


# Columns of the table: titles, and fields of an outcome.
_COLUMNS = {
    "true error exceeds": "exceeds",
    "error found": "errors",
    "clock, lengths found": "streams",
    "shift reported": "shift",
    "`undetectable`": "is_undetectable",
}


def of_drive(seed: int) -> Outcome:
    """Calibrate a simulated drive, and inject errors into the same drive with fresh noise."""
    name = _KINDS[seed % len(_KINDS)]
    length = _LENGTHS[seed // len(_KINDS) % len(_LENGTHS)]
    kind = replace(CLASSES[name], duration_s=length * CLASSES[name].duration_s)
    drive = simulate(kind, (seed, 0))
    fresh = simulate(kind, (seed, 0), noise_seed=(seed, 1))
    streams = (drive.parent, drive.child)
    again = (fresh.parent, fresh.child)
    truth = (drive.T_parent_child, np.zeros(6))
    return outcome(name.split("_")[0], streams, again, truth, {}, seed)


def outcome(
    platform: str,
    streams: tuple[Trajectory, Trajectory],
    again: tuple[Trajectory, Trajectory],
    truth: tuple[FloatArray, FloatArray] | None,
    options: dict[str, Any],
    seed: int,
) -> Outcome:
    """Calibrate ``streams`` and inject errors of the stated sizes into the streams ``again``.

    ``truth`` is the extrinsic and its standard deviations (6,).
    """
    rng = np.random.default_rng((seed, 2))
    start_s = time.process_time()
    result = hec.calibrate(*streams, **options)
    solved_s = time.process_time()
    snapshot = cast(Snapshot, result.recording)
    injection.examine(result, snapshot.resolved)
    examined_s = time.process_time()
    # The time of the calibration contains the time of an examination.
    cost = (examined_s - solved_s) / (2.0 * solved_s - start_s - examined_s)
    sizes: Detectability | None = result.parts.get("detectability")
    if sizes is None:
        none = np.zeros(0, dtype=bool)
        return Outcome(platform, none, none, none, none, cost, False)
    stated = np.array([*sizes.errors.values()])
    is_stated = np.isfinite(stated)
    exceeds = np.zeros(0, dtype=bool)
    if truth is not None:
        T_parent_child, sigmas = truth
        errors = np.abs(se3.deviation(result.T_parent_child, T_parent_child))
        exceeds = (errors > np.hypot(stated, 3.0 * sigmas))[
            is_stated & np.isfinite(sigmas)
        ]
    are_detected, of_streams = _errors_found(result, sizes, again, rng)
    shift = _shift_found(result, sizes, again, options, rng)
    rules = {reason.rule for reason in result.reasons}
    is_undetectable = "undetectable" in rules
    return Outcome(
        platform,
        exceeds,
        are_detected[is_stated],
        of_streams,
        shift,
        cost,
        is_undetectable,
    )


def _errors_found(
    result: Calibration,
    sizes: Detectability,
    again: tuple[Trajectory, Trajectory],
    rng: np.random.Generator,
) -> tuple[BoolArray, BoolArray]:
    """Test the stated sizes in a random trial with fresh streams.

    Returns whether injected errors of the extrinsic (6,) and of clock and lengths (2,) are
    detected. An error is detected if its estimate exceeds the threshold for the scatter of blocks.
    """
    X = result.T_parent_child
    R = se3.rotation_of(X)
    config = cast(Snapshot, result.recording).resolved.config
    snapshot = replace(whole_snapshot(*again, {}), config=config)
    pairs = injection.on_clock_of(result, snapshot.resolved)
    blocks = injection.evidence_of(pairs, X)
    sigmas, allowance = injection.sigmas_of(result)
    columns = [*range(6)]
    if result.time_offset_sigma_s:
        columns.append(6)
    if result.scale_sigma:
        columns.append(7)
    scatter, differences = injection.trials(blocks, columns, R, sigmas)
    trial = rng.integers(len(differences))
    signs = rng.choice([-1.0, 1.0], 8)
    injected = signs[:6] * np.array([*sizes.errors.values()])
    wrong = differences[trial, :6] + injected
    thresholds = injection.thresholds_of(scatter[:6], allowance[:6])
    are_detected = np.abs(wrong) > thresholds
    columns = [*range(8)]
    scatter, differences = injection.trials(blocks, columns, R, sigmas)
    thresholds = injection.thresholds_of(scatter, allowance)
    estimates = blocks.solve(columns)
    late_s = signs[6] * sizes.time_offset_s
    longer = signs[7] * sizes.scale
    are_detected_in_streams = []
    for column, change in (
        (6, lambda size_s: pairs.child_shifted(late_s - size_s)),
        (7, lambda size: pairs.child_scaled(1.0 + longer + size)),
    ):
        # The evidence is linear in small errors only, so the error is estimated twice.
        estimate = 0.0
        for _ in range(2):
            changed = injection.evidence_of(change(estimate), X).solve(columns)
            estimate += (changed - estimates)[column]
        difference = differences[trial, column] + estimate
        are_detected_in_streams.append(abs(difference) > thresholds[column])
    return are_detected, np.array(are_detected_in_streams)


def _shift_found(
    result: Calibration,
    sizes: Detectability,
    again: tuple[Trajectory, Trajectory],
    options: dict[str, Any],
    rng: np.random.Generator,
) -> BoolArray:
    """Return whether a calibration reports a shift of the mount on one of the stated axes."""
    stated = [axis for axis in AXES if np.isfinite(sizes.shifts[axis])]
    if not stated:
        return np.zeros(0, dtype=bool)
    axis = rng.choice(stated)
    sign = rng.choice([-1.0, 1.0])
    in_parent = np.zeros(6)
    in_parent[AXES.index(axis)] = sign * sizes.shifts[axis]
    R = se3.rotation_of(result.T_parent_child)
    to_child = np.kron(np.eye(2), R.T)
    shift = se3.exp(to_child @ in_parent)
    parent, child = again
    poses = child.poses.copy()
    share = rng.uniform(*_MIDDLE)
    since = int(share * len(poses))
    poses[since:] = poses[since:] @ shift
    moved = hec.calibrate(parent, replace(child, poses=poses), **options)
    codes = {finding.code for finding in moved.findings}
    return np.array(["mount_moved" in codes])


def of_recordings(folder: Path) -> Iterator[Outcome]:
    """Yield the outcome of each real recording."""
    for number, rig in enumerate(real_rigs(folder)[0]):
        truth = (
            (rig.truth.T_parent_child, rig.truth.sigmas) if rig.truth else None
        )
        for recording in rig.recordings.values():
            streams = (recording.parent, recording.child)
            yield outcome(
                "real", streams, streams, truth, dict(rig.options), number
            )


def table(outcomes: list[Outcome]) -> str:
    """Return the table of all platforms."""
    rows = []
    for platform in [*sorted({item.platform for item in outcomes}), "all"]:
        chosen = [
            item for item in outcomes if platform in (item.platform, "all")
        ]
        row: dict[str, object] = {
            "platform": platform,
            "recordings": len(chosen),
        }
        for title, field in _COLUMNS.items():
            flags = np.hstack([getattr(item, field) for item in chosen])
            row[title] = "-"
            if len(flags):
                row[title] = f"{np.mean(flags):.1%} of {len(flags)}"
        row["cost, solves"] = f"{np.mean([item.cost for item in chosen]):.2f}"
        rows.append(row)
    return markdown_table(rows)


def main() -> int:
    """Simulate drives, inject errors, and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m reproduction.shown_from", description=__doc__
    )
    parser.add_argument(
        "--drives",
        type=int,
        default=200,
        help="number of simulated drives. Default: 200",
    )
    parser.add_argument(
        "--seed", type=int, help="default: a random seed at every run"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, help="processes. Default: 1"
    )
    parser.add_argument(
        "--data-folder", type=Path, help="folder of the real recordings"
    )
    arguments = parser.parse_args()
    seed = seed_of(arguments.seed)
    print(f"seeds from {seed}\n")
    tasks = [(seed + row,) for row in range(arguments.drives)]
    outcomes = [*in_parallel(of_drive, tasks, arguments.jobs)]
    if outcomes:
        print(table(outcomes))
    if arguments.data_folder:
        print(table([*of_recordings(arguments.data_folder)]))
    return 0


if __name__ == "__main__":
    raise SystemExit(exit_code_of(main))
