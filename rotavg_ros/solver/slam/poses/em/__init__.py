"""Poses of a labelling by expectation–maximisation: start, loop, noise and convergence."""
