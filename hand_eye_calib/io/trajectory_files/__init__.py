"""Trajectories in text files.

tum
    ``timestamp tx ty tz qx qy qz qw``, separated by white space.
kitti
    The first three rows of the pose's matrix, 12 values. The stamps, one a line, are in a file of
    their own.
euroc
    ``timestamp, px, py, pz, qw, qx, qy, qz, ...``, in nanoseconds. What follows (velocities,
    biases) is ignored.
csv
    Columns found by the names in the header, or named by ``columns``; separated by commas,
    semicolons or white space. Positions are x, y and z, or latitude, longitude and height;
    orientations are quaternions, or roll, pitch and yaw or heading.
auto
    Whichever of these the lines look like, or the file of another program: NMEA, GPX, RTKLIB,
    ULog, COLMAP, nerfstudio, g2o, Motive, Vicon, .npy (``foreign.py``).

Lines that start with ``#`` and empty lines are skipped, but a csv file's header may start with
``#``. Lengths are in metres if the header names no other unit. The units of stamps and of angles
are recognised from their size. The order of a quaternion's coefficients is the format's or is
named. Only with ``auto`` is it judged by the motion, and what was found is said.
"""

from hand_eye_calib.io.trajectory_files.reading import (
    FileReading,
    read_trajectory,
    read_trajectory_file,
    read_trajectory_files,
)
from hand_eye_calib.io.trajectory_files.table import AUTO, FileOptions
from hand_eye_calib.io.trajectory_files.writing import write_trajectory

__all__ = [
    "AUTO",
    "FileOptions",
    "FileReading",
    "read_trajectory",
    "read_trajectory_file",
    "read_trajectory_files",
    "write_trajectory",
]
