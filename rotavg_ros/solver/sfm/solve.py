"""The SfM profile: clean → bootstrap → fine-tune, as in the paper (NeuRoRA, §4), then refine."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.canonical_form import CanonicalForm
from rotavg_ros.solver.algebra.residuals import EdgeResiduals
from rotavg_ros.solver.estimate import Estimate, Run, Stopwatch
from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.fine_net import FineNet
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.neurora.paper import PaperCleanNet, PaperFineNet, paper_fine_tune
from rotavg_ros.solver.neurora.scores import residual_and_uncertainty, residual_probability
from rotavg_ros.solver.neurora.stages import apply_labels, clean, fine_tune, labelled, trust_all
from rotavg_ros.solver.neurora.tiled.tuning import tune
from rotavg_ros.solver.neurora.tree import Bootstrapped, bootstrap, breadth_first
from rotavg_ros.solver.sfm.certainty.attachment import PRIORS as ATTACHMENT
from rotavg_ros.solver.sfm.certainty.attachment import Attachment, ErrorDensity
from rotavg_ros.solver.sfm.certainty.uncertainty import References, noise_variance, variances
from rotavg_ros.solver.sfm.consensus.search import CONSENSUS, consensus
from rotavg_ros.solver.sfm.cycles.evidence import with_triangles
from rotavg_ros.solver.sfm.options import SfmStages
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.solver.sfm.refinement import PRIORS, ROUND, EdgeWeights, refine, settle
from rotavg_ros.solver.sfm.rejected import in_one_frame
from rotavg_ros.solver.sfm.series import EdgesInSeries
from rotavg_ros.solver.sfm.starts.choice import Start, begin, settle_best
from rotavg_ros.solver.sfm.starts.others import other_starts
from rotavg_ros.solver.sfm.starts.parts import Parts
from rotavg_ros.solver.sfm.stated.noise import StatedNoise
from rotavg_ros.solver.sfm.step.structure import Structure, accepted_edges
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# For graphs with more edges it pays to measure which tile sizes are fastest on this machine.
_TUNING_PAYS = 200_000
# Log-odds that of edges in series an accepted one is to blame; finite, since all of them may be accepted.
_BLAMELESS = -100.0
# Quaternions that differ by less are the same.
_ROUNDING = 1e-9
_NEARLY_AS_GOOD = (
    "two answers fit about equally well; {} of {} orientations differ between them by more than 20°, because few edges "
    "or contradictory ones join part of the views to the rest: check whether that part fits, or match more pairs"
)


def solve_sfm(graph: ViewGraph, component: Tensor, stages: SfmStages, run: Run) -> Estimate:
    """One method on a graph, on the graph's device; edges that the user has rejected take no part.

    Args:
        component: ``(N,)`` component of every node.
    """
    kept = (graph.label != EdgeLabel.REJECTED).nonzero()[:, 0]
    if len(kept) == graph.num_edges:
        return _solved(graph, component, stages, run)
    allowed = graph.select_edges(kept)
    part = allowed.components()
    if allowed.num_edges:
        estimate = _solved(allowed, part, stages, run)
    else:
        every = rotations.identity(graph.num_nodes, device=graph.device)
        estimate = Estimate(every, every.new_empty(0), torch.full((graph.num_nodes,), torch.nan))
    score = torch.ones(graph.num_edges, dtype=torch.float64, device=graph.device)
    score[kept] = estimate.outlier_score.to(score)
    estimate = replace(estimate, outlier_score=score)
    if torch.equal(part, component):
        return estimate
    return in_one_frame(graph, component, part, estimate, _num_steps(stages, run) > 0)


def _num_steps(stages: SfmStages, run: Run) -> int:
    """Maximum number of refinement steps."""
    if run.refinement_steps is not None:
        return run.refinement_steps
    return PRIORS.max_steps if stages.refine else 0


def _solved(graph: ViewGraph, component: Tensor, stages: SfmStages, run: Run) -> Estimate:
    """One method on a graph without rejected edges."""
    networks, watch = run.networks, run.watch
    if graph.num_edges > _TUNING_PAYS and graph.device.type == "cpu":
        tune()
    with watch.stage("order"):
        form = CanonicalForm.of(graph, component, own_axes="axes" not in stages.as_written)
    graph, component = form.graph, form.component
    with watch.stage("clean"):
        kind = PaperCleanNet if "cleannet" in stages.as_written else CleanNet
        cleaned = clean(networks.load(kind), graph) if stages.clean else trust_all(graph)
        judged = cleaned = apply_labels(cleaned, graph.label)
    is_believed = torch.zeros(int(component.max()) + 1, dtype=torch.bool, device=graph.device)
    if stages.cycles and "cycles" not in stages.as_written:
        with watch.stage("cycles"):
            cleaned, is_believed = with_triangles(judged, component, stages.clean)
    with watch.stage("bootstrap"):
        begun = (breadth_first if "tree" in stages.as_written else bootstrap)(cleaned, component)
        cleaned, orientations = begun.cleaned, begun.body_from_world
        cleared = _Cleared(judged, is_believed, cleaned, begun.parent_edge, _structure(begun, component))
        if run.warm_start is not None:
            start = form.canonical_orientations(run.warm_start.double().to(graph.device))
            orientations = rotations.canonical(
                rotations.multiply(start, rotations.inverse(start[begun.roots])[component])
            )
    for _ in range(stages.fine_tunings):
        with watch.stage("fine-tune"):
            if "finenet" in stages.as_written:
                orientations = paper_fine_tune(networks.load(PaperFineNet), cleaned, orientations)
            else:
                orientations = fine_tune(networks.load(FineNet), cleaned, orientations, component)
    answer = _Answer(orientations)
    steps = _num_steps(stages, run)
    if steps > 0:
        answer = _refined(cleared, orientations, stages, steps, watch)
    score, variance = cleaned.outlier_probability.double(), torch.full((graph.num_nodes,), torch.nan)
    by_residuals = stages.fine_tunings > 0 and not ("cleannet" in stages.as_written and stages.clean)
    if steps > 0 or by_residuals:
        # A tree alone leaves no residuals to judge by. Now a residual is the edge's noise, up to the orientations'
        # error. With the paper's CleanNet, its own scores stand unless the orientations are refined.
        score, noise, attached = answer.scored or _scored(cleared, answer)
        if steps > 0:
            with watch.stage("uncertainty"):
                to = References(component, form.first_nodes())
                if attached is not None:
                    score = torch.from_numpy(attached.scores(score.cpu().numpy())).to(score)
                    score = labelled(score, graph.label)
                stated = variances(graph, noise, score, cleared.structure.series.bridge, to)
                if stated is not None and attached is not None:
                    turned = attached.variances(to.node[component].cpu().numpy())
                    stated = stated + torch.from_numpy(turned).to(stated)
            if stated is not None:
                variance = form.of_nodes(stated.clamp(max=rotations.RANDOM_VARIANCE))
    score = score.index_select(0, form.edge)
    return Estimate(form.orientations(answer.body_from_world), score, variance, warnings=answer.warnings)


class _Cleared(NamedTuple):
    """What is known of a graph's edges before orientations are refined.

    Attributes:
        judged: edges with CleanNet's scores and the labels.
        is_believed: ``(C,)`` bool, components in which triangles confirm these scores.
        cleaned: edges with the triangles' evidence included, as used by the tree.
        parent_edge: ``(N,)`` the tree.
        structure: the graph's connections.
    """

    judged: Cleaned
    is_believed: Tensor
    cleaned: Cleaned
    parent_edge: Tensor
    structure: Structure


class _Scored(NamedTuple):
    """What follows from an answer.

    Attributes:
        score: ``(M,)`` probability that an edge is false, from its residual.
        noise: ``(C,)`` rad², variance of good edges' errors, per axis.
        attached: how surely parts that few edges join are attached; None: not known.
    """

    score: Tensor
    noise: Tensor
    attached: Attachment | None


class _Answer(NamedTuple):
    """An answer.

    Attributes:
        body_from_world: ``(N, 4)``.
        residual: ``(M,)`` rad, if known.
        warnings: one sentence each.
        parts: parts of the graph that few edges join, if it was searched for any.
        scored: what follows from it, if known.
    """

    body_from_world: Tensor
    residual: Tensor | None = None
    warnings: tuple[str, ...] = ()
    parts: Parts | None = None
    scored: _Scored | None = None


def _refined(cleared: _Cleared, orientations: Tensor, stages: SfmStages, steps: int, watch: Stopwatch) -> _Answer:
    """Refines from the networks' orientations ``(N, 4)`` or a better start; then looks for another answer."""
    graph, structure = cleared.judged.measured, cleared.structure
    component = structure.component
    with watch.stage("refine"):
        good = (1 - cleared.cleaned.outlier_probability).double()
        alike = torch.ones_like(good)
        weights = EdgeWeights(alike, good if stages.weighted else alike)
        priors = replace(PRIORS if stages.shaped else ROUND, max_steps=steps)
        if not stages.density:
            priors = replace(priors, density=replace(priors.density, max_steps=0))
        refinement = partial(refine, graph, structure=structure, priors=priors)
        starts = [Start(orientations, weights.coarse)]
        if stages.clean and stages.weighted:
            starts += other_starts(cleared.judged, cleared.is_believed, cleared.parent_edge, component)
        begun = begin(graph, starts, weights.shaped, structure, priors)
        best = settle_best(graph, begun, weights, structure, priors)
        orientations, weights = best.body_from_world, best.weights
        if stages.stated:
            noise = StatedNoise.of(graph, structure, priors, stages.stated_shapes)
            orientations, weights = noise.refined(orientations, weights, refinement)
        doubtful = 0 if best.is_doubtful is None else int(best.is_doubtful.sum())
        warnings = (_NEARLY_AS_GOOD.format(doubtful, len(component)),) if doubtful else ()
    answer = _Answer(orientations, None, warnings, begun.parts)
    if stages.consensus:
        with watch.stage("consensus"):
            residual = EdgeResiduals(graph, orientations.float()).angles()
            answer = answer._replace(residual=residual)
            other = consensus(graph, orientations, component, CONSENSUS, residual)
            if other is not None:
                answer = answer._replace(warnings=warnings + other.warnings)
                if other.body_from_world is not None and other.weight is not None:
                    weights = weights.times(other.weight, other.weight)
                    orientations = refinement(other.body_from_world, weights=weights)
                    answer = _Answer(orientations, None, other.warnings, begun.parts)
    if answer.parts is None:
        return answer
    with watch.stage("attach"):
        return _reattached(cleared, answer, weights, priors)


