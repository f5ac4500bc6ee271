"""Trajectories in text files: TUM, KITTI, EuRoC, tables with named columns, and files of other
programs (``extras/sensors/foreign.py``).

A file becomes a table of numbers, and the table becomes poses. Lengths are in metres, unless the
header names another unit. The units of stamps and of angles are inferred from the size of the
values. The format or the names of the columns define the order of a quaternion's coefficients. With
the format ``auto``, the order may be inferred from the motion: the direction of travel must be
constant in the sensor's frame. The user is then notified.
"""
