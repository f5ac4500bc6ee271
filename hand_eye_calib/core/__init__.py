"""Two pose streams in, a judged extrinsic out: no file, no ROS."""
