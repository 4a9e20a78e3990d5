"""The growing graph: keyframes, edges, and what waits to enter it."""
