"""Settings of the node and of a replay, without ROS."""
