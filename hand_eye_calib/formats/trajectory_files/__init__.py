"""Trajectories in text files: TUM, KITTI, EuRoC, tables with named columns, and files of other
programs (``extras/sensors/foreign.py``).

A file becomes a table of numbers, and the table becomes poses. Lengths are in metres if the header
names no other unit. The units of stamps and of angles are inferred from the magnitude of the
values. The order of a quaternion's coefficients is defined by the format or by the names of the
columns. With the format ``auto``, the order may be inferred from the motion: the order for which
the direction of travel is constant in the sensor's frame. The user is then notified.
"""
