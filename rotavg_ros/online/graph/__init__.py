"""The graph as it grows: keyframes, edges, and what waits."""
