"""The same bag through the live node over DDS and through the replay: the same answer."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")

from rotavg_ros.bags.run_bag import write_run_bag
from rotavg_ros.cli.main import main
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph

ROTAVG = Path(sys.executable).with_name("rotavg")


def by_edge(flags: Any, values: Sequence[float]) -> dict[tuple[int, ...], float]:
    """In which order edges came is up to the transport. The ids of odometry's own edges are all the same."""
    ends = flags.source_ids, flags.target_ids, flags.edge_ids
    keys = (tuple(map(int, ids)) for ids in zip(*ends, strict=True))
    return {key: float(value) for key, value in zip(keys, values, strict=True)}


@pytest.mark.ros
def test_a_replay_says_what_the_live_node_says(tmp_path: Path, live_node, start_process) -> None:
    run = simulate_slam_graph(RobotRun(laps=1.5, false_share=0.4, dimensions=3).config(), np.random.default_rng(11))
    write_run_bag(tmp_path / "bag", run)
    settings = ["keyframe_distance_m:=0.3", "keyframe_angle_deg:=8.0"]
    live_node.start(*settings)
    player = start_process(ROTAVG, "play", tmp_path / "bag", "--rate", "0")
    live_node.spin_until(lambda: not player.is_running)
    assert player.wait() == 0, player.output
    published = live_node.wait_for_silence()
    live_flags = live_node.flags[-1]

    words = [word for setting in [*settings, "solve_period_s:=40.0"] for word in ("-p", setting)]
    output = ["--output", str(tmp_path / "replayed"), "--no-report"]
    assert main(["replay", str(tmp_path / "bag"), *output, *words]) == 0
    with AnyReader([tmp_path / "replayed" / "run.mcap"]) as reader:
        newest = {connection.topic: (data, connection.msgtype) for connection, _, data in reader.messages()}
        recorded = reader.deserialize(*newest["/abs_orientations"])
        flags = reader.deserialize(*newest["/outlier_flags"])

    assert recorded.keyframe_ids.tolist() == list(published.keyframe_ids)
    assert recorded.stamps_ns.tolist() == list(published.stamps_ns)
    ours, theirs = (Rotation.from_quat(np.reshape(said.orientations, (-1, 4))) for said in (recorded, published))
    assert np.degrees((ours.inv() * theirs).magnitude().max()) < 0.01

    our_flags, their_flags = by_edge(flags, flags.outliers), by_edge(live_flags, live_flags.outliers)
    assert len(our_flags) == len(flags.edge_ids)
    assert our_flags == their_flags
    assert sum(our_flags.values()) > 5
    assert by_edge(flags, flags.scores) == pytest.approx(by_edge(live_flags, live_flags.scores), abs=1e-4)
