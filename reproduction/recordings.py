"""Real recordings whose answer is known, or that can be calibrated more than once.

They lie in folders of their own beside the published data of Välimäki et al. 2023. A set whose
folder is absent is left out, and the page says so.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.trajectory_files.file_options import FileOptions
from hand_eye_calib.formats.trajectory_files.reading import (
    read_trajectory,
    read_trajectory_files,
)
from reproduction.published import KEYFRAMES, KITTI_DRIVES, RECTIFIED

# Parts of a drive, by how many there are.
PARTS = {2: "halves", 3: "thirds"}

_ASL_COLUMNS = "t,x,y,z,qx,qy,qz,qw"
_ZXL19_COLUMNS = "t,x,y,z,qw,qx,qy,qz"

# A part's parent stream reaches this far over the child's (ns), for interpolation and for the
# search for the offset.
_MARGIN_NS = 200_000_000

# A user who knows neither clock nor scale.
_FOUND = {"time_offset": "estimate", "scale": "auto"}
_CLOCK_FOUND = {"time_offset": "estimate"}
_SCALE_FOUND = {"time_offset": "estimate", "scale": "estimate"}


@dataclass(frozen=True)
class Recording:
    """Two streams of one drive, on clocks of their own."""

    parent: Trajectory
    child: Trajectory

    def parts(self, count: int, offset_s: float) -> list[Recording]:
        """As many Recordings of equal duration, one after the other; ``offset_s`` brings the
        child's clock to the parent's.
        """
        child_ns = self.child.stamps_ns + round(offset_s * 1e9)
        start_ns = max(self.parent.stamps_ns[0], child_ns[0])
        end_ns = min(self.parent.stamps_ns[-1], child_ns[-1])
        edges_ns = np.linspace(start_ns, end_ns, count + 1)
        return [
            Recording(
                between(self.parent, first - _MARGIN_NS, last + _MARGIN_NS),
                between(self.child, first, last, child_ns),
            )
            for first, last in pairwise(edges_ns)
        ]


@dataclass(frozen=True)
class Truth:
    """A known answer (4, 4), and how well it is known (6,): m along and rad about the axes of the
    parent sensor; infinite where it is not.
    """

    T_parent_child: FloatArray
    sigmas: FloatArray

    @classmethod
    def within(
        cls, T_parent_child: FloatArray, metres: object, degrees: object
    ) -> Truth:
        """Known to so many metres and degrees, one number or one per axis."""
        parts = [
            np.full(3, 1.0) * metres,
            np.radians(np.full(3, 1.0) * degrees),
        ]
        return cls(T_parent_child, np.concatenate(parts))


def _exact(T_parent_child: FloatArray) -> Truth:
    return Truth.within(T_parent_child, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Recordings of one rig by name."""

    name: str
    recordings: Mapping[str, Recording]
    # What a user would give.
    options: Mapping[str, Any] = field(default_factory=dict)
    truth: Truth | None = None
    # Halves and thirds of each recording are repeats, too.
    is_cut: bool = True
    # The motion leaves something open: no answer may be called good.
    is_refused: bool = False


def real_rigs(folder: Path) -> tuple[list[Rig], list[str]]:
    """The rigs whose files are in the folder, which holds ``valimaki2023``, ``euroc_vio`` and the
    other sets; and the names of the sets that are not.
    """
    present = [name for name in _LOADERS if (folder / name).is_dir()]
    rigs = [rig for name in present for rig in rigs_of(folder, name)]
    return rigs, [name for name in _LOADERS if name not in present]


def rigs_of(folder: Path, name: str) -> list[Rig]:
    """The rigs of one set."""
    return _LOADERS[name](folder / name)


# Good to about 0.15 deg and 10 mm, as the flights say of it among themselves.
EUROC = Truth.within(
    np.array(
        [
            [0.0148655, -0.9998809, 0.0041403, -0.0216401],
            [0.9995572, 0.0149672, 0.0257155, -0.0646770],
            [-0.0257744, 0.0037562, 0.9996607, 0.0098107],
            [0.0, 0.0, 0.0, 1.0],
        ]
    ),
    0.010,
    0.15,
)


def _euroc(folder: Path) -> list[Rig]:
    def recordings(kind: str) -> dict[str, Recording]:
        return {
            flight: Recording(
                read_trajectory(folder / f"vio_{kind}_{flight}.tum"),
                read_trajectory(folder / f"cam0_truth_{flight}.tum"),
            )
            for flight in ("mh_03", "mh_05", "v2_01")
        }

    return [
        Rig(name=f"euroc_{kind}", recordings=recordings(kind), truth=EUROC)
        for kind in ("stereo", "mono")
    ]


