"""``calibrator``: the ROS 2 node."""


def add_arguments(parser):
    """Declare the command's arguments: all are the node's, and passed on to it."""
    parser.usage = "hand_eye_calib calibrator [--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO ...]"
    parser.set_defaults(passed_on=())


def run(arguments):
    """Run the node until it is told to end; returns the exit code."""
    from hand_eye_calib.ros.node import main

    return main(arguments.passed_on)
