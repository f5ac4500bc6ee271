"""Poses in bags: rosbag2 (sqlite3, mcap) and rosbag1, read and written without ROS.

Only messages of the chosen topics are read, and of these messages only the stamp, the names of the
frames and the pose.
"""
