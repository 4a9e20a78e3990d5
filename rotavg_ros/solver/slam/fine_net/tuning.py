"""A labelling's orientations with the weight of each edge from the variance that FineNet predicts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.fine_net.evidence import Evidence
from rotavg_ros.solver.slam.fine_net.features import fine_features
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.scale import Told
from rotavg_ros.solver.slam.posterior.em import step
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.objective import Evaluation
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import residuals
from rotavg_ros.solver.slam.posterior.state import Noise, State
from rotavg_ros.solver.slam.posterior.system import Factorised

# NeuRoRA-v2 applies its FineNet twice.
PASSES = 2
# FineNet is believed for a kind of edges if it explains them better by more nats than the first, and fully after as
# many more as the second: if all edges of a kind err alike, it gains up to some 15 by chance.
_CHANCE, _SURE = 12.0, 12.0
# Number of sparse solves after each application.
_SOLVES = 1
# With fewer edges of odometry, or closures, FineNet is not applied.
_LEAST_EDGES = 3
# Units of work per edge: for the features, and for the network.
_SEEN, _EDGE = 0.003, 0.005


@dataclass(frozen=True)
class Tuned:
    """A labelling under FineNet's variances.

    Attributes:
        problem: the problem with those variances.
        state: a state with the same labels.
        factorised: H of its last solve.
    """

    problem: Problem
    state: State
    factorised: Factorised


def fine_tuned(mode: Mode, network: SlamFineNet, passes: int = PASSES) -> Mode:
    """The mode's labelling under variances that FineNet predicts; the mode itself if it has too few edges of a kind.

    F, and with it the mode's probability among its rivals, stays as found: labellings are compared by one noise model.

    Args:
        mode: the mode at its optimum.
        network: FineNet.
        passes: number of applications.
    """
    closures = len(mode.problem.closure)
    if min(closures, len(mode.problem.graph.source) - closures) < _LEAST_EDGES:
        return mode
    tuned = Tuned(mode.problem, mode.state, mode.evaluation.factorised)
    for _ in range(passes):
        tuned = applied(network, tuned)
    residual = residuals(tuned.problem, tuned.state)
    solved = tuned.factorised
    evaluation = Evaluation(mode.evaluation.terms, residual, solved.weight, solved, tuned.state.others)
    return replace(mode, problem=tuned.problem, state=tuned.state, evaluation=evaluation)


@torch.inference_mode()
def applied(network: SlamFineNet, before: Tuned) -> Tuned:
    """Result of applying FineNet once more; its variances replace the noise model's tails."""
    spend(_SEEN * len(before.state.trusted))
    evidence = Evidence.of(before.problem, before.state)
    features = fine_features(evidence)
    spend(_EDGE * len(before.state.trusted))
    log_noise = network(features).double()
    used = torch.from_numpy(1 / evidence.weight)
    edges = told(evidence, before.problem.priors)
    variance = used * (believed(evidence, edges, used, log_noise) * log_noise).exp()
    scale = edges.log_scale(used, variance)
    usual = evidence.own * np.exp(-evidence.log_relative)
    problem = before.problem.with_relative(variance.numpy() / usual)
    state = replace(before.state, noise=_scaled(before.state.noise, *scale.exp().tolist()))
    for _ in range(_SOLVES):
        state, _, _, factorised = step(problem, state)
    return Tuned(problem, state, factorised)


def believed(evidence: Evidence, edges: Told, used: Tensor, log_noise: Tensor) -> Tensor:
    """``(E,)`` how far FineNet is believed for each edge's kind, 0 to 1, by the nats that it gains there.

    It has seen the discrepancies that it explains, so it gains some nats even if all edges of a kind err alike.

    Args:
        evidence: evidence of the solve.
        edges: the same, as :func:`told` has it.
        used: ``(E,)`` rad², variances without FineNet.
        log_noise: ``(E,)`` logarithms of its variances relative to these.
    """
    kind = edges.is_odometry.long()
    variance = used * log_noise.exp()
    total = variance * edges.log_scale(used, variance).exp()[kind] + edges.predicted
    k = edges.components
    log_density = -edges.square / (2 * total) - k / 2 * torch.log(2 * np.pi * total)
    gained = edges.good * (log_density - torch.from_numpy(evidence.log_density))
    nats = torch.zeros(2, dtype=torch.float64).index_add(0, kind, gained)
    return ((nats - _CHANCE) / _SURE).clamp(0.0, 1.0)[kind]


def told(evidence: Evidence, priors: SlamPriors) -> Told:
    """Evidence on the noise of edges, with the noise's prior."""
    return Told(
        torch.from_numpy(evidence.is_odometry),
        torch.from_numpy(evidence.is_good.astype(np.float64)),
        torch.from_numpy(evidence.square),
        torch.from_numpy(evidence.predicted),
        evidence.components,
        priors.noise_spread,
    )


def _scaled(noise: Noise, closures: float, steps: float) -> Noise:
    return replace(
        noise,
        step_variance=noise.step_variance * steps,
        closure_variance=noise.closure_variance * closures,
        step_tails=0.0,
        closure_tails=0.0,
    )
