"""Readers and writers of view-graphs, their companion files, and poses."""