def _reattached(cleared: _Cleared, answer: _Answer, weights: EdgeWeights, priors: RefinementPriors) -> _Answer:
    """The answer after parts are turned that few edges join, and that are likelier elsewhere."""
    graph, structure = cleared.judged.measured, cleared.structure
    for _ in range(ATTACHMENT.rounds):
        scored, orientations = _scored(cleared, answer), answer.body_from_world
        turned = None if scored.attached is None else scored.attached.likelier()
        if turned is None:
            return answer._replace(scored=scored)
        start = torch.from_numpy(np.ascontiguousarray(turned.T)).to(orientations)
        # Components are answered as if each were alone: those in which nothing is turned keep their answer.
        is_turned = torch.zeros_like(structure.roots, dtype=torch.bool)
        is_turned[structure.component[(start - orientations).abs().amax(dim=1) > _ROUNDING]] = True
        refined = settle(graph, start, weights, structure, priors).body_from_world
        orientations = torch.where(is_turned[structure.component][:, None], refined, orientations)
        answer = answer._replace(body_from_world=orientations, residual=None)
    return answer


def _scored(cleared: _Cleared, answer: _Answer) -> _Scored:
    graph, structure = cleared.judged.measured, cleared.structure
    series, component = structure.series, structure.component
    angle, spread = residual_and_uncertainty(graph, answer.body_from_world, component, answer.residual)
    score = residual_probability(angle, spread, NUMBERS.outlier_angle)
    score[series.edge] = series.score(angle[series.edge], spread[series.edge], NUMBERS.outlier_angle)
    of_edge = component[graph.source]
    # Orientations follow a bridge, so its residual says nothing about it; labels say nothing about other edges.
    is_told = graph.label == EdgeLabel.AUTOMATIC
    is_told[series.bridge] = False
    share = _false_share(score[is_told], of_edge[is_told], len(structure.roots))
    score[series.bridge] = share[of_edge[series.bridge]]
    score = labelled(score, graph.label)
    noise = noise_variance(graph, angle, score, component)
    if answer.parts is None:
        return _Scored(score, noise, None)
    density = ErrorDensity.of(*(one.cpu().numpy() for one in (angle.double(), score, of_edge, share, noise.sqrt())))
    return _Scored(score, noise, Attachment.of(answer.parts, _rows(answer.body_from_world), density))


