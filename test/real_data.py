"""Real recordings with known answers, read for tests. They are not part of this package.

They are looked for where :mod:`published_data` looks; a test that needs them is skipped, and says
so, where they are absent.
"""

import csv
from dataclasses import dataclass

import numpy as np
from published_data import data_folder
from scipy.spatial.transform import Rotation

from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.trajectory_files import read_trajectory

TANGO = {
    "caligula": "CALIGULA_2017-04-06-18-21-33",
    "mars": "MARS_2017-04-06-18-23-37",
    "nero": "NERO_2017-04-06-18-25-25",
}

# WGS 84.
_EQUATORIAL_RADIUS, _ECCENTRICITY_SQUARED = 6378137.0, 6.69437999014e-3
_GPS_EPOCH_S, _LEAP_SECONDS = 315_964_800, 18


# Differences that are really there and that the data's documentation does not give: found by this
# package, and taken out where streams without any fault are wanted. The devices' scales close round
# the cycle to 0.5 %, the drive's is the published 2.2 %.
_TANGO_SCALES = (0.971, 1.024, 1.010)
_ZXL19_OFFSETS_S = {"LO": (-0.052, -0.044, -0.075), "VO": (0.031, 0.034, 0.025)}
_KITTI_LONG_SCALE = 0.9774
_ARM_OFFSETS_S = {"complete": -0.0195, "sim": 0.0}


@dataclass(frozen=True)
class Recording:
    """Two streams of one rig with what is known about them.

    Attributes
    ----------
    name : str
    parent, child : Trajectory
        Sorted, repeated stamps dropped; nothing else is touched.
    time_offset_s : float
        Known: added to the child's stamps it gives the parent's clock.
    scale : float
        Known: factor from the child's lengths to the parent's.
    """

    name: str
    parent: Trajectory
    child: Trajectory
    time_offset_s: float = 0.0
    scale: float = 1.0

    def corrected(self):
        """The child with the known offset and scale taken out."""
        return self.child.shifted(self.time_offset_s).scaled(self.scale)


def tango_pairs():
    """Three handheld devices on one rig, clocks not shared: (parent, child) in a cycle."""
    devices = {name: _asl_csv("asl_tango_easy", file) for name, file in TANGO.items()}
    known = {
        ("caligula", "mars"): -126.834,
        ("mars", "nero"): -107.736,
        ("nero", "caligula"): 234.570,
    }
    return [
        Recording(f"tango {parent}<-{child}", devices[parent], devices[child], offset, scale)
        for ((parent, child), offset), scale in zip(known.items(), _TANGO_SCALES, strict=True)
    ]


def primesense():
    """Motion capture against a camera that sees a target, with gross jumps."""
    stem = "2017-04-09-18-13-10_"
    parent, child = (
        _asl_csv("asl_primesense", stem + name)
        for name in ("vicon_prime_sense", "W_camera_rgb_image_raw")
    )
    return Recording("primesense", parent, child, 0.02)


def robot_arm(which):
    """An arm's hand against a camera: "complete" is real, with gross jumps; "sim" turns about
    nearly one axis.
    """
    names = {
        "complete": (
            "complete_bag_color_and_ir_base_link_sr300_hinge",
            "complete_bag_color_and_ir_target_ir",
        ),
        "sim": ("sim_hand", "sim_camera"),
    }[which]
    return Recording(
        f"arm {which}",
        *(_asl_csv("asl_robot_arm", f"robot_arm_{name}") for name in names),
        _ARM_OFFSETS_S[which],
    )


def zxl19(bag, child):
    """INS against lidar odometry ("LO") or a monocular camera of unknown scale ("VO") on a road
    vehicle, bags 1 to 3.
    """
    folder = data_folder() / "zxl19" / f"bag{bag}"
    scale = {1: 3.34, 2: 3.76, 3: 2.66}[bag] if child == "VO" else 1.0
    parent, child_poses = _mat(folder / "INS_FCPE.mat"), _mat(folder / f"{child}_FCPE.mat")
    return Recording(
        f"zxl19 {bag} {child}", parent, child_poses, _ZXL19_OFFSETS_S[child][bag - 1], scale
    )


def zxl19_raw():
    """Bag 1's INS and lidar odometry from its CSV exports."""
    folder = data_folder() / "zxl19" / "raw_bag1"
    return Recording(
        "zxl19 1 LO raw", _inspvax(folder), _odometry_csv(folder / "bag1-aft_mapped_to_init.csv")
    )


def boreas():
    """Lidar (stamps in microseconds) and radar (nanoseconds) of a car, both from one INS."""
    return Recording(
        "boreas", _boreas_csv("lidar_poses.csv", 1_000), _boreas_csv("radar_poses.csv", 1)
    )


BOREAS_TRUTH = se3.from_rotation_translation(
    Rotation.from_euler("xyz", [-180.0, 0.0, 46.67], degrees=True).as_matrix(), [0.0, 0.0, 0.21]
)


