"""Orientations and positions together, where translations are known: a robot's graph with both kinds of evidence."""
