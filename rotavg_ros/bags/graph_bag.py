"""Bags as a format of view-graphs, beside the files of :mod:`rotavg_ros.datasets.files.graph_file`."""

from __future__ import annotations

from pathlib import Path

from rotavg_ros.bags.graph_from_bag import read_graph_bag
from rotavg_ros.bags.graph_to_bag import write_graph_bag
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.view_graph import EdgeLabel


def read_graph(path: str | Path) -> GraphFile:
    """The graph in a bag, see :func:`read_graph_bag`.

    Raises:
        BagReadError: an unreadable bag, or one without edges.
    """
    return read_graph_bag(path)


def write_graph(path: str | Path, graph_file: GraphFile) -> None:
    """Write a rosbag2 folder; an existing bag is replaced, as files are, but nothing that is not a bag.

    Raises:
        BagWriteError: the place cannot be written.
    """
    write_graph_bag(path, graph_file, overwrite=True)


def not_stored(path: str | Path, graph_file: GraphFile) -> list[str]:
    """The parts of this graph that a bag cannot store, in words."""
    graph = graph_file.graph
    lost = {
        "information matrices beyond the rotation's precision": graph_file.edge_information is not None
        or graph.information is not None,
        "labels": bool((graph.label != EdgeLabel.AUTOMATIC).any()),
        "how many steps odometry edges stand for": bool((graph.steps[graph.is_odometry] != 1).any()),
    }
    return [name for name, is_lost in lost.items() if is_lost] + graph_file.in_no_file
