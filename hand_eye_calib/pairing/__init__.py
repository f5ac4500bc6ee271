"""From two streams of poses to pairs of relative motions."""
