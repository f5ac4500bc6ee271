"""Real recordings with a known extrinsic, and rigs with several recordings.

Each set of recordings has a folder beside the published data of Välimäki et al. 2023. Sets without
a folder are left out, and the page lists them.
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

# Names of the parts of a drive, by the number of parts.
PARTS = {2: "halves", 3: "thirds"}

_ASL_COLUMNS = "t,x,y,z,qx,qy,qz,qw"
_ZXL19_COLUMNS = "t,x,y,z,qw,qx,qy,qz"

# Time (ns) by which the parent's stream of a part exceeds the child's at both ends. The poses are
# needed for interpolation and for the search for the clock offset.
_MARGIN_NS = 200_000_000

# Options of a user who knows neither the clock offset nor the scale.
_CLOCK_AND_SCALE_CHECK = {"time_offset": "estimate", "scale": "auto"}
# Options of a user who does not know the clock offset.
_CLOCK = {"time_offset": "estimate"}
# Options for a camera that has no scale.
_CLOCK_AND_SCALE = {"time_offset": "estimate", "scale": "estimate"}


@dataclass(frozen=True)
class Recording:
    """Two streams of one drive, each with its own clock."""

    parent: Trajectory
    child: Trajectory

    def parts(self, count: int, offset_s: float) -> list[Recording]:
        """Divide into ``count`` recordings of equal duration.

        ``offset_s`` is added to the child's stamps, to get stamps of the parent's clock.
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
    """A known extrinsic (4, 4), and its standard deviations (6,).

    The standard deviations are in m along and in rad about the axes of the parent sensor, and
    infinite on unknown axes.
    """

    T_parent_child: FloatArray
    sigmas: FloatArray

    @classmethod
    def within(
        cls, T_parent_child: FloatArray, metres: object, degrees: object
    ) -> Truth:
        """Return a truth with these standard deviations, as a number or as (3,) per axis."""
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
    # Options that a user would set.
    options: Mapping[str, Any] = field(default_factory=dict)
    truth: Truth | None = None
    # Whether halves and thirds of each recording are calibrated, too.
    is_cut: bool = True
    # Whether the motion leaves an axis undetermined, so that every result must be refused.
    is_refused: bool = False


def real_rigs(folder: Path) -> tuple[list[Rig], list[str]]:
    """Load the rigs of all sets in a folder; return them and the names of absent sets.

    The folder contains ``valimaki2023``, ``euroc_vio`` and the folders of the other sets.
    """
    present = [name for name in _LOADERS if (folder / name).is_dir()]
    rigs = [rig for name in present for rig in rigs_of(folder, name)]
    return rigs, [name for name in _LOADERS if name not in present]


def rigs_of(folder: Path, name: str) -> list[Rig]:
    """Load the rigs of one set."""
    return _LOADERS[name](folder / name)


# Published pose of the camera. The results of the flights scatter by about 10 mm and 0.15 deg.
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
    # The SLAM used rectified images, so the calibration of the rectified images is the truth. The
    # published calibrations differ from it by 0.03 and 0.45 deg.
    return [
        _single(
            name,
            Recording(*map(read_trajectory, pair)),
            _exact(RECTIFIED[name]),
            _CLOCK_AND_SCALE_CHECK,
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
    """Read the trajectories of INS, lidar and camera of a road vehicle, in three recordings."""
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
    # The road is flat, so the motion does not determine z, and a prior from a tape measure is
    # needed. Without this prior, x and y would be uncertain too, because the lidar leans slightly
    # against the axis about which the vehicle turns.
    lidar = {**_CLOCK_AND_SCALE_CHECK, "prior": {"z": (0.0, 0.3)}}
    camera = {**_CLOCK_AND_SCALE, "prior": {"z": (-0.3, 0.3)}}
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
        _refused("zxl19_lidar without z", lidars, _CLOCK_AND_SCALE_CHECK),
        _refused("zxl19_camera without z", cameras, _CLOCK_AND_SCALE),
        _refused(
            "zxl19_lidar_camera", recordings("LO", "VO"), _CLOCK_AND_SCALE
        ),
    ]


_DEVICES = {
    "caligula": "CALIGULA_2017-04-06-18-21-33",
    "mars": "MARS_2017-04-06-18-23-37",
    "nero": "NERO_2017-04-06-18-25-25",
}

# The three pairs of three devices on one rig. Their extrinsics, chained, must give the identity.
CYCLE = ("tango_caligula_mars", "tango_mars_nero", "tango_nero_caligula")


def tango_devices(folder: Path) -> dict[str, Trajectory]:
    """Read the trajectories of the three hand-held devices by name."""
    return {
        name: _read(folder / f"{file}.csv", _ASL_COLUMNS)
        for name, file in _DEVICES.items()
    }


def _tango(folder: Path) -> list[Rig]:
    devices = tango_devices(folder)
    pairs = {name: name.split("_")[1:] for name in CYCLE}
    return [
        _single(
            name,
            Recording(devices[parent], devices[child]),
            None,
            _CLOCK_AND_SCALE_CHECK,
        )
        for name, (parent, child) in pairs.items()
    ]


# Translations of the same two sensors in four drives: the middle of their range, and half of the
# range as standard deviation.
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
    return [_single("primesense", recording, _PRIMESENSE, _CLOCK)]


def _robot_arm(folder: Path) -> list[Rig]:
    stem = "robot_arm_complete_bag_color_and_ir"
    real = _asl(folder, f"{stem}_base_link_sr300_hinge", f"{stem}_target_ir")
    one_axis = _asl(folder, "robot_arm_sim_hand", "robot_arm_sim_camera")
    return [
        _single("robot_arm", real, _ARM, _CLOCK),
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
    """Read poses of Boreas. Its angles rotate the coordinate frame, so their signs are changed."""
    with open(path, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def columns(*names: str) -> FloatArray:
        lists = [[float(row[name]) for row in rows] for name in names]
        return np.array(lists).T

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
    """Return the poses whose stamps are between two stamps (ns).

    ``stamps_ns`` (N,) replaces the stamps of the trajectory in the comparison.
    """
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
