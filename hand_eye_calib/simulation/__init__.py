"""Simulated drives: two sensors on one vehicle with known truth, and the noise of odometry."""
