"""One posterior over orientations, labels and noise of a robot's graph, and one search that lowers its F."""
