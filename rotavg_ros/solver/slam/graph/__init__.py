"""The pose graph with its odometry drawn together, and which of its closures are neighbours."""
