"""Solves while they run: given up, counted, left for a while, on several threads."""
