"""The adaptive estimator: models the noise of the two trajectories instead of choosing a reference."""
