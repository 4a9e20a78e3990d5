"""A labelling's orientations with each edge weighing what FineNet says it errs by."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from rotavg_ros.solver.slam.fine_net.evidence import Evidence
from rotavg_ros.solver.slam.fine_net.features import fine_features
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.scale import Told
from rotavg_ros.solver.slam.posterior.em import step
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.modes import FAR
from rotavg_ros.solver.slam.posterior.objective import Evaluation
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import residuals
from rotavg_ros.solver.slam.posterior.state import Noise, State
from rotavg_ros.solver.slam.posterior.system import Factorised

# NeuRoRA-v2 applies its FineNet twice.
PASSES = 2
# Sparse solves after each.
_SOLVES = 1
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


def all_fine_tuned(modes: list[Mode], network: SlamFineNet) -> list[Mode]:
    """The modes (the best first), those that are likely enough to be published fine-tuned."""
    return [fine_tuned(mode, network) if mode.cost <= modes[0].cost + FAR else mode for mode in modes]


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
        tuned = applied(network, tuned)
    residual = residuals(tuned.problem, tuned.state)
    evaluation = Evaluation(mode.evaluation.terms, residual, tuned.factorised.weight, tuned.factorised)
    return replace(mode, problem=tuned.problem, state=tuned.state, evaluation=evaluation)


@torch.inference_mode()
def applied(network: SlamFineNet, before: Tuned) -> Tuned:
    """After FineNet once more: its variances take the place of the noise's tails."""
    evidence = Evidence.of(before.problem, before.state)
    log_noise = network(fine_features(evidence)).double()
    used = torch.from_numpy(1 / evidence.weight)
    variance = used * log_noise.exp()
    scale = told(evidence).log_scale(used, variance)
    usual = evidence.own * np.exp(-evidence.log_relative)
    problem = before.problem.with_relative(variance.numpy() / usual)
    state = replace(before.state, noise=_scaled(before.state.noise, *scale.exp().tolist()))
    for _ in range(_SOLVES):
        state, _, factorised = step(problem, state)
    return Tuned(problem, state, factorised)


def told(evidence: Evidence) -> Told:
    """What others say of edges."""
    return Told(
        torch.from_numpy(evidence.is_odometry),
        torch.from_numpy(evidence.is_good.astype(np.float64)),
        torch.from_numpy(evidence.square),
        torch.from_numpy(evidence.predicted),
        evidence.components,
    )


def _scaled(noise: Noise, closures: float, steps: float) -> Noise:
    return replace(
        noise,
        step_variance=noise.step_variance * steps,
        closure_variance=noise.closure_variance * closures,
        step_tails=0.0,
        closure_tails=0.0,
    )
