"""What a user can set, of the node and of a replay alike; free of ROS."""