SIMPLE_KITTI = _exact(
    se3.from_quat_xyzw(
        (0.8, -0.3, 0.5), (0.333307, -0.063488, 0.753055, 0.563723)
    )
)


def _simple_kitti(folder: Path) -> list[Rig]:
    recordings = {
        drive: Recording(
            read_trajectory(folder / f"odometry_{drive}.tum"),
            read_trajectory(folder / f"truth_{drive}.tum"),
        )
        for drive in ("05", "06", "07")
    }
    return [Rig(name="simple_kitti", recordings=recordings, truth=SIMPLE_KITTI)]


def _kitti(folder: Path) -> list[Rig]:
    short, long = (folder / "kitti_tests" / drive for drive in KITTI_DRIVES)
    files = {
        "kitti_short": (
            short / "LIDAR_HDL64E/traj_HDL_aft_opt.csv",
            short / "cam01" / KEYFRAMES,
        ),
        "kitti_long": (long / "cam01" / KEYFRAMES, long / "cam23" / KEYFRAMES),
    }
    # The rectified calibration is what the SLAM saw: the published files differ from it by their
    # own rectification, 0.03 and 0.45 deg.
    return [
        _single(
            name,
            Recording(*map(read_trajectory, pair)),
            _exact(RECTIFIED[name]),
            _FOUND,
        )
        for name, pair in files.items()
    ]


_YAW = Rotation.from_euler("z", -90.78, degrees=True).as_matrix()
_ZXL19 = Truth.within(
    se3.from_rotation_translation(_YAW, [0.002, 0.367, 0.0]),
    np.array([0.018, 0.022, np.inf]),
    np.array([np.inf, np.inf, 0.23]),
)


def zxl19_sensors(folder: Path) -> list[dict[str, Trajectory]]:
    """INS, lidar odometry and camera of the road vehicle, by name, in each of three recordings."""
    return [
        {
            name: _read(folder / f"bag{bag}/{name}_FCPE.mat", _ZXL19_COLUMNS)
            for name in _ZXL19_NAMES
        }
        for bag in (1, 2, 3)
    ]


_ZXL19_NAMES = ("INS", "LO", "VO")


def _zxl19(folder: Path) -> list[Rig]:
    sensors = zxl19_sensors(folder)

    def recordings(parent: str, child: str) -> dict[str, Recording]:
        return {
            f"bag{n}": Recording(bag[parent], bag[child])
            for n, bag in enumerate(sensors, 1)
        }

    lidars = recordings("INS", "LO")
    cameras = recordings("INS", "VO")
    # The road is flat: heights are a matter for a tape measure. The lidar leans a little against
    # the axis of turning, so that without this the unknown height would be part of what is
    # uncertain of x and y.
    lidar = {**_FOUND, "prior": {"z": (0.0, 0.3)}}
    camera = {**_SCALE_FOUND, "prior": {"z": (-0.3, 0.3)}}
    return [
        Rig(
            name="zxl19_lidar",
            recordings=lidars,
            options=lidar,
            truth=_ZXL19,
            is_cut=False,
        ),
        Rig(
            name="zxl19_camera",
            recordings=cameras,
            options=camera,
            is_cut=False,
        ),
        _refused("zxl19_lidar without z", lidars, _FOUND),
        _refused("zxl19_camera without z", cameras, _SCALE_FOUND),
        _refused("zxl19_lidar_camera", recordings("LO", "VO"), _SCALE_FOUND),
    ]


_DEVICES = {
    "caligula": "CALIGULA_2017-04-06-18-21-33",
    "mars": "MARS_2017-04-06-18-23-37",
    "nero": "NERO_2017-04-06-18-25-25",
}

# Three devices on one rig, pairwise: the answers of a cycle must close.
CYCLE = ("tango_caligula_mars", "tango_mars_nero", "tango_nero_caligula")


def tango_devices(folder: Path) -> dict[str, Trajectory]:
    """The three hand-held devices by name."""
    return {
        name: _read(folder / f"{file}.csv", _ASL_COLUMNS)
        for name, file in _DEVICES.items()
    }


