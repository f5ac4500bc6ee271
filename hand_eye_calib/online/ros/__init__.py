"""The ROS 2 node. Only this folder and the player of the simulation import rclpy."""
