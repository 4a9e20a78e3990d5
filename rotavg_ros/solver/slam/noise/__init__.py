"""How odometry and closures err, and how a closure is judged by that."""
