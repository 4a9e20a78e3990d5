"""Densities of labels: which closures are false, by what turns, and where odometry slips.

Unknown rates are integrated over a grid, so that no labelling is judged by the rates of another one.
"""
