"""The graphs of the benchmark."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rotavg_ros.evaluation.benchmark.plans import FAMILIES, load, save


@pytest.mark.parametrize("family", FAMILIES)
def test_graphs_are_as_large_as_they_say_and_survive_the_file(tmp_path: Path, family: str) -> None:
    plan = min(FAMILIES[family].plans, key=lambda plan: plan.expected_edges)
    drawn = plan.draw()
    if family != "recipe":  # which draws its size
        assert drawn.graph.num_nodes == plan.nodes
        assert drawn.graph.num_edges == pytest.approx(plan.expected_edges, rel=0.1)
    save(tmp_path / "graph.npz", drawn)
    loaded, again = load(tmp_path / "graph.npz"), plan.draw()
    for name in ("source", "target", "target_from_source", "kind", "precision"):
        for other in (getattr(loaded.graph, name), getattr(again.graph, name)):
            torch.testing.assert_close(other, getattr(drawn.graph, name), rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(loaded.truth, drawn.truth, rtol=0, atol=0)
    assert loaded.key == drawn.key and loaded.family == drawn.family
