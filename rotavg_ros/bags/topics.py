"""Topics of the bags that we write. Nodes use the same names without the leading slash."""

ODOM_TOPIC = "/odom"
EDGE_TOPIC = "/relative_rotations"
TRUTH_TOPIC = "/ground_truth"

# Key of the bag's own metadata that says what messages cannot: that it was a graph, and what was missing in it.
GRAPH_NOTE = "rotavg_graph"
