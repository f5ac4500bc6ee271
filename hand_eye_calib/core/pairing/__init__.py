"""Two streams of poses to pairs of relative motions."""
