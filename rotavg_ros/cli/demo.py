"""What ``rotavg demo`` does: it prepares a bag, plays it to the node, and shows what came out."""

from __future__ import annotations

import argparse
import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.bags.graph_to_bag import write_graph_bag
from rotavg_ros.bags.reader import BagReader
from rotavg_ros.bags.run_bag import write_run_bag
from rotavg_ros.bags.topics import EDGE_TOPIC, ODOM_TOPIC
from rotavg_ros.cli.options.simulate import add_run_arguments
from rotavg_ros.cli.progress import working
from rotavg_ros.cli.simulate import describe, simulate
from rotavg_ros.datasets.dead_reckoning import chain_poses
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.files.ground_truth import attach_stamps, attach_truth
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.evaluation.live.played_run import LiveReport, PlayedRun, edge_is_false, judge

# Duration of the playback: slow enough for the node to work as it would live, short enough for a visitor.
_PLAY_SECONDS = 12.0
_MESSAGES_PER_SECOND = 1200.0
# The node would wait for keyframes to which no odometry leads, as all of a photo collection are.
_FROM_EDGES = {"keyframe_source": "edges", "unknown_keyframes": "create"}


class DemoError(UserError):
    """An output folder that is in use, or options that do not fit together."""


@dataclass(frozen=True)
class _Scene:
    """A bag ready to play, and what is known about it."""

    title: str
    description: str
    run: PlayedRun
    is_closure: NDArray[np.bool_]
    node_parameters: dict[str, str]


def run(arguments: argparse.Namespace) -> int:
    """Prepare, play, judge, show."""
    if arguments.graph is None and (arguments.truth is not None or arguments.stamps is not None):
        raise DemoError("--truth and --stamps belong to --graph; give the graph as well")
    if arguments.graph is not None and (stated := _of_a_run(arguments)):
        raise DemoError(f"--graph is your own graph; leave out {', '.join(stated)}, which is for simulated runs")
    try:
        from rotavg_ros.ros.harness.live_run import Playing, installed_node, keep_to_this_machine, play_to_node
    except ImportError as error:
        raise DemoError(
            f"the demo needs ROS 2's rclpy and rotavg_msgs ({error}); run `make setup` in the sources"
        ) from None
    installed_node()
    output = _new_folder(arguments.output)
    bag = output / "bag"
    try:
        with working("preparing the bag"):
            scene = _simulated(bag, arguments) if arguments.graph is None else _own_graph(bag, arguments)
    except UserError:
        with suppress(OSError):
            output.rmdir()  # leave no empty folder behind
        raise
    print(f"{scene.title}: {scene.description}\nplaying it to the node …", flush=True)
    keep_to_this_machine()
    playing = Playing(bag, _topics(bag), _rate(bag) if arguments.rate is None else arguments.rate)
    answer = play_to_node(playing, scene.node_parameters, output / "node.log", working)
    report = judge(answer, scene.run, scene.is_closure)
    with working("drawing"):
        from rotavg_ros.evaluation.live.picture import draw

        draw(report, output / "demo.png", scene.title)
    (output / "summary.json").write_text(json.dumps(_summary(report), indent=2) + "\n", encoding="utf-8")
    print("\n" + _table(report) + f"\n\npicture: {output / 'demo.png'}")
    return 0


def _of_a_run(arguments: argparse.Namespace) -> list[str]:
    """Options that say what a simulated run is like, and are not at their defaults."""
    parser = argparse.ArgumentParser()
    add_run_arguments(parser)
    defaults = vars(parser.parse_args([]))
    return [f"--{name.replace('_', '-')}" for name, value in defaults.items() if getattr(arguments, name) != value]


def _new_folder(wanted: Path | None) -> Path:
    if wanted is None:
        names = ["rotavg_demo", *(f"rotavg_demo_{number}" for number in range(2, 1000))]
        wanted = next(Path(name) for name in names if not Path(name).exists())
    else:
        with asking_about(wanted, DemoError):
            is_taken = wanted.exists() and (not wanted.is_dir() or any(wanted.iterdir()))
        if is_taken:
            raise DemoError(f"{wanted}: exists already; choose another --output")
    try:
        wanted.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DemoError(f"{wanted}: cannot be made: {error.strerror}") from None
    return wanted


