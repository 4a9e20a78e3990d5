"""What a process imports at its start, by command: each must do without what it has no use for."""

from __future__ import annotations

import gc
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from rotavg_ros.startup import loading

_TELL = "import json, sys, atexit; atexit.register(lambda: print('\\n' + json.dumps(sorted(sys.modules))))\n"
_COMMAND = _TELL + "from rotavg_ros.cli.main import main\nsys.exit(main(sys.argv[1:]))"
_NODE = _TELL + "import rotavg_ros.ros.node.estimator_node"
# What takes a tenth of a second and more each.
_HEAVY = {"torch", "numpy", "scipy", "matplotlib", "rosbags", "yaml", "jinja2", "rclpy", "gtsam", "pycolmap", "open3d"}
_PICTURES_AND_BAGS = {"matplotlib", "rosbags", "mcap", "jinja2", "zstandard", "gtsam", "pycolmap", "open3d", "networkx"}
_WINGS = {"evaluation", "training", "reports", "replay", "bags"}


def modules_of(code: str, *arguments: str) -> set[str]:
    """What a process of its own has imported when it ends."""
    process = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True, timeout=120
    )
    return {*json.loads(process.stdout.splitlines()[-1])}


def wings(modules: set[str]) -> set[str]:
    """Of this package."""
    return {name.split(".")[1] for name in modules if name.startswith("rotavg_ros.")}


@pytest.mark.parametrize(
    "words",
    [
        ("--help",),
        *((name, "--help") for name in ("solve", "replay", "evaluate", "benchmark", "train", "convert", "simulate")),
    ],
    ids=" ".join,
)
def test_help_needs_no_library(words: tuple[str, ...]) -> None:
    assert not modules_of(_COMMAND, *words) & _HEAVY


def test_a_solve_needs_no_pictures_bags_robots_or_evaluation(tmp_path: Path) -> None:
    lines = [f"EDGE_SE2 {a} {b} 1 0 0.1 1 0 0 1 0 1" for a, b in ((0, 1), (1, 2), (2, 0))]
    graph = tmp_path / "graph.g2o"
    graph.write_text("\n".join(lines) + "\n")
    modules = modules_of(_COMMAND, "solve", str(graph), "--output", str(tmp_path / "answer"))
    assert (tmp_path / "answer" / "orientations.csv").is_file() and "torch" in modules
    assert not modules & (_PICTURES_AND_BAGS | {"rclpy"})  # numba looks for settings of its own in YAML
    assert not wings(modules) & {*_WINGS, "online", "inputs", "settings", "ros"}
    assert "rotavg_ros.solver.slam.solve" in modules and "rotavg_ros.solver.sfm.solve" not in modules


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs ROS 2")
def test_a_node_needs_no_pictures_bags_or_evaluation_and_leaves_the_solver_to_its_process() -> None:
    modules = modules_of(_NODE)
    assert "rotavg_ros.ros.node.estimator_node" in modules
    assert not modules & _PICTURES_AND_BAGS
    assert not wings(modules) & {*_WINGS, "datasets", "metrics", "cli"}
    assert not modules & {"rotavg_ros.solver.pipeline", "rotavg_ros.solver.networks", "safetensors", "scipy", "numba"}


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs ROS 2")
def test_playing_a_bag_needs_no_solver() -> None:
    modules = modules_of(_TELL + "import rotavg_ros.cli.play, rotavg_ros.ros.harness.player")
    assert "rosbags" in modules
    assert not modules & {"torch", "scipy", "numba"}
    assert wings(modules) == {"bags", "cli", "errors", "packed", "ros", "stamps", "version"}


@pytest.mark.parametrize("enabled", [True, False])
def test_what_is_loaded_is_never_looked_through_and_the_collector_is_as_it_was(enabled: bool) -> None:
    was_enabled = gc.isenabled()
    (gc.enable if enabled else gc.disable)()
    try:
        with loading():
            assert not gc.isenabled()
            kept = [[] for _ in range(1000)]
        assert gc.isenabled() == enabled and gc.get_freeze_count() > len(kept)
    finally:
        gc.unfreeze()
        (gc.enable if was_enabled else gc.disable)()
