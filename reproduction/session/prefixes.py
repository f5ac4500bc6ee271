"""Recordings cut off after ever longer times, and what a calibration of each says: what a person
sees who watches a live session.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.excitation import Excitation, excitation
from hand_eye_calib.assessment.lever_arm import LeverArms
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.offline import prior_fields, whole_snapshot
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.results.calibration import Calibration
from reproduction.coverage.classes import CLASSES, simulate
from reproduction.recordings import Rig

# Class, and duration (s): five kinds of motion with two kinds of errors each.
KINDS = {
    "hand-held": {"hand_gm_1s": 150.0, "hand_vio_walk": 150.0},
    "car": {"car_ins_lidar": 360.0, "car_two_slams": 360.0},
    "AGV": {"agv_ramps": 360.0, "agv_long": 1200.0},
    "drone": {"drone_gnss_vio": 180.0, "drone_two_vios": 180.0},
    "arm": {"arm_target": 180.0},
}
_STEPS = 24


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A recording with a known answer."""

    name: str
    kind: str
    parent: Trajectory
    child: Trajectory
    truth: FloatArray
    # How well it is known (6,), m and rad.
    truth_sigmas: FloatArray = field(default_factory=lambda: np.zeros(6))
    # What a user would give.
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Step:
    """A prefix: its end (s), the error (6,) along and about the parent's axes, and what the session
    is told.
    """

    end_s: float
    error: FloatArray
    calibration: Calibration
    seen: Excitation


def simulated(seeds: int) -> Iterator[Recorded]:
    """So many recordings of each class; twice as many of a kind that has one class."""
    for kind, classes in KINDS.items():
        for name, duration_s in classes.items():
            for seed in range(seeds * 2 // len(classes)):
                key = (7, seed, sorted(CLASSES).index(name))
                made = simulate(dataclasses.replace(CLASSES[name], duration_s=duration_s), key)
                yield Recorded(
                    name=f"{name} {seed}",
                    kind=kind,
                    parent=made.parent,
                    child=made.child,
                    truth=made.T_parent_child,
                )


def real(rigs: Sequence[Rig]) -> Iterator[Recorded]:
    """The recordings of rigs whose answer is known."""
    for rig in rigs:
        if rig.truth is None:
            continue
        for name, recording in rig.recordings.items():
            yield Recorded(
                name=f"{rig.name} {name}",
                kind=rig.name,
                parent=recording.parent,
                child=recording.child,
                truth=rig.truth.T_parent_child,
                truth_sigmas=rig.truth.sigmas,
                options=rig.options,
            )


def steps(recorded: Recorded) -> list[Step]:
    """Calibrations of the prefixes; those that cannot be solved are left out."""
    options: dict[str, Any] = dict(recorded.options)
    options |= prior_fields(options.pop("prior", {}))
    config = CalibratorConfig(**options)
    start_ns, end_ns = recorded.parent.stamps_ns[[0, -1]]
    child = recorded.child
    # Clocks of their own: the child's prefix is the same share of its recording.
    child_start_ns, child_end_ns = child.stamps_ns[[0, -1]]
    if abs(child_start_ns - start_ns) < 10 * 10**9:
        child_start_ns, child_end_ns = start_ns, end_ns
    found = []
    for share in np.arange(1, _STEPS + 1) / _STEPS:
        parts = [
            _until(recorded.parent, start_ns + round(share * (end_ns - start_ns))),
            _until(child, child_start_ns + round(share * (child_end_ns - child_start_ns))),
        ]
        step = _step(config, recorded, parts, share * (end_ns - start_ns) * 1e-9)
        if step is not None:
            found.append(step)
    return found


def _step(
    config: CalibratorConfig, recorded: Recorded, parts: list[Trajectory], end_s: float
) -> Step | None:
    try:
        snapshot = whole_snapshot(config, *parts).resolved()
        calibration = snapshot.estimate()
        seen = excitation(snapshot.pose_pairs())
    except (HandEyeCalibError, np.linalg.LinAlgError):
        return None
    error = deviation(calibration.T_parent_child, recorded.truth)
    return Step(end_s, error, calibration, seen)


def _until(trajectory: Trajectory, stamp_ns: int) -> Trajectory:
    kept = max(int(np.searchsorted(trajectory.stamps_ns, stamp_ns, side="right")), 3)
    return dataclasses.replace(
        trajectory, stamps_ns=trajectory.stamps_ns[:kept], poses=trajectory.poses[:kept]
    )


def solved(recorded: Recorded) -> dict[str, Any]:
    """The steps of a recording as plain values."""
    return {
        "name": recorded.name,
        "kind": recorded.kind,
        "truth_sigmas": [None if np.isinf(s) else s for s in recorded.truth_sigmas.tolist()],
        "steps": [
            {
                "end_s": step.end_s,
                "error": step.error.tolist(),
                "calibration": step.calibration.to_dict(),
                "rotation": step.seen.rotation.tolist(),
                "motion_s": step.seen.motion_s,
            }
            for step in steps(recorded)
        ],
    }


@dataclass(frozen=True)
class Kept:
    """The steps of a recording, from plain values."""

    name: str
    kind: str
    truth_sigmas: FloatArray
    steps: tuple[Step, ...]

    @classmethod
    def from_plain(cls, document: Mapping[str, Any]) -> Kept:
        """What :func:`solved` has given."""
        nothing = LeverArms.of(np.zeros((1, 3, 3)))
        steps = tuple(
            Step(
                each["end_s"],
                np.array(each["error"]),
                Calibration.from_dict(each["calibration"]),
                Excitation(2, np.array(each["rotation"]), nothing, 0.0, each["motion_s"]),
            )
            for each in document["steps"]
        )
        sigmas = np.array([np.inf if s is None else s for s in document["truth_sigmas"]])
        return cls(document["name"], document["kind"], sigmas, steps)
