"""Topics of the bags that we write and read. Nodes use the same names without the leading slash."""

from __future__ import annotations

from collections.abc import Mapping

from rotavg_ros.bags.message_types import TRANSFORMS

ODOM_TOPIC = "/odom"
EDGE_TOPIC = "/relative_rotations"
EDGE_ARRAY_TOPIC = "/relative_rotation_arrays"
TRUTH_TOPIC = "/ground_truth"

# Key in the bag's own metadata for what messages cannot express: that it was a graph, and what was missing in it.
GRAPH_NOTE = "rotavg_graph"


def static_transforms(type_of: Mapping[str, str]) -> list[str]:
    """Topics of static transforms among those of a bag by their types: ``/tf_static`` of each namespace."""
    return [topic for topic, kind in type_of.items() if kind == TRANSFORMS and topic.endswith("/tf_static")]
