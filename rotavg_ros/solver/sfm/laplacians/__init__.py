"""Least-squares systems of the SfM refinement, with matrices as the edges' weights."""
