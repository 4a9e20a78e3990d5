"""Which labelling of rotations, and which jumps of odometry, poses are of: rivals are compared by −log p of both."""
