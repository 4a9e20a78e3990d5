"""The pose graph with its odometry contracted, and which of its closures are neighbours."""
