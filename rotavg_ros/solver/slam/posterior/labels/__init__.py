"""Densities of labels: which closures are false, by what turns, and where odometry slips.

Rates that are not known are integrated over a grid, so that no labelling is judged by the rates of another one.
"""
