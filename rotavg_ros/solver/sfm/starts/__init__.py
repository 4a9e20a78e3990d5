"""Starts of the refinement for view-graphs in which few edges check each other."""
