"""Poses in bags: rosbag2 (sqlite3, mcap) and rosbag1, read and written without ROS.

Only the messages of the chosen topics are read, and of these only stamp, frames and pose.
"""
