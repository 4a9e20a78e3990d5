"""Where refinements of view-graphs begin in which few edges check each other."""
