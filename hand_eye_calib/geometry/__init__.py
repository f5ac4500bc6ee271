"""Rigid transforms and trajectories."""
