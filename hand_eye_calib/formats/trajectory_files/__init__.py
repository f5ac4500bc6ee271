"""Trajectories in text files: TUM, KITTI, EuRoC, tables with named columns, and files of other
programs (``foreign.py``).

A file becomes a table of numbers, and the table becomes poses. Lengths are in metres if the header
names no other unit. The units of stamps and of angles are recognised from their size. The order of
a quaternion's coefficients is defined by the format or by the names of the columns. With the format
``auto``, the motion may decide; the user is then notified.
"""
