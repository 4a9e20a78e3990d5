"""Triangles of a view-graph, and what they say of its edges."""
