"""The unit of stamps: whole nanoseconds, as ROS counts them."""

NANOSECONDS = 1_000_000_000
"""In a second."""