def _false_share(score: Tensor, of_edge: Tensor, num_components: int) -> Tensor:
    """Share ``(C,)`` of false edges: the mean score of some edges ``(K,)`` of each component, and of a good one."""
    wrong, count = (
        score.new_zeros(num_components).index_add_(0, of_edge, value) for value in (score, torch.ones_like(score))
    )
    return wrong / (count + 1)


def _rows(body_from_world: Tensor) -> np.ndarray:
    """Orientations ``(N, 4)`` → ``(4, N)``, in memory as well."""
    return np.ascontiguousarray(body_from_world.cpu().double().numpy().T)


def _structure(begun: Bootstrapped, component: Tensor) -> Structure:
    """The graph's connections; among edges in series, CleanNet's scores say which is to blame, as far as reliable."""
    graph = begun.cleaned.measured
    series = EdgesInSeries.of(graph, begun.parent, begun.parent_edge)
    structure = Structure(component, begun.roots, begun.cleaned.edges, series, accepted_edges(graph))
    redundancy = structure.redundancy(graph)
    # In a component with a single cycle, CleanNet has no evidence to tell its edges apart.
    others = (redundancy - 1).clamp(min=0)
    trust = (others / (others + PRIORS.half_trusted))[component[graph.source[series.edge]]]
    log_odds = begun.cleaned.outlier_probability[series.edge].double().logit()
    log_odds = trust * log_odds.clamp(-NUMBERS.max_logit, NUMBERS.max_logit)
    log_odds = torch.where(graph.label[series.edge] == EdgeLabel.ACCEPTED, _BLAMELESS, log_odds)
    return replace(structure, series=series.blamed(log_odds))
