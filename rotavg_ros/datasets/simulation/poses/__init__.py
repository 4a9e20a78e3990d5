"""Pose graphs whose true poses and noise are known to the last digit, and closures that join wrong places."""