def _simulated(bag: Path, arguments: argparse.Namespace) -> _Scene:
    simulated: SimulatedRun = simulate(arguments)
    write_run_bag(bag, simulated)
    # The bag numbers the closures; odometry edges are the node's own.
    closures = np.flatnonzero(~simulated.graph.is_odometry.numpy())
    run = PlayedRun(
        ids=None,
        stamps_ns=simulated.stamps_ns,
        odometry_world_from_body=simulated.odometry_world_from_body,
        odometry_position=simulated.odometry_position,
        true_world_from_body=simulated.world_from_body,
        true_position=simulated.position,
        edge_is_false=simulated.closure_is_false[closures].astype(float),
    )
    title = f"A robot on {arguments.laps:g} laps of a {arguments.world}, simulated in {arguments.dimensions}D"
    return _Scene(title, describe(simulated), run, np.ones(len(closures), dtype=bool), {"keyframe_source": "odometry"})


def _own_graph(bag: Path, arguments: argparse.Namespace) -> _Scene:
    graph_file: GraphFile = read_graph(arguments.graph)
    if arguments.stamps is not None:
        graph_file = attach_stamps(graph_file, arguments.stamps)
    if arguments.truth is not None:
        graph_file = attach_truth(graph_file, arguments.truth)
    write_graph_bag(bag, graph_file)
    graph = graph_file.graph
    translation = graph_file.edge_translation
    position, orientation = chain_poses(graph, np.zeros((graph.num_edges, 3)) if translation is None else translation)
    stamps_ns = graph_file.stamps_ns
    truth = graph_file.body_from_world_gt
    is_closure = ~graph.is_odometry.numpy()
    run = PlayedRun(
        ids=graph_file.node_ids,
        stamps_ns=np.arange(graph.num_nodes) * 100_000_000 if stamps_ns is None else stamps_ns,
        odometry_world_from_body=orientation,
        odometry_position=position,
        true_world_from_body=None if truth is None else truth * [-1, -1, -1, 1],
        true_position=graph_file.position_gt,
        edge_is_false=edge_is_false(graph, truth, graph_file.position_gt),
    )
    description = f"{graph.num_nodes} keyframes, {int(is_closure.sum())} loop closures"
    return _Scene(arguments.graph.name, description, run, is_closure, _FROM_EDGES)


def _topics(bag: Path) -> list[str]:
    with BagReader(bag) as reader:
        return [topic for topic in (ODOM_TOPIC, EDGE_TOPIC) if topic in reader.topics]


def _rate(bag: Path) -> float:
    topics = _topics(bag)
    with BagReader(bag) as reader:
        seconds = max(_PLAY_SECONDS, reader.num_messages(topics) / _MESSAGES_PER_SECOND)
        return max(reader.duration_s / seconds, 1e-3)


def _summary(report: LiveReport) -> dict[str, Any]:
    """The table's content as numbers; None where the truth is unknown."""
    verdicts, degrees = report.verdicts, None
    if report.knows_errors:
        degrees = {
            name: {"mean": float(np.degrees(np.nanmean(error))), "median": float(np.degrees(np.nanmedian(error)))}
            for name, error in (("odometry", report.odometry_error), ("corrected", report.corrected_error))
        }
    return {
        "keyframes": len(report.seconds),
        "loop_closures": len(report.closure_ends),
        "flagged": int(report.closure_flagged.sum()),
        "orientation_error_deg": degrees,
        "false_closures": None
        if verdicts is None
        else {
            "total": verdicts.true_positives + verdicts.false_negatives,
            "found": verdicts.true_positives,
            "good_flagged": verdicts.false_positives,
            "precision": verdicts.precision,
            "recall": verdicts.recall,
        },
        "diagnostics": report.diagnostics,
    }


def _table(report: LiveReport) -> str:
    summary, node = _summary(report), report.diagnostics
    errors, false = summary["orientation_error_deg"], summary["false_closures"]
    if errors is None:
        error_row = "not known: no ground truth was given (--truth)"
    else:
        before, after = errors["odometry"], errors["corrected"]
        error_row = ", ".join(f"{before[name]:.2f}° → {after[name]:.2f}° {name}" for name in ("mean", "median"))
    if false is None:
        false_row = f"{summary['flagged']} flagged; how many rightly is not known"
    elif false["total"] == 0:
        false_row = f"there are none; {false['good_flagged']} good ones flagged"
    else:
        false_row = (
            f"{false['found']} of {false['total']} found: precision {false['precision']:.3f}, "
            f"recall {false['recall']:.3f}"
        )
    rows = [
        ("graph", f"{summary['keyframes']} keyframes, {summary['loop_closures']} loop closures"),
        ("orientation error (odometry → node)", error_row),
        ("false loop closures", false_row),
        (
            "solving",
            f"{node.get('ticks', '?')} ticks, p50 {node.get('tick p50 ms', '?')} ms, "
            f"p95 {node.get('tick p95 ms', '?')} ms",
        ),
        ("lost messages", node.get("lost messages", "?")),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name:<{width}}   {value}" for name, value in rows)
