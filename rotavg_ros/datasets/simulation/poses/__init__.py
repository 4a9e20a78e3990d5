"""Pose graphs whose true poses and noise are known exactly, and closures that join wrong places."""
