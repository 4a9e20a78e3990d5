"""Which contender runs on which graph, on a clock of the test's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.evaluation.benchmark import report, schedule
from rotavg_ros.evaluation.benchmark.measure import Measurement
from rotavg_ros.evaluation.benchmark.plans import load


def test_what_takes_too_long_is_left_out_and_said() -> None:
    pytest.importorskip("pycolmap")
    pytest.importorskip("gtsam")
    clock = [0.0]

    def measured(path: Path, contender: str, repeats: int, timeout_s: float) -> Measurement | str:
        graph = load(path).graph
        solving = (1e-4 if contender.startswith("neurora") else 1e-2) * graph.num_edges
        clock[0] += 1 + solving
        if contender == "shonan":
            return "failed with exit code 1: no reason"
        seconds = [solving]
        return Measurement(contender, graph.num_nodes, graph.num_edges, seconds, seconds, 0.5, 0.4, 2 * 10**6, 10**6)

    said: list[str] = []
    stage = schedule.Stage(measured, said.append, lambda: clock[0])
    wishes = schedule.Wishes(["sfm-sparse"], 6, (1, 10_000), 3)
    results = schedule.run(wishes, stage)["sfm-sparse"]
    assert [result.plan.nodes for result in results] == [100, 250, 1000]
    assert all("neurora" in result.measured for result in results)
    assert results[0].missing["shonan"].startswith("failed")
    assert results[1].missing["shonan"] == "failed on a smaller graph"
    assert "colmap" in results[1].measured
    assert results[2].missing["colmap"].startswith("not run: about ")
    assert len(said) == sum(len(result.measured) for result in results)
    table = report.time_table("sfm-sparse", results)
    assert "COLMAP: 1000 nodes and about 10000 edges: not run" in table.to_markdown()
    assert np.isclose(float(str(table.rows[0][8])), 1.0)
    (said_of_colmap,) = report.summary({"sfm-sparse": results})
    assert (
        "COLMAP: on the largest graph that both solved (250 nodes, 2690 edges) it takes 100.0 times" in said_of_colmap
    )
    assert said_of_colmap.endswith("nowhere is it faster or more exact.")
