"""Drives with known truth: trajectories of two sensors on one vehicle, and the noise of the
odometry that measured them.
"""
