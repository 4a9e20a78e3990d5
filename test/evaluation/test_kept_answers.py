"""Answers that are kept are found again, for the same case alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from rotavg_ros.datasets.synthetic import ReleasedRecipe
from rotavg_ros.evaluation.contenders import Answer, Case, contenders
from rotavg_ros.evaluation.kept_answers import kept


def test_a_case_is_solved_once(tmp_path) -> None:
    sample = ReleasedRecipe(cameras=(20, 20)).sample(np.random.default_rng(1))
    case = Case("any", sample.graph, sample.body_from_world)
    solved = []

    def contender(of: Case) -> Answer | None:
        solved.append(of)
        return None if of.name == "too large" else contenders(["neurora"])["neurora"](of)

    again = kept("neurora", contender, Answer, tmp_path)
    first, second = again(case), kept("neurora", contender, Answer, tmp_path)(case)
    assert first is not None and second is not None and len(solved) == 1
    assert torch.equal(first.body_from_world, second.body_from_world)
    assert torch.equal(first.outlier_score, second.outlier_score) and first.cpu_seconds == second.cpu_seconds
    assert again(replace(case, name="too large")) is None is again(replace(case, name="too large"))
    measured = case.graph.target_from_source.clone()
    measured[0] = measured[1]
    again(replace(case, graph=replace(case.graph, target_from_source=measured)))
    kept("spt", contender, Answer, tmp_path)(case)
    assert len(solved) == 4
