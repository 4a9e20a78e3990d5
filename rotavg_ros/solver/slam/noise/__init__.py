"""The noise of odometry and closures, and how closures are judged by it."""
