"""Rigid transforms and trajectories. Knows nothing of calibration."""
