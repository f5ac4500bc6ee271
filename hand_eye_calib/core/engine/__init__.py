"""From poses to a calibration: the engine that the node, the replay and Python share."""
