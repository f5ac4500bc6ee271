"""Clean recordings, in which the stream checks should find nothing.

They are simulated recordings of many kinds, and real recordings with the options that they need.
The limits of the checks were set with other seeds of the same kinds.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.simulation.drive import (
    SimulatedDrive,
    simulate_drive,
)
from hand_eye_calib.extras.simulation.options import HILLY_DRIVE, NoiseConfig
from reproduction.coverage.classes import CLASSES, Simulated, make
from reproduction.recordings import Rig, real_rigs

SEEDS = range(60, 65)

# Noise (m; twice as many radians) of simulated hilly drives.
_HILLY = {"hilly": 0.003, "hilly_noisy": 0.02}

# Codes of correct findings by kind of recording. The names of a recording's options are such codes,
# too.
_KNOWN = {
    "hand_mixture_30s": frozenset({"jumps"}),
    "primesense": frozenset({"jumps", "time_offset"}),
    "robot_arm": frozenset({"time_offset"}),
    "kitti_long": frozenset({"scale"}),
    "boreas": frozenset({"not_independent"}),
}


@dataclass(frozen=True, kw_only=True)
class Clean:
    """A clean recording; its name consists of its kind and its seed or drive."""

    name: str
    parent: Trajectory
    child: Trajectory
    # The true extrinsic, if it is known.
    T_parent_child: FloatArray | None = None
    # Options of the calibration.
    options: dict[str, Any] = field(default_factory=dict)
    is_real: bool = False


def names(folder: Path | None) -> list[str]:
    """Return the names of all clean recordings."""
    simulated = [
        f"{kind} {seed}" for kind in (*CLASSES, *_HILLY) for seed in SEEDS
    ]
    return simulated + list(_real(folder))


def kind_of(name: str) -> str:
    """Return the kind of a recording: its name without seed or drive."""
    return name.rpartition(" ")[0]


def known_in(name: str, folder: Path | None) -> frozenset[str]:
    """Return the codes of the findings that are correct in this recording."""
    kind = kind_of(name)
    options = _real(folder)[name].options if name in _real(folder) else {}
    return _KNOWN.get(kind, frozenset()) | options.keys()


def recording(name: str, folder: Path | None) -> Clean:
    """Return the recording with this name."""
    kind = kind_of(name)
    seed = name.rpartition(" ")[2]
    if kind not in CLASSES and kind not in _HILLY:
        return _real(folder)[name]
    made: Simulated | SimulatedDrive
    if kind in CLASSES:
        made = make(kind, int(seed))
    else:
        made = simulate_drive(
            int(seed), HILLY_DRIVE, NoiseConfig(gaussian=_HILLY[kind])
        )
    return Clean(
        name=name,
        parent=made.parent,
        child=made.child,
        T_parent_child=made.T_parent_child,
    )


@cache
def _real(folder: Path | None) -> dict[str, Clean]:
    rigs = real_rigs(folder)[0] if folder else ()
    return {clean.name: clean for rig in rigs for clean in _of_rig(rig)}


def _of_rig(rig: Rig) -> Iterator[Clean]:
    for which, recording in rig.recordings.items():
        yield Clean(
            name=f"{rig.name} {which}",
            parent=recording.parent,
            child=recording.child,
            options=dict(rig.options),
            is_real=True,
        )
