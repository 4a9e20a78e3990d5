"""A small planar pose graph for the tests of the SLAM suite."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import Case, CaseKey
from rotavg_ros.evaluation.common.contenders import contenders
from rotavg_ros.evaluation.slam import cases
from rotavg_ros.evaluation.slam.contenders import ROSTER

NUM_NODES, LAP = 120, 30


def laps(step_deg: float = 0.1, closure_deg: float = 0.5) -> GraphFile:
    """Planar laps with a closure to the lap before at every second keyframe."""
    rng = np.random.default_rng(0)
    later = np.arange(LAP, NUM_NODES, 2)
    source = np.concatenate((np.arange(NUM_NODES - 1), later - LAP))
    target = np.concatenate((np.arange(1, NUM_NODES), later))
    sigma = np.repeat(np.radians([step_deg, closure_deg]), (NUM_NODES - 1, len(later)))
    turn = -2 * np.pi * (target - source) / LAP + sigma * rng.normal(size=len(source))
    vector = torch.from_numpy(np.stack((0 * turn, 0 * turn, turn), axis=1))
    kind = (np.arange(len(source)) >= NUM_NODES - 1).astype(int)
    rotation = rotations.exp(vector).numpy()
    return GraphFile.from_ids(source, target, rotation, kind=kind, precision=sigma**-2, planar=True)


def spoiled(condition: str = "30 % random", share: float = 0.3, seed: int = 0) -> Case:
    return cases.spoiled_case(CaseKey("laps", condition, seed), laps(), share)


def answer_of(contender: str, case: Case) -> Answer:
    """What a contender of the SLAM suite says."""
    answer = contenders([contender], ROSTER)[contender](case)
    assert answer is not None
    return answer
