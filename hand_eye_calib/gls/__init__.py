"""The adaptive estimator: models the noise of both trajectories instead of choosing a reference."""
