"""The stages of a SLAM solve, as the pipeline runs them and as training sees them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver import slam_refinement
from rotavg_ros.solver.agreement import NO_PAIRS, AgreementPairs, agreement_pairs
from rotavg_ros.solver.closure_graph import ClosureGraph, contract
from rotavg_ros.solver.group_search import without_false_groups
from rotavg_ros.solver.gyro_bias import estimate_bias, without_bias
from rotavg_ros.solver.noise_model import (
    NoiseModel,
    discrepancies,
    estimate_noise,
    judge_by_chain,
    noise_between_neighbours,
)
from rotavg_ros.solver.slam_clean_net import SlamCleanNet, closure_features
from rotavg_ros.solver.slam_inference import false_log_odds
from rotavg_ros.solver.slam_passes import SlamEstimate
from rotavg_ros.solver.slip_doubt import Doubt, agree, measure_doubt
from rotavg_ros.solver.slip_search import search_for_slips
from rotavg_ros.solver.spanning_tree import (
    SpanningForest,
    compose_orientations,
    minimum_spanning_forest,
    shortest_path_forest,
)
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Odometry first: no number of steps is worth a closure.
_CLOSURE_COST = 1e6
# What a closure's verdict counts for in the tree: nobody is trusted beyond this, and a false one is off by about this.
_MIN_DISTRUST = 0.02
_FALSE_SQUARE = np.pi**2 / 3 + 2
# Odometry that this share of the closures disagrees with may be biased; it is if without the bias so many fewer do,
# and with less drift.
_BIASED_SHARE = 0.5
_BIAS_GAIN = 0.2
_BIAS_ROUNDS = 2
# It is not looked for, or not any further, where a cheaper look promises less than such parts of that gain: at most the
# closures that disagree and are confirmed by a neighbour, and what the first round explains.
_BIAS_CONFIRMED, _BIAS_EXPLAINED = 0.75, 0.4
# How much of the network's log-odds the refinement adds to its own: a part, since both have seen some of the same
# evidence, and the less the more closures are false, since agreement by chance is then as common as by truth.
_NETWORK_SHARE = 0.6
_MAX_NETWORK_LOG_ODDS = 4.0
# Rotations whose axes spread less than this (relative) are all about one axis.
_PLANAR_SPREAD = 1e-10


@dataclass(frozen=True)
class Prepared:
    """A SLAM graph drawn together, with the scale of its noise (C closures).

    Attributes:
        closure_graph: the graph of the closures' ends.
        squared_angle: ``(C,)`` rad², discrepancy of each closure with the odometry.
        path_steps: ``(C,)`` odometry steps between its ends; inf where odometry does not connect them.
        pairs: which closures agree.
        noise: estimated scales.
        is_unbiased: whether a gyroscope bias was taken out of the odometry beforehand.
    """

    closure_graph: ClosureGraph
    squared_angle: np.ndarray
    path_steps: np.ndarray
    pairs: AgreementPairs
    noise: NoiseModel
    is_unbiased: bool = False

    @property
    def num_segments(self) -> int:
        return self.closure_graph.num_segments


def prepare(graph: ViewGraph, *, scale_estimation: bool = True) -> Prepared:
    """Contract the odometry chains and estimate the noise of steps and closures. Rejected edges take no part.

    If most closures disagree with the odometry, a constant bias may be why; it is taken out if fewer do without it.

    Args:
        scale_estimation: if not, the noise is what edges of either kind state in the median.
    """
    prepared, forest = _contract(graph, scale_estimation)
    if scale_estimation and prepared.noise.outlier_share > _BIASED_SHARE and _may_be_biased(prepared):
        unbiased = _without_bias(graph, prepared, forest)
        if unbiased is not None and unbiased.noise.step_variance < prepared.noise.step_variance:
            return replace(unbiased, is_unbiased=True)
    return prepared


def _may_be_biased(prepared: Prepared) -> bool:
    """Whether enough closures disagree with the odometry that neighbours confirm: others no bias will explain."""
    is_agreed = agree(prepared.pairs, prepared.noise)
    is_confirmed = np.bincount(prepared.pairs.first, is_agreed, len(prepared.squared_angle)) > 0
    disagrees = judge_by_chain(prepared.noise, prepared.squared_angle, prepared.path_steps) < 0
    return bool((disagrees & is_confirmed).mean() > _BIAS_CONFIRMED * _BIAS_GAIN)


def _without_bias(graph: ViewGraph, prepared: Prepared, forest: SpanningForest) -> Prepared | None:
    """The graph prepared with the likeliest bias taken out of its odometry; None if that explains too few closures."""
    noise = noise_between_neighbours(prepared.pairs, prepared.noise.components)
    corrected, closure_graph = graph, prepared.closure_graph
    for number in range(_BIAS_ROUNDS):
        if number > 0:
            closure_graph, forest = draw_together(corrected)
        estimate = estimate_bias(corrected, forest, closure_graph, noise)
        if number == 0 and estimate.explained < _BIAS_EXPLAINED * _BIAS_GAIN:
            return None
        corrected = without_bias(corrected, estimate.bias)
    unbiased, _ = _contract(corrected, scale_estimation=True)
    fewer_disagree = unbiased.noise.outlier_share < prepared.noise.outlier_share - _BIAS_GAIN
    return unbiased if fewer_disagree else None


def _contract(graph: ViewGraph, scale_estimation: bool) -> tuple[Prepared, SpanningForest]:
    """As :func:`prepare`, believing the odometry, and the forest along which the chains were drawn together."""
    closure_graph, forest = draw_together(graph)
    closure = closure_graph.is_closure
    squared_angle = (rotations.log(closure_graph.residual) ** 2).sum(dim=1).numpy()[closure]
    path_steps = closure_graph.path_steps[closure]
    pairs = agreement_pairs(closure_graph)
    components = rotation_components(graph)
    if scale_estimation:
        noise = estimate_noise(discrepancies(squared_angle, path_steps, pairs), components)
    else:
        noise = _stated_noise(graph, components)
    return Prepared(closure_graph, squared_angle, path_steps, pairs, noise), forest


def draw_together(graph: ViewGraph) -> tuple[ClosureGraph, SpanningForest]:
    """The closure graph, and the forest along which the chains were drawn together; rejected edges take no part."""
    usable = graph.label != EdgeLabel.REJECTED
    cost = torch.where(graph.is_odometry, 1.0, _CLOSURE_COST)
    # A rejected edge may only be used where nothing else connects.
    forest = minimum_spanning_forest(graph, torch.where(usable, cost, _CLOSURE_COST**2))
    return contract(graph, forest), forest


@dataclass(frozen=True)
class CleanedClosures:
    """Verdicts on the E edges of a closure graph before the global solve.

    Attributes:
        inlier_probability: ``(E,)``; 1 for odometry.
        prior_log_odds: ``(E,)`` log-odds of being good that the refinement adds to its own evidence; ±inf by label.
    """

    inlier_probability: np.ndarray
    prior_log_odds: np.ndarray


def clean(network: SlamCleanNet | None, prepared: Prepared, label: Tensor) -> CleanedClosures:
    """Judge every closure by its discrepancy with the odometry and, with a network, by the company it keeps.

    A closure starts as good only if both say so: a group of false closures agrees with itself, and odometry that has
    drifted far believes anything. What the network says counts in the refinement's verdicts, too.

    Args:
        label: ``(M,)`` of the view-graph's edges.
    """
    graph, noise = prepared.closure_graph, prepared.noise
    prior = np.zeros(len(graph.source))
    good = np.full(len(graph.source), np.inf)
    good[graph.is_closure], prior[graph.is_closure] = judge_closures(
        network, noise, prepared.squared_angle, prepared.path_steps, prepared.pairs
    )
    edge_label = label.numpy()[graph.view_graph_edge]
    verdict = np.select([edge_label == EdgeLabel.ACCEPTED, edge_label == EdgeLabel.REJECTED], [np.inf, -np.inf], 0.0)
    good[graph.num_segments :] = np.where(verdict == 0, good[graph.num_segments :], verdict)
    prior[graph.num_segments :] = np.where(verdict == 0, prior[graph.num_segments :], verdict)
    return CleanedClosures(expit(good), prior)


def judge_closures(
    network: SlamCleanNet | None,
    noise: NoiseModel,
    squared_angle: np.ndarray,
    path_steps: np.ndarray,
    pairs: AgreementPairs,
) -> tuple[np.ndarray, np.ndarray]:
    """Log-odds ``(C,)`` of closures to be good before the global solve, and those that the refinement is to add."""
    by_chain = judge_by_chain(noise, squared_angle, path_steps) + noise.prior_log_odds
    if network is None or len(by_chain) == 0:
        return by_chain, np.zeros(len(by_chain))
    by_company = -false_log_odds(network, closure_features(noise, squared_angle, path_steps, pairs)).double().numpy()
    bounded = np.clip(by_company, -_MAX_NETWORK_LOG_ODDS, _MAX_NETWORK_LOG_ODDS)
    return np.minimum(by_chain, by_company), _NETWORK_SHARE * (1 - noise.outlier_share) * bounded


def bootstrap(prepared: Prepared, cleaned: CleanedClosures) -> Tensor:
    """Corrections ``(K, 4)`` along the tree of least expected squared error.

    A step of odometry costs its variance; a closure costs its own and, as far as it is not trusted, what a false
    one would do. So the tree follows the odometry until that has drifted farther than a trusted closure errs.
    """
    graph, noise = prepared.closure_graph, prepared.noise
    distrust = np.maximum(1 - cleaned.inlier_probability, _MIN_DISTRUST)
    cost = np.where(
        graph.is_odometry, graph.steps * noise.step_variance, noise.closure_variance + distrust * _FALSE_SQUARE
    )
    closure_graph = ViewGraph.create(graph.source, graph.target, graph.residual, num_nodes=graph.num_nodes)
    forest = shortest_path_forest(closure_graph, torch.from_numpy(cost), root="first")
    return compose_orientations(forest, closure_graph)


def refine(
    prepared: Prepared,
    cleaned: CleanedClosures,
    correction: Tensor,
    max_passes: int = slam_refinement.MAX_PASSES,
    *,
    scale_estimation: bool = True,
    slip_search: bool = True,
) -> SlamEstimate:
    """Refine from corrections ``(K, 4)``; again where groups of closures are false that were believed.

    If the outcome looks as if odometry had slipped, from a second start, too.
    """
    graph, pairs, prior = prepared.closure_graph, prepared.pairs, cleaned.prior_log_odds

    def run(
        start: Tensor,
        inlier_probability: np.ndarray,
        noise: NoiseModel,
        log_odds: np.ndarray,
        rank: np.ndarray | None = None,
    ) -> SlamEstimate:
        return slam_refinement.refine(
            graph,
            pairs,
            start,
            inlier_probability,
            noise,
            log_odds=log_odds,
            max_passes=max_passes,
            hold_noise=not scale_estimation,
            rank=rank,
        )

    estimate = run(correction, cleaned.inlier_probability, prepared.noise, prior)
    doubt = measure_doubt(graph, pairs, estimate, prepared.noise) if slip_search else Doubt.NONE
    without = without_false_groups(run, estimate, graph, pairs, prepared.noise, prior, doubt)
    rivals = [estimate.correction] if without is estimate else [estimate.correction, without.correction]
    second = search_for_slips(graph, pairs, estimate, prepared.noise, prior, doubt, rivals)
    if second is None:
        return without
    return run(second.correction, second.inlier_probability, second.noise, prior, estimate.rank)


def outlier_scores(graph: ClosureGraph, outlier_probability: np.ndarray) -> np.ndarray:
    """Probability of each edge of the view-graph to be wrong, ``(M,)``, from those of the closure graph's, ``(E,)``.

    A slip in a segment is as likely in any of its steps.
    """
    return np.asarray(graph.edge_values(outlier_probability) * graph.share_of_segment)


def _stated_noise(graph: ViewGraph, components: int) -> NoiseModel:
    """Medians of what the edges of either kind state; the prior where they state nothing."""
    prior = estimate_noise(discrepancies(np.empty(0), np.empty(0), NO_PAIRS), components)
    stated = {True: prior.step_variance, False: prior.closure_variance}
    precision = graph.precision.numpy()
    for kind in stated:
        of_kind = precision[(graph.is_odometry.numpy() == kind) & np.isfinite(precision)]
        if len(of_kind):
            stated[kind] = float(1 / np.median(of_kind))
    return replace(prior, step_variance=stated[True], closure_variance=stated[False])


def rotation_components(graph: ViewGraph) -> int:
    """1 if all measured rotations share one axis (planar motion), else 3."""
    vectors = rotations.log(graph.target_from_source)
    spread = torch.linalg.eigvalsh(vectors.T @ vectors)
    return 1 if float(spread[1]) <= _PLANAR_SPREAD * float(spread[2]) else 3
