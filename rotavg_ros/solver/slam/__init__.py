"""The SLAM profile: odometry chains with loop closures."""
