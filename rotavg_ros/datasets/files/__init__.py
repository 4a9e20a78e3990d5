"""Readers and writers of view-graphs, of what comes with them, and of poses."""
