"""Bags as a format of view-graphs, beside the files of :mod:`rotavg_ros.datasets.files.graph_file`."""

from __future__ import annotations

from pathlib import Path

from rotavg_ros.bags.graph_from_bag import read_graph_bag
from rotavg_ros.bags.graph_to_bag import write_graph_bag
from rotavg_ros.datasets.files.graph_file import GraphFile


def read_graph(path: str | Path) -> GraphFile:
    """The graph in a bag, see :func:`read_graph_bag`.

    Raises:
        BagReadError: an unreadable bag, or one without edges.
    """
    return read_graph_bag(path)


def write_graph(path: str | Path, graph_file: GraphFile) -> None:
    """Write a rosbag2 folder; an older bag there is replaced, as files are, but nothing that is not a bag.

    Raises:
        BagWriteError: the place cannot be written.
    """
    write_graph_bag(path, graph_file, overwrite=True)


def not_stored(path: str | Path, graph_file: GraphFile) -> list[str]:
    """What of this graph a bag has no room for, in words."""
    lost = graph_file.edge_information is not None or graph_file.graph.information is not None
    return ["information matrices beyond the rotation's precision"] if lost else []
