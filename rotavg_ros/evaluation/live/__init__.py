"""Runs of the estimator and of the node with data in time order, as on a robot."""
