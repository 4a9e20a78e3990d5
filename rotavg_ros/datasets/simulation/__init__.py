"""Generators of view-graphs: synthetic photo collections, simulated robots, and ways to corrupt clean graphs."""
