"""What ``rotavg convert`` does: it reads one format and writes another."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from rotavg_ros.bags import graph_bag
from rotavg_ros.bags.reader import COMPRESSED_SUFFIX, RECORDING_SUFFIXES
from rotavg_ros.cli.main import print_warning
from rotavg_ros.cli.progress import working
from rotavg_ros.datasets.files import formats
from rotavg_ros.datasets.files.ground_truth import attach_stamps, attach_truth
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.whole_file import real


class ConvertError(UserError):
    """An output that must not or cannot be written."""


class Format(NamedTuple):
    """A format that holds a view-graph.

    The module has ``read_graph(path) -> GraphFile``, ``write_graph(path, graph_file)``
    and ``not_stored(path, graph_file) -> list[str]``: the parts of this graph that the format cannot store.
    """

    suffixes: tuple[str, ...]
    is_folder: bool
    module: ModuleType


# The last one also gets unknown suffixes: it recognises formats by content, and explains what it cannot read.
FORMATS = (
    Format(("", *RECORDING_SUFFIXES, COMPRESSED_SUFFIX), is_folder=True, module=graph_bag),
    Format(
        (".g2o", ".graph", ".toro", ".isam", ".npz", ".txt"),
        is_folder=False,
        module=formats,
    ),
)


def run(arguments: argparse.Namespace) -> int:
    """Read, attach the content of further files, write."""
    inputs = [path for path in (arguments.input, arguments.stamps, arguments.truth) if path is not None]
    _check_output(inputs, arguments.output, overwrite=arguments.overwrite)
    with working(f"converting {arguments.input}"):
        graph_file = format_of(arguments.input).read_graph(arguments.input)
        if arguments.stamps is not None:
            graph_file = attach_stamps(graph_file, arguments.stamps)
        if arguments.truth is not None:
            graph_file = attach_truth(graph_file, arguments.truth)
        output_format = format_of(arguments.output)
        output_format.write_graph(arguments.output, graph_file)
        lost = output_format.not_stored(arguments.output, graph_file)
    counts = f"{graph_file.graph.num_nodes} nodes, {graph_file.graph.num_edges} edges"
    left_out = f"; no room for: {', '.join(lost)}" if lost else ""
    skipped = "".join(f"; skipped {count} × {kind}" for kind, count in graph_file.skipped.items())
    print(f"{arguments.input} → {arguments.output}: {counts}{skipped}{left_out}")
    if graph_file.damage is not None:
        print_warning(f"{graph_file.damage}; {arguments.output} has the graph of that")
    for warning in graph_file.warnings:
        print_warning(f"{arguments.input}: {warning}")
    return 0


def _check_output(inputs: Sequence[Path], output: Path, *, overwrite: bool) -> None:
    with asking_about(output, ConvertError):
        exists, is_folder = output.exists(), output.is_dir()
    if exists and not overwrite:
        raise ConvertError(f"{output}: exists already; choose another OUTPUT or give --overwrite")
    # Everything outside the view-graph would be lost: comments, landmarks, a bag's other topics.
    for path in inputs:
        with asking_about(path, ConvertError):
            is_input = exists and path.exists() and output.samefile(path)
            is_inside = real(output) in real(path).parents and path.exists()
        if is_input:
            which = "the INPUT itself" if path is inputs[0] else "an input as well"
            raise ConvertError(f"{output}: is {which}; choose another OUTPUT")
        if is_inside:
            raise ConvertError(f"{output}: would be replaced, and {path} is in it; choose another OUTPUT")
    bags, files = FORMATS
    suffix = _suffix_of(output)
    if suffix and suffix in bags.suffixes and not is_folder:
        raise ConvertError(f"{output}: a bag is written as a folder; choose an OUTPUT without {output.suffix}")
    if suffix in files.suffixes and is_folder:
        raise ConvertError(f"{output}: is a folder; remove it or choose another OUTPUT")


def format_of(path: Path) -> ModuleType:
    """The module that reads and writes ``path``."""
    with asking_about(path, ConvertError):
        is_folder, exists = path.is_dir(), path.exists()
    if is_folder:
        chosen = next(known for known in FORMATS if known.is_folder)
    elif exists and not path.suffix:  # a file, or a pipe, which is no bag
        chosen = FORMATS[-1]
    else:
        chosen = next((known for known in FORMATS if _suffix_of(path) in known.suffixes), FORMATS[-1])
    return chosen.module


def _suffix_of(path: Path) -> str:
    """In lower case; empty for a number, as of a date (``run.2024``) or a version, which names no format."""
    suffix = path.suffix.lower()
    return "" if suffix[1:].isdecimal() else suffix
