"""Generators of view-graphs: synthetic photo collections, simulated robots, and what makes clean graphs worse."""
