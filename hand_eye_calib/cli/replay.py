"""``replay BAG``: feed the messages of a bag to the engine in the order they were recorded."""

from hand_eye_calib.calibrator import Calibrator
from hand_eye_calib.cli.console import note, waiting_for, with_progress
from hand_eye_calib.cli.options import add_config_arguments, add_output_arguments, config_from
from hand_eye_calib.cli.present import deliver
from hand_eye_calib.errors import InputError


def add_arguments(parser):
    """Declare the command's arguments."""
    parser.add_argument("bag", metavar="BAG", help="rosbag2 directory, .mcap or .db3 file of one, or rosbag1 .bag file")
    parser.add_argument("--parent-topic", metavar="TOPIC", help="poses of the parent sensor (Odometry or PoseStamped)")
    parser.add_argument("--child-topic", metavar="TOPIC", help="poses of the child sensor (Odometry or PoseStamped)")
    add_config_arguments(parser)
    add_output_arguments(parser)


def run(arguments):
    """Calibrate from a bag; returns the exit code."""
    from hand_eye_calib.io.bags import PoseBag

    calibrator = Calibrator(config_from(arguments))
    with PoseBag(arguments.bag) as bag:
        parent_topic, child_topic = bag.select_topics(arguments.parent_topic, arguments.child_topic)
        if not (arguments.parent_topic and arguments.child_topic):
            note(f"parent is {parent_topic}, child is {child_topic}; --parent-topic and --child-topic say otherwise")
        topics = {"parent": parent_topic, "child": child_topic}
        expected = sum(topic.count for topic in bag.topics() if topic.name in topics.values())
        poses = bag.poses(parent_topic, child_topic)
        found = feed(calibrator, with_progress(poses, expected, f"reading {arguments.bag}"), topics)
    if found != expected:
        note(f"{arguments.bag} says it has {expected} messages on these topics, but {found} could be read; it may be damaged")
    with waiting_for("solving"):
        calibration = calibrator.estimate()
    inputs = {"bag": str(arguments.bag), "options": calibrator.config.to_options()}
    inputs |= {stream: {"topic": topic, **_counts(calibrator.statistics(stream))} for stream, topic in topics.items()}
    return deliver(calibration, arguments, inputs)


def feed(calibrator, poses, topics):
    """Give every pose to the engine.

    Parameters
    ----------
    calibrator : Calibrator
    poses : iterable of StampedPose
    topics : mapping
        "parent" and "child" to the names of their topics, for messages.

    Returns
    -------
    int
        How many there were.

    Raises
    ------
    InputError
        At the first message that cannot be used, naming topic, message and stamp.
    """
    count = 0
    for pose in poses:
        count += 1
        try:
            if pose.sensor_frame is not None:
                calibrator.set_frame(pose.stream, pose.sensor_frame)
            calibrator.add_pose(pose.stream, pose.stamp_ns, pose.position, pose.quat_xyzw)
        except InputError as error:
            stamp = f"{pose.stamp_ns // 10**9}.{pose.stamp_ns % 10**9:09d}"
            raise InputError(f"{topics[pose.stream]}, message {pose.number}, stamp {stamp}: {error}") from error
    return count


def _counts(statistics):
    return {
        "messages": statistics.received,
        "refused_duplicate": statistics.refused_duplicate,
        "refused_late": statistics.refused_late,
        "first_stamp_ns": statistics.first_stamp_ns,
        "last_stamp_ns": statistics.last_stamp_ns,
    }
