"""Preparation of a SLAM solve: contracts the odometry, without its bias, and estimates the scale of the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.spanning_forest import SpanningForest
from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.graph.agreement import AgreementPairs, agreement_pairs
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph, contract
from rotavg_ros.solver.slam.graph.odometry_paths import OdometryPaths, odometry_forest
from rotavg_ros.solver.slam.noise.gyro_bias import estimate_bias, without_bias
from rotavg_ros.solver.slam.noise.model import (
    NoiseModel,
    agree,
    discrepancies,
    estimate_noise,
    judge_by_chain,
    noise_between_neighbours,
)
from rotavg_ros.solver.slam.noise.restated_odometry import restated_odometry
from rotavg_ros.view_graph import ViewGraph

# Odometry may be biased if this share of the closures disagrees with it; it counts as biased if removing the bias lets
# that many fewer disagree, with less drift.
_BIASED_SHARE = 0.5
_BIAS_GAIN = 0.2
_BIAS_ROUNDS = 2
# Units of work to contract an edge, and to compare a closure with its neighbours.
_EDGE, _CLOSURE = 0.002, 0.008
# A cheaper look comes first, and must promise at least such parts of that gain: the share of closures that disagree and
# are confirmed by a neighbour, and the share that the first round explains.
_BIAS_CONFIRMED, _BIAS_EXPLAINED = 0.75, 0.4


@dataclass(frozen=True)
class Prepared:
    """A contracted SLAM graph, with the scale of its noise (C closures).

    Attributes:
        closure_graph: the graph of the closures' ends.
        squared_angle: ``(C,)`` rad², discrepancy of each closure with the odometry.
        path_steps: ``(C,)`` odometry steps between its ends; inf where odometry does not connect them.
        pairs: which closures agree.
        noise: estimated scales.
        forest: the forest along which the chains were contracted.
    """

    closure_graph: ClosureGraph
    squared_angle: np.ndarray
    path_steps: np.ndarray
    pairs: AgreementPairs
    noise: NoiseModel
    forest: SpanningForest

    @property
    def num_segments(self) -> int:
        return self.closure_graph.num_segments


def prepare(graph: ViewGraph) -> Prepared:
    """Contract the odometry chains, along rejected edges only where nothing else connects, and estimate the noise.

    If most closures disagree with the odometry, a constant bias may be the cause; it is removed if fewer then disagree.
    """
    prepared = prepare_as_it_is(graph)
    bias = likely_bias(graph, prepared)
    if bias is None:
        return prepared
    unbiased = prepare_as_it_is(without_bias(graph, bias), restated=prepared.closure_graph.is_restated)
    fewer_disagree = unbiased.noise.outlier_share < prepared.noise.outlier_share - _BIAS_GAIN
    is_better = fewer_disagree and unbiased.noise.step_variance < prepared.noise.step_variance
    return unbiased if is_better else prepared


def prepare_as_it_is(graph: ViewGraph, components: int | None = None, restated: np.ndarray | None = None) -> Prepared:
    """The same without removing a bias.

    Args:
        graph: the graph.
        components: components of the noise; default: those of the rotations.
        restated: ``(M,)`` bool, closures that are made of odometry; default: those that the graph shows to be.
    """
    closure_graph, forest = contract_odometry(graph, restated)
    spend(_CLOSURE * int(closure_graph.is_closure.sum()))
    closure = closure_graph.is_closure
    squared_angle = (rotations.log(closure_graph.residual) ** 2).sum(dim=1).numpy()[closure]
    path_steps = closure_graph.path_steps[closure]
    pairs = agreement_pairs(closure_graph)
    noise = estimate_noise(discrepancies(squared_angle, path_steps, pairs), components or graph.rotation_components)
    return Prepared(closure_graph, squared_angle, path_steps, pairs, noise, forest)


def likely_bias(graph: ViewGraph, prepared: Prepared) -> np.ndarray | None:
    """``(3,)`` rad per step, a possible bias of all odometry; None if most closures agree with the odometry."""
    if prepared.noise.outlier_share <= _BIASED_SHARE or not _may_be_biased(prepared):
        return None
    noise = noise_between_neighbours(prepared.pairs, prepared.noise.components)
    bias, closure_graph, forest, corrected = np.zeros(3), prepared.closure_graph, prepared.forest, graph
    for number in range(_BIAS_ROUNDS):
        if number > 0:
            closure_graph, forest = contract_odometry(corrected, prepared.closure_graph.is_restated)
        estimate = estimate_bias(corrected, forest, closure_graph, noise)
        if number == 0 and estimate.explained < _BIAS_EXPLAINED * _BIAS_GAIN:
            return None
        bias = bias + estimate.bias
        corrected = without_bias(graph, bias)
    return bias


def _may_be_biased(prepared: Prepared) -> bool:
    """Whether enough closures disagree with the odometry and are confirmed by a neighbour, as a bias would imply."""
    is_agreed = agree(prepared.pairs, prepared.noise)
    is_confirmed = np.bincount(prepared.pairs.first, is_agreed, len(prepared.squared_angle)) > 0
    disagrees = judge_by_chain(prepared.noise, prepared.squared_angle, prepared.path_steps) < 0
    return bool((disagrees & is_confirmed).mean() > _BIAS_CONFIRMED * _BIAS_GAIN)


def made_of_odometry(graph: ViewGraph) -> np.ndarray:
    """``(M,)`` bool, closures that a graph as it was measured shows to be made of odometry."""
    return restated_odometry(graph, OdometryPaths.along(graph, odometry_forest(graph)))


def contract_odometry(graph: ViewGraph, restated: np.ndarray | None = None) -> tuple[ClosureGraph, SpanningForest]:
    """The closure graph, and the forest along which it was contracted, over rejected edges only if nothing else joins.

    Args:
        graph: the graph.
        restated: ``(M,)`` bool, closures that are made of odometry; default: :func:`made_of_odometry`, which is of a
            graph whose systematic errors have not been removed.
    """
    spend(_EDGE * graph.num_edges)
    forest = odometry_forest(graph)
    paths = OdometryPaths.along(graph, forest)
    return contract(graph, paths, restated_odometry(graph, paths) if restated is None else restated), forest
