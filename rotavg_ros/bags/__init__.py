"""Bags without ROS: rosbag2 (sqlite3, MCAP) and ROS 1 in, rosbag2 MCAP out, through the `rosbags` library."""
