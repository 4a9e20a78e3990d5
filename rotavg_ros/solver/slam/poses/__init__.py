"""Joint estimation of orientations and positions of a robot's graph, where translations are known."""
