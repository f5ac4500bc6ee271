"""Recordings that can be calibrated more than once: parts of one drive, or several drives of one
rig.

Their folders lie beside the published data of Välimäki et al. 2023; sets without a folder are left
out.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.trajectory_files import read_trajectory_file
from reproduction.kitti_truth import RECTIFIED

# Parts of a drive, by how many there are.
PARTS = {2: "halves", 3: "thirds"}

_SHORT, _LONG = (
    f"valimaki2023/kitti_tests/{drive}_drive_0027" for drive in ("2011_09_30", "2011_10_03")
)
_CAMERA = "KeyFrameTrajectory_TUM_Format.txt"
_DEVICES = {
    "CALIGULA": "CALIGULA_2017-04-06-18-21-33",
    "MARS": "MARS_2017-04-06-18-23-37",
    "NERO": "NERO_2017-04-06-18-25-25",
}
_ASL_COLUMNS, _ZXL19_COLUMNS = "t,x,y,z,qx,qy,qz,qw", "t,x,y,z,qw,qx,qy,qz"

# A part's parent stream reaches this far over the child's (ns), for interpolation and for the
# search for the offset.
_MARGIN_NS = 200_000_000


@dataclass(frozen=True)
class Recording:
    """Two streams of one drive.

    Attributes
    ----------
    parent, child : Trajectory
        As recorded, on clocks of their own.
    """

    parent: Trajectory
    child: Trajectory

    def parts(self, count: int, offset_s: float) -> list[Recording]:
        """As many Recordings of equal duration, one after the other; ``offset_s`` brings the
        child's clock to the parent's.
        """
        child_ns = self.child.stamps_ns + round(offset_s * 1e9)
        start_ns, end_ns = (
            max(self.parent.stamps_ns[0], child_ns[0]),
            min(self.parent.stamps_ns[-1], child_ns[-1]),
        )
        edges_ns = np.linspace(start_ns, end_ns, count + 1)
        return [
            Recording(
                _selected(
                    self.parent,
                    (self.parent.stamps_ns >= first - _MARGIN_NS)
                    & (self.parent.stamps_ns <= last + _MARGIN_NS),
                ),
                _selected(self.child, (child_ns >= first) & (child_ns <= last)),
            )
            for first, last in zip(edges_ns[:-1], edges_ns[1:], strict=True)
        ]


@dataclass(frozen=True)
class RecordedSet:
    """Drives of one rig.

    Attributes
    ----------
    name : str
    drives : tuple of Recording
        One, to be cut into parts, or several, each of which is a repeat.
    options : dict
        Options a user would give, besides ``time_offset: estimate`` and ``scale: auto``.
    truth : (4, 4) array or None
        T_parent_child from another source, if known.
    """

    name: str
    drives: tuple[Recording, ...]
    options: dict[str, Any] = field(default_factory=dict)
    truth: FloatArray | None = None


def recorded_sets(folder: str | Path) -> tuple[list[RecordedSet], list[str]]:
    """The sets whose files are there, and the names of the folders that are not.

    Parameters
    ----------
    folder : path
        Holds ``valimaki2023``, ``zxl19`` and ``asl_tango_easy``.

    Returns
    -------
    list of RecordedSet
    list of str
    """
    folder = Path(folder)
    loaders = {"valimaki2023": _kitti, "zxl19": _zxl19, "asl_tango_easy": _tango}
    present = [name for name in loaders if (folder / name).is_dir()]
    return [found for name in present for found in loaders[name](folder)], [
        name for name in loaders if name not in present
    ]


def _kitti(folder: Path) -> list[RecordedSet]:
    def read(drive: str, *names: str) -> tuple[Recording]:
        return (Recording(*(read_trajectory_file(folder / drive / name)[0] for name in names)),)

    short = read(_SHORT, "LIDAR_HDL64E/traj_HDL_aft_opt.csv", f"cam01/{_CAMERA}")
    long = read(_LONG, f"cam01/{_CAMERA}", f"cam23/{_CAMERA}")
    return [
        RecordedSet("kitti_short", short, truth=RECTIFIED["kitti_short"]),
        RecordedSet("kitti_long", long, truth=RECTIFIED["kitti_long"]),
    ]


def _zxl19(folder: Path) -> list[RecordedSet]:
    # The road is flat: the height of the lidar is a matter for a tape measure. It leans a little
    # against the axis of turning, so that without this the unknown height would be part of what is
    # uncertain of x and y.
    bags = tuple(
        Recording(
            *(
                _read(folder / f"zxl19/bag{bag}/{stream}_FCPE.mat", _ZXL19_COLUMNS)
                for stream in ("INS", "LO")
            )
        )
        for bag in (1, 2, 3)
    )
    return [RecordedSet("zxl19", bags, {"prior": {"z": (0.0, 0.3)}})]


def _tango(folder: Path) -> list[RecordedSet]:
    devices = {
        name: _read(folder / f"asl_tango_easy/{file}.csv", _ASL_COLUMNS)
        for name, file in _DEVICES.items()
    }
    return [
        RecordedSet(f"tango {parent[0]}<-{child[0]}", (Recording(devices[parent], devices[child]),))
        for parent, child in (("CALIGULA", "MARS"), ("MARS", "NERO"), ("NERO", "CALIGULA"))
    ]


def _read(path: Path, columns: str) -> Trajectory:
    return read_trajectory_file(path, "csv", columns=columns, repair=True)[0]


def _selected(trajectory: Trajectory, mask: BoolArray) -> Trajectory:
    return dataclasses.replace(
        trajectory, stamps_ns=trajectory.stamps_ns[mask], poses=trajectory.poses[mask]
    )
