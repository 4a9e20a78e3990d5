"""The cases of the evaluation's suites."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.cases import CaseKey, drawings
from rotavg_ros.evaluation.common.contenders import contenders
from rotavg_ros.evaluation.common.scoring import Scores
from rotavg_ros.evaluation.sfm import real, rgbd, small_training, synthetic
from rotavg_ros.evaluation.sfm.contenders import ROSTER
from rotavg_ros.metrics import CalibrationBins
from rotavg_ros.solver.networks import NETWORKS
from rotavg_ros.solver.neurora.network_store import read_network
from rotavg_ros.training.sfm_tasks import GivenGraphs


def test_graphs_are_the_same_whatever_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(synthetic.RECIPES, "released", ReleasedRecipe(cameras=(20, 30)))
    few, many = (list(drawings(synthetic.kinds(["released"], 1), range(count))) for count in (2, 3))
    for one, other in zip(few, many, strict=False):
        assert torch.equal(one.graph.target_from_source, other.graph.target_from_source)
    other_seed = next(drawings(synthetic.kinds(["released"], 2), [0]))
    assert other_seed.graph.num_edges != few[0].graph.num_edges or not torch.equal(other_seed.truth, few[0].truth)
    assert len({case.key for case in (*many, other_seed)}) == 4


def test_rows_can_all_run() -> None:
    contenders([name for name in synthetic.ROWS if name not in ROSTER.peers], ROSTER)


def test_a_run_that_is_interrupted_before_its_first_graph_has_a_page_without_pictures(tmp_path: Path) -> None:
    nothing = Scores(calibration={name: CalibrationBins() for name in synthetic.CORE}, interrupted=True)
    page = synthetic.report(
        tmp_path, synthetic.Results(synthetic.CORE, {"paper": nothing}), "rotavg evaluate synthetic"
    )
    assert "0 graphs." in page.read_text(encoding="utf-8")
    assert not [*tmp_path.glob("*.png")]


def test_oracles_give_up_where_the_truth_is_unknown() -> None:
    """As on Madrid, beside which all other answers had been lost."""
    sample = PaperRecipe(cameras=(12, 16), pair_share=(0.5, 0.5)).sample(np.random.default_rng(0))
    known = synthetic.case_of(CaseKey("known"), sample)
    unknown = replace(known, truth=torch.full_like(known.truth, torch.nan), noise_covariance=None)
    for oracle in contenders(("oracle", "oracle-shaped", "oracle-covariances"), ROSTER).values():
        assert oracle(known) is not None
        assert oracle(unknown) is None


@pytest.mark.large
def test_networks_trained_on_given_graphs_can_be_used(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    recipe = PaperRecipe(cameras=(12, 16), pair_share=(0.5, 0.5))
    graphs = GivenGraphs([recipe.sample(rng) for _ in range(3)], [recipe.sample(rng)])
    small_training.train_networks(tmp_path, graphs, seconds=0)
    for name in ("sfm-clean-net", "sfm-fine-net"):
        read_network(NETWORKS[name], tmp_path / f"{name}.safetensors")

    case = next(drawings(synthetic.kinds(["released"], 0), [0]))
    ours = contenders(("neurora-v1",), ROSTER, tmp_path)["neurora-v1"](case)
    packages = contenders(("neurora-v1",), ROSTER)["neurora-v1"](case)
    assert ours is not None and ours.outlier_score is not None
    assert packages is not None and packages.outlier_score is not None
    assert not torch.allclose(ours.outlier_score, packages.outlier_score)


def test_no_scene_is_tested_by_networks_that_saw_it(shared_data: Path) -> None:
    folds = list(rgbd.folds(shared_data / "rgbd" / "redwood_fgr", 3, max_scenes=7))
    tested = [case.key.name for fold in folds for case in fold.test]
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
    few = (case.graph.source < 120) & (case.graph.target < 120)  # all of them take a minute
    case = replace(case, graph=replace(case.graph.select_edges(few), num_nodes=120), truth=case.truth[:120])
    found = real.agreement(case, contenders(("spt", "chatterjee", "neurora"), ROSTER))
    np.testing.assert_allclose(np.diag(found.difference_deg), 0, atol=1e-4)
    assert found.difference_deg[1, 2] < found.difference_deg[0, 1]
    assert len(real.residual_table("", found).rows) == len(real.agreement_table("", found).rows) == 3