def kitti(which):
    """The KITTI drives of Välimäki et al. 2023 as their SLAM recorded them, stamps not shared:
    "short" or "long".
    """
    folder = data_folder() / "valimaki2023" / "kitti_tests"
    if which == "short":
        drive = folder / "2011_09_30_drive_0027"
        files = (
            drive / "LIDAR_HDL64E" / "traj_HDL_aft_opt.csv",
            drive / "cam01" / "KeyFrameTrajectory_TUM_Format.txt",
        )
        return Recording("kitti short", *map(read_trajectory, files))
    drive = folder / "2011_10_03_drive_0027"
    files = (drive / camera / "KeyFrameTrajectory_TUM_Format.txt" for camera in ("cam01", "cam23"))
    return Recording("kitti long", *map(read_trajectory, files), 0.0, _KITTI_LONG_SCALE)


def all_recordings():
    """Every real set the stream checks are measured on."""
    return [
        *tango_pairs(),
        *(zxl19(bag, child) for child in ("LO", "VO") for bag in (1, 2, 3)),
        boreas(),
        robot_arm("complete"),
        robot_arm("sim"),
        primesense(),
        kitti("short"),
        kitti("long"),
    ]


def asl_rows(folder, name):
    """Rows (N, 8) of a file as they are: ``t x y z qx qy qz qw``, repeated and unsorted too."""
    return np.loadtxt(data_folder() / folder / f"{name}.csv", delimiter=",")


def _asl_csv(folder, name):
    rows = asl_rows(folder, name)
    return _tidy(np.round(rows[:, 0] * 1e9).astype(np.int64), rows[:, 1:4], rows[:, 4:])


def _mat(path):
    rows = np.loadtxt(path)
    return _tidy(np.round(rows[:, 0] * 1e9).astype(np.int64), rows[:, 1:4], rows[:, [5, 6, 7, 4]])


def _tidy(stamps_ns, translations, quats_xyzw):
    stamps_ns, first = np.unique(stamps_ns, return_index=True)
    return Trajectory.from_quat_xyzw(stamps_ns, translations[first], quats_xyzw[first])


def _boreas_csv(name, unit_ns):
    path = data_folder() / "boreas" / "boreas-2021-08-05-13-34" / name
    with open(path, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    stamps_ns = np.array([int(row["GPSTime"]) * unit_ns for row in rows])
    roll, pitch, yaw = (
        np.array([float(row[key]) for row in rows]) for key in ("roll", "pitch", "heading")
    )
    rotation = Rotation.from_euler("XYZ", -np.c_[roll, pitch, yaw])
    position = np.array(
        [[float(row[key]) for key in ("easting", "northing", "altitude")] for row in rows]
    )
    return Trajectory(stamps_ns, se3.from_rotation_translation(rotation.as_matrix(), position))


def _odometry_csv(path):
    rows = _spaced_csv(path)
    stamps_ns = np.array(
        [int(row[".header.stamp.secs"]) * 10**9 + int(row[".header.stamp.nsecs"]) for row in rows]
    )
    position, orientation = (
        np.array([[float(row[f".pose.pose.{part}.{axis}"]) for axis in axes] for row in rows])
        for part, axes in (("position", "xyz"), ("orientation", "xyzw"))
    )
    return _tidy(stamps_ns, position, orientation)


def _inspvax(folder):
    """NovAtel INS: latitude, longitude and height to a tangent plane; sensor y forward, azimuth
    clockwise from north.
    """
    rows = _spaced_csv(folder / "bag1-novatel_data-inspvax.csv")
    week, milliseconds = (
        [int(row[f".header.gps_week{key}"]) for row in rows] for key in ("", "_seconds")
    )
    seconds = _GPS_EPOCH_S - _LEAP_SECONDS + 604_800 * np.array(week)
    stamps_ns = seconds * 10**9 + np.array(milliseconds) * 10**6
    latitude, longitude, height, roll, pitch, azimuth = (
        np.array([float(row[f".{key}"]) for row in rows])
        for key in ("latitude", "longitude", "altitude", "roll", "pitch", "azimuth")
    )
    north, east = np.radians(latitude - latitude[0]), np.radians(longitude - longitude[0])
    shrink = 1 - _ECCENTRICITY_SQUARED * np.sin(np.radians(latitude[0])) ** 2
    prime_vertical = _EQUATORIAL_RADIUS / np.sqrt(shrink)
    meridional = prime_vertical * (1 - _ECCENTRICITY_SQUARED) / shrink
    position = np.c_[
        east * (prime_vertical + height[0]) * np.cos(np.radians(latitude[0])),
        north * (meridional + height[0]),
        height,
    ]
    rotation = Rotation.from_euler("ZXY", np.c_[-azimuth, pitch, roll], degrees=True)
    return _tidy(stamps_ns, position, rotation.as_quat())


def _spaced_csv(path):
    with open(path, encoding="utf-8") as file:
        return list(csv.DictReader(file, skipinitialspace=True))
