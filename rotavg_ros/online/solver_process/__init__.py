"""Runs solves in a process of their own, so that they never delay whoever feeds the graph."""
