"""Engine from poses to a calibration, for the node, the replay of bags and Python."""
