"""A labelling's orientations with each edge weighing what FineNet says it errs by."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from rotavg_ros.solver.slam.fine_net.evidence import Evidence
from rotavg_ros.solver.slam.fine_net.features import fine_features
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.posterior.em import estimate_noise, step
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.objective import Evaluation
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import residuals
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.solver.slam.posterior.system import Factorised

# NeuRoRA-v2 applies its FineNet twice.
PASSES = 2
# Sparse solves after each: orientations and noise follow the weights.
SOLVES = 2
# Fewer edges of odometry or closures tell nothing of how they differ.
_LEAST_EDGES = 3


@dataclass(frozen=True)
class Tuned:
    """A labelling under weights of FineNet's.

    Attributes:
        problem: with those variances.
        state: the same labels.
        factorised: the last solve.
    """

    problem: Problem
    state: State
    factorised: Factorised


def fine_tuned(mode: Mode, network: SlamFineNet, passes: int = PASSES) -> Mode:
    """The mode's labels, orientations and noise under variances that FineNet predicts.

    F and so the mode's probability among its rivals stay as they were found: labellings are compared by one model.

    Args:
        mode: at its optimum.
        network: FineNet.
        passes: how often it is applied.
    """
    closures = len(mode.problem.closure)
    if min(closures, len(mode.problem.graph.source) - closures) < _LEAST_EDGES:
        return mode
    tuned = Tuned(mode.problem, mode.state, mode.evaluation.factorised)
    for _ in range(passes):
        tuned = followed(tuned, predicted(network, Evidence.of(tuned.problem, tuned.state)))
    residual = residuals(tuned.problem, tuned.state)
    evaluation = Evaluation(mode.evaluation.terms, residual, tuned.factorised.weight, tuned.factorised)
    return replace(mode, problem=tuned.problem, state=tuned.state, evaluation=evaluation)


def predicted(network: SlamFineNet, evidence: Evidence) -> np.ndarray:
    """``(E,)`` logarithms of variances over what they are in ``evidence``."""
    with torch.no_grad():
        return np.asarray(network(fine_features(evidence)).double().numpy())


def followed(before: Tuned, log_relative: np.ndarray) -> Tuned:
    """The solve under variances that differ by ``log_relative`` ``(E,)`` from those before."""
    relative = np.exp(log_relative) * (1.0 if before.problem.relative is None else before.problem.relative)
    problem, state = before.problem.with_relative(relative), before.state
    for _ in range(SOLVES):
        state, _, factorised = step(problem, state)
        state = replace(state, noise=estimate_noise(problem, state, factorised))
    return Tuned(problem, state, factorised)
