"""What ``rotavg plot`` does: it reads a graph and draws."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from matplotlib.backend_bases import FigureCanvasBase

from rotavg_ros.cli.progress import working
from rotavg_ros.datasets.files.formats import read_graph, stem_of
from rotavg_ros.datasets.files.ground_truth import attach_truth
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.noise_plot import draw, edge_noise
from rotavg_ros.evaluation.common.training_plot import draw_training


class PlotError(UserError):
    """A picture that cannot be drawn or written."""


def run(arguments: argparse.Namespace) -> int:
    """Draw."""
    if arguments.output is not None:
        arguments.output = _picture(arguments.output)
    return _run_training(arguments) if arguments.kind == "training" else _run_statistics(arguments)


def _picture(output: Path) -> Path:
    """The file to draw into; a solve that may take minutes comes first, so what is wrong with it is said before.

    Raises:
        PlotError: a folder, or a place or a kind of picture that cannot be written.
    """
    if output.is_dir():
        raise PlotError(f"{output}: is a folder; give --output a picture's name in it, such as noise.png")
    if not output.parent.is_dir():
        raise PlotError(f"{output}: there is no folder {output.parent}; make it first")
    if not output.suffix:
        return output.with_name(f"{output.name}.png")
    usable = sorted(FigureCanvasBase.get_supported_filetypes())
    if output.suffix.lower().removeprefix(".") not in usable:
        raise PlotError(f"{output}: unknown suffix {output.suffix!r}; use .png, or one of {', '.join(usable)}")
    return output


def _run_training(arguments: argparse.Namespace) -> int:
    with _writing(arguments.output):
        draw_training(arguments.output, arguments.logs)
    print(arguments.output)
    return 0


def _run_statistics(arguments: argparse.Namespace) -> int:
    with working(f"reading {arguments.graph}"):
        graph_file = read_graph(arguments.graph)
        if arguments.truth is not None:
            graph_file = attach_truth(graph_file, arguments.truth)
    graph, truth = graph_file.graph, graph_file.body_from_world_gt
    if graph.num_edges == 0:
        raise PlotError(f"{arguments.graph}: has no edges, so there is nothing to draw")
    outlier_angle_deg = arguments.outlier_angle
    if outlier_angle_deg is None:
        outlier_angle_deg = 10.0 if bool(graph.is_odometry.any()) else 20.0
    known = None if truth is None else torch.from_numpy(np.isfinite(truth).all(axis=1))
    knows_truth = known is not None and bool((known[graph.source] & known[graph.target]).any())
    if arguments.truth is not None and not knows_truth:
        raise PlotError(f"{arguments.truth}: knows the orientations of both ends of no edge; leave --truth out")
    output = arguments.output or Path(f"{stem_of(arguments.graph)}-statistics.png")
    with working("solving and drawing"):
        noise = edge_noise(graph, torch.from_numpy(truth) if truth is not None and knows_truth else None)
        with _writing(output):
            draw(output, noise, arguments.graph.name, outlier_angle_deg)
    print(output)
    return 0


@contextmanager
def _writing(output: Path) -> Iterator[None]:
    """For a block in which matplotlib writes ``output``."""
    try:
        yield
    except UserError:
        raise
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise PlotError(f"{output}: cannot be written ({reason})") from None