def _tango(folder: Path) -> list[Rig]:
    devices = tango_devices(folder)
    pairs = {name: name.split("_")[1:] for name in CYCLE}
    return [
        _single(name, Recording(devices[parent], devices[child]), None, _FOUND)
        for name, (parent, child) in pairs.items()
    ]


# Of four drives of the same pair of sensors: the middle of their range, and half of it.
_PRIMESENSE = Truth.within(
    se3.from_rotation_translation(np.eye(3), [0.066, 0.0415, 0.032]),
    np.array([0.002, 0.0015, 0.002]),
    np.inf,
)
_ARM = Truth.within(
    se3.from_rotation_translation(np.eye(3), [0.0025, -0.016, 0.001]),
    np.array([0.0015, 0.0005, 0.0005]),
    np.inf,
)


def _primesense(folder: Path) -> list[Rig]:
    names = ("vicon_prime_sense", "W_camera_rgb_image_raw")
    recording = _asl(folder, *(f"2017-04-09-18-13-10_{name}" for name in names))
    return [_single("primesense", recording, _PRIMESENSE, _CLOCK_FOUND)]


def _robot_arm(folder: Path) -> list[Rig]:
    stem = "robot_arm_complete_bag_color_and_ir"
    real = _asl(folder, f"{stem}_base_link_sr300_hinge", f"{stem}_target_ir")
    one_axis = _asl(folder, "robot_arm_sim_hand", "robot_arm_sim_camera")
    return [
        _single("robot_arm", real, _ARM, _CLOCK_FOUND),
        _refused("robot_arm about one axis", {"whole": one_axis}, {}),
    ]


def _asl(folder: Path, *names: str) -> Recording:
    return Recording(
        *(_read(folder / f"{name}.csv", _ASL_COLUMNS) for name in names)
    )


def _refused(
    name: str, recordings: Mapping[str, Recording], options: Mapping[str, Any]
) -> Rig:
    return Rig(
        name=name,
        recordings=recordings,
        options=options,
        is_cut=False,
        is_refused=True,
    )


def _single(
    name: str,
    recording: Recording,
    truth: Truth | None,
    options: Mapping[str, Any],
) -> Rig:
    return Rig(
        name=name, recordings={"whole": recording}, options=options, truth=truth
    )


BOREAS = Truth.within(
    se3.from_rotation_translation(
        Rotation.from_euler(
            "xyz", [-180.0, 0.0, 46.67], degrees=True
        ).as_matrix(),
        [0.0, 0.0, 0.21],
    ),
    0.0,
    0.005,
)


def _boreas(folder: Path) -> list[Rig]:
    drive = folder / "boreas-2021-08-05-13-34"
    recording = Recording(
        _boreas_poses(drive / "lidar_poses.csv", 1_000),
        _boreas_poses(drive / "radar_poses.csv", 1),
    )
    return [replace(_single("boreas", recording, BOREAS, {}), is_cut=False)]


def _boreas_poses(path: Path, unit_ns: int) -> Trajectory:
    """Poses of one INS; its attitude angles are rotations of the frame, hence the signs."""
    with open(path, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def columns(*names: str) -> FloatArray:
        return np.array([[float(row[name]) for name in names] for row in rows])

    rotations = Rotation.from_euler(
        "XYZ", -columns("roll", "pitch", "heading")
    ).as_matrix()
    return Trajectory(
        np.array([int(row["GPSTime"]) * unit_ns for row in rows]),
        se3.from_rotation_translation(
            rotations, columns("easting", "northing", "altitude")
        ),
    )


def _read(path: Path, columns: str) -> Trajectory:
    options = FileOptions(format="csv", columns=columns, repair=True)
    return read_trajectory_files([(path, options)])[0].trajectory


def between(
    trajectory: Trajectory,
    first_ns: float,
    last_ns: float,
    stamps_ns: IntArray | None = None,
) -> Trajectory:
    """The poses whose stamps, perhaps given on another clock, lie between two."""
    stamps_ns = trajectory.stamps_ns if stamps_ns is None else stamps_ns
    return trajectory[(stamps_ns >= first_ns) & (stamps_ns <= last_ns)]


_LOADERS: dict[str, Callable[[Path], list[Rig]]] = {
    "valimaki2023": _kitti,
    "simple_kitti": _simple_kitti,
    "euroc_vio": _euroc,
    "zxl19": _zxl19,
    "asl_tango_easy": _tango,
    "asl_primesense": _primesense,
    "asl_robot_arm": _robot_arm,
    "boreas": _boreas,
}
