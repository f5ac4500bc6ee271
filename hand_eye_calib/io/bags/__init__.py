"""Poses in bags: rosbag2 (sqlite3, mcap) and rosbag1, read and written without ROS.

Only the messages of the chosen topics are read, and of these only stamp, frames and pose.
"""

from hand_eye_calib.io.bags.poses import PoseTable
from hand_eye_calib.io.bags.reader import PoseBag
from hand_eye_calib.io.bags.sources import Source
from hand_eye_calib.io.bags.writer import STORAGES, write_bag

__all__ = ["STORAGES", "PoseBag", "PoseTable", "Source", "write_bag"]
