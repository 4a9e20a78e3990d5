"""A robot's odometry: messages, chains, time lines, keyframes."""
