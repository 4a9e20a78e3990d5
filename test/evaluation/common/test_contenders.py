"""Who is compared."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rotavg_ros.evaluation.common.cases import SLAM, warm_up_case
from rotavg_ros.evaluation.common.contenders import contenders, warm_up
from rotavg_ros.evaluation.slam.contenders import ROSTER


def test_everyone_solves_and_judges() -> None:
    pytest.importorskip("gtsam")
    pytest.importorskip("pycolmap")
    case = warm_up_case(SLAM)
    chosen = contenders(("neurora", "spt+chatterjee", "gnc", "isam2", "colmap", *ROSTER.references), ROSTER)
    warm_up(chosen.values(), ROSTER)
    for name, contender in chosen.items():
        answer = contender(case)
        assert answer is not None, name
        assert tuple(answer.body_from_world.shape) == (4, 4)
        assert answer.outlier_score is not None, name
        assert float(answer.outlier_score.max()) < 0.5, name
        assert answer.seconds > 0 and answer.cpu_seconds >= 0
    ours = chosen["neurora"](case)
    assert ours is not None and ours.uncertainty is not None


def test_a_peer_is_spared_what_is_too_large_for_it() -> None:
    pytest.importorskip("pycolmap")
    case = warm_up_case(SLAM)
    for limit, solves in ((case.graph.num_edges, True), (case.graph.num_edges - 1, False)):
        contender = contenders(["colmap"], replace(ROSTER, max_edges={"colmap": limit}))["colmap"]
        assert (contender(case) is not None) == solves


def test_who_judges_no_edges_is_judged_by_residuals() -> None:
    case = warm_up_case(SLAM)
    wrong = case.graph.target_from_source.clone()
    wrong[3] = torch.tensor([0.0, 0.0, 1.0, 0.0])
    case = replace(case, graph=replace(case.graph, target_from_source=wrong))
    answer = contenders(["odometry"], ROSTER)["odometry"](case)
    assert answer is not None and answer.outlier_score is not None
    assert (answer.outlier_score > 0.5).tolist() == [False, False, False, True]
