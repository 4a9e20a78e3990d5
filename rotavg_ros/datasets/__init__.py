"""Readers, writers and generators of view-graphs."""
