"""Runs of the estimator and of the node, as a robot lives them."""
