"""The cases of the evaluation's suites."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation import real, rgbd, robustness, small_training, synthetic
from rotavg_ros.evaluation.contenders import contenders
from rotavg_ros.evaluation.noise_plot import edge_noise
from rotavg_ros.solver.network_store import read_network


def test_graphs_are_the_same_whatever_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(synthetic.RECIPES, "released", ReleasedRecipe(cameras=(20, 30)))
    few, many = list(synthetic.cases("released", 2, 1)), list(synthetic.cases("released", 3, 1))
    for one, other in zip(few, many, strict=False):
        assert torch.equal(one.graph.target_from_source, other.graph.target_from_source)
    other_seed = next(synthetic.cases("released", 1, 2))
    assert other_seed.graph.num_edges != few[0].graph.num_edges or not torch.equal(other_seed.truth, few[0].truth)


def test_rows_can_all_run() -> None:
    contenders([name for name in synthetic.ROWS if name not in ("colmap", "shonan")])


def test_settings_that_differ_in_training_alone_share_their_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = PaperRecipe(cameras=(20, 30))
    for name in ("easy", "easy-easy"):
        monkeypatch.setitem(robustness.SETTINGS, name, robustness.Setting("", robustness.SETTINGS[name].training, tiny))
    one, other = (next(robustness.cases(name, 1, 0)) for name in ("easy", "easy-easy"))
    assert torch.equal(one.graph.target_from_source, other.graph.target_from_source)
    assert robustness.num_graphs("25000", 10) == 1
    assert robustness.num_graphs("paper", 10) == 10


def test_large_graphs_have_the_share_of_pairs_they_should() -> None:
    sample = PaperRecipe(cameras=(4500, 4500), pair_share=(0.002, 0.002)).sample(np.random.default_rng(0))
    graph = sample.graph
    expected = 0.002 * 4500 * 4499 / 2
    assert graph.num_edges == pytest.approx(expected + 4499 * 0.998, abs=5 * np.sqrt(expected))
    assert len(torch.unique(graph.components())) == 1
    drawn = graph.select_edges(torch.arange(graph.num_edges) < int(expected * 0.9))
    assert bool((drawn.source < drawn.target).all())
    key = graph.source * 4500 + graph.target
    assert len(torch.unique(key)) == len(key)
    assert bool((torch.diff(key[: int(expected * 0.9)]) > 0).all())


def test_networks_trained_on_given_graphs_can_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robustness, "_TRAINING_GRAPHS", 3)
    monkeypatch.setattr(robustness, "_VALIDATION_GRAPHS", 1)
    monkeypatch.setitem(robustness.TRAINING_RECIPES, "easy", PaperRecipe(cameras=(12, 16), pair_share=(0.5, 0.5)))
    graphs = robustness.training_graphs("easy", 0)
    assert (len(graphs.training), len(graphs.validation)) == (3, 1)
    small_training.train_networks(tmp_path, graphs, seconds=0)
    for name in ("sfm-clean-net", "sfm-fine-net"):
        read_network(name, tmp_path / f"{name}.safetensors")

    case = next(synthetic.cases("released", 1, 0))
    ours = contenders(("neurora-paper",), tmp_path)["neurora-paper"](case)
    packages = contenders(("neurora-paper",))["neurora-paper"](case)
    assert ours is not None
    assert packages is not None
    assert not torch.allclose(ours.outlier_score, packages.outlier_score)


def test_no_scene_is_tested_by_networks_that_saw_it(shared_data: Path) -> None:
    folds = list(rgbd.folds(shared_data / "rgbd" / "redwood_fgr", 3, max_scenes=7))
    tested = [case.name for fold in folds for case in fold.test]
    assert len(tested) == len(set(tested)) == 7
    for fold in folds:
        learned = [*fold.training.training, *fold.training.validation]
        assert len(learned) == 7 - len(fold.test)
        seen = [graph.graph.target_from_source for graph in learned]
        for case in fold.test:
            assert not any(torch.equal(case.graph.target_from_source, quaternions) for quaternions in seen)
    with pytest.raises(UserError, match="too few"):
        list(rgbd.folds(shared_data / "rgbd" / "redwood_fgr", 4, max_scenes=7))


def test_madrid_agreement(shared_data: Path) -> None:
    case = real.madrid_case(shared_data)
    found = real.agreement(case, contenders(("spt", "chatterjee", "neurora")))
    np.testing.assert_allclose(np.diag(found.difference_deg), 0, atol=1e-4)
    assert found.difference_deg[1, 2] < found.difference_deg[0, 1]
    assert len(real.residual_table("", found).rows) == len(real.agreement_table("", found).rows) == 3


def test_noise_of_a_synthetic_graph_is_its_own() -> None:
    sample = ReleasedRecipe(cameras=(40, 40)).sample(np.random.default_rng(0))
    noise = edge_noise(sample.graph, sample.body_from_world)
    np.testing.assert_allclose(noise.angle_deg, np.degrees(sample.noise_angle.numpy()), atol=1e-6)
    # The recipe's noise axes lie in the plane z = 0, but for its tenth about any axis.
    assert np.nanmedian(np.abs(noise.axis[:, 2])) < 0.15
    assert not noise.is_residual
    assert edge_noise(sample.graph, None).is_residual
