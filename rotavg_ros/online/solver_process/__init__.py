"""Solves in a process of their own, so that they never hold up who feeds the graph."""
