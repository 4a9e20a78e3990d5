"""Speed and memory beside COLMAP and GTSAM: the same graphs, in one run, each solver in a process of its own."""
