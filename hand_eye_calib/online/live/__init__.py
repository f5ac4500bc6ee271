"""The live session without ROS: inputs, solve cycle, journal, mount watch and their state."""
