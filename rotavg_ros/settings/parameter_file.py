"""What a node's YAML parameter file gets wrong without ROS telling."""

from __future__ import annotations

from pathlib import Path

from rotavg_ros.yaml_keys import RepeatedKey, repeated_keys

# Node names in parameter files that match any node.
ANY_NODE = ("*", "**")

_PARAMETERS = "ros__parameters"


def repeated_parameter(path: Path, text: str, *node_names: str) -> str | None:
    """A line about the first key that stands twice where it may concern a node; None: none does.

    Args:
        path: of the file.
        text: its content; other nodes' parameters may be in it, and are theirs.
        node_names: names of the node, without namespaces.

    Raises:
        yaml.YAMLError, RecursionError: not YAML, or nested too deeply.
    """
    ours = (each for each in repeated_keys(text) if _node(each) in (*ANY_NODE, *node_names))
    first = next(ours, None)
    return None if first is None else first.told(path)


def _node(key: RepeatedKey) -> str:
    """Name of the node that a key is about, without namespaces."""
    path = key.path
    names = path[: path.index(_PARAMETERS)] if _PARAMETERS in path else path
    return names[-1].rpartition("/")[2] if names else ""
