"""The estimator that models the noise of the trajectories."""
