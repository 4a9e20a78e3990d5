"""Live graphs: what a solve remembers, and the solve of a graph that has grown by a few edges."""
