"""The ROS 2 node: messages in, messages out. The only package here that imports rclpy."""
