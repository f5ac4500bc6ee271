"""Poses in bags: rosbag2 (sqlite3, mcap) and rosbag1, read and written without ROS.

Only the messages of the chosen topics are read, and of these only stamp, frames and pose.
"""

from hand_eye_calib.io.bags.poses import PoseBlock
from hand_eye_calib.io.bags.reader import PoseBag
from hand_eye_calib.io.bags.topics import TopicInfo
from hand_eye_calib.io.bags.trajectories import trajectory_of
from hand_eye_calib.io.bags.writer import STORAGES, write_bag

__all__ = [
    "STORAGES",
    "PoseBag",
    "PoseBlock",
    "TopicInfo",
    "trajectory_of",
    "write_bag",
]
