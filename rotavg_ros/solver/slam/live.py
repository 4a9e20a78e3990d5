"""A robot's graph while it grows: the answer of each tick, and the solves that run alongside.

The state of the graph is that of the last solve. New odometry is appended to it. New closures require a solve that
continues from the last one (an update), and those it does not explain a whole search. Both are suspended when the tick
has spent its work, and resumed in the next one. Until the update has ended, new closures are included by linearisation
about the last solve (:mod:`~rotavg_ros.solver.slam.update.conditioned`).
"""

from __future__ import annotations

import math
from dataclasses import fields, replace
from functools import partial
from typing import cast

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.estimate import Estimate, Run, Stopwatch
from rotavg_ros.solver.running.kept_labels import KeptLabels
from rotavg_ros.solver.running.resumable import Resumable
from rotavg_ros.solver.running.work import metered
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.graph.odometry_paths import Growth
from rotavg_ros.solver.slam.links import with_links, with_more_links
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.options import SlamStages
from rotavg_ros.solver.slam.poses.solve import has_places, poses_of_kept, poses_of_labels, poses_of_update
from rotavg_ros.solver.slam.posterior.state import Noise
from rotavg_ros.solver.slam.solve import whole
from rotavg_ros.solver.slam.update.columns import Columns
from rotavg_ros.solver.slam.update.conditioned import Conditioned, LaidOn, conditioned
from rotavg_ros.solver.slam.update.copies import Copies
from rotavg_ros.solver.slam.update.grown_edges import begins_with
from rotavg_ros.solver.slam.update.linear import Linear
from rotavg_ros.solver.slam.update.memory import SlamMemory, with_copies, with_poses
from rotavg_ros.view_graph import ViewGraph

# Share of a tick's remaining work for an update while a whole search waits for the rest; share of the tick's own work
# for the columns of new closures.
_UPDATES, _COLUMNS = 0.5, 0.8
# Maximum number of closures that are included by linearisation: as many as arrive during two updates of a large map.
# Their covariance is inverted once or twice a tick, 12 ms with translations.
_MOST = 200
_FLAGGED = 0.5
# Closures that join separate parts are initially false if they contradict the start by more than this, rad.
_FAR = math.radians(30)


def update_slam(graph: ViewGraph, memory: SlamMemory, run: Run) -> Estimate | None:
    """The answer of a graph that has grown since ``memory``; None if it cannot be continued from.

    Of several statements of one measurement only the first counts.

    Args:
        graph: N nodes, M edges.
        memory: memory of the last answer.
        run: includes the units of work that may be spent, exceeded at most by one factorisation.
    """
    copies = Copies.of(graph)
    estimate = _update_once(graph if copies is None else copies.once, memory, run)
    return None if estimate is None else with_copies(estimate, copies)


def _update_once(graph: ViewGraph, memory: SlamMemory, run: Run) -> Estimate | None:
    """The answer of a graph without repeated edges."""
    with run.watch.stage("update"):
        known = _caught_up(graph, memory, run)
        if known is None and not run.anew:
            known = _thinned_out(graph, memory, run)
    if known is None:
        return None
    known = _searched_ahead(graph, known, run)
    if known.ahead is not None and (run.work is None or run.anew):
        with run.watch.stage("search"):  # in silence there is nothing else to do
            known.ahead.go_on(math.inf if run.work is None else run.work)
    if known.ahead is not None and known.ahead.has_ended:
        found, was_anew = known.ahead.result, known.anew
        assert isinstance(found.memory, SlamMemory)
        if was_anew and _is_same(found.memory.graph, graph):
            return found
        with run.watch.stage("update"):
            known = _caught_up(graph, _going_on_from(found.memory, graph, known, run), run)
        if known is None:
            return None
        known = _searched_ahead(graph, known, run)
    with run.watch.stage("update"):
        return _laid_on(known.seen(graph), known, math.inf if run.work is None else run.work)


def resume_slam(graph: ViewGraph, labels: KeptLabels, run: Run) -> Estimate | None:
    """The answer of a graph, from only the labels of an earlier solve; None if they do not fit the graph.

    There is no earlier answer to fall back on, so this solve is not suspended. If closures have joined separate parts,
    ``run.warm_start`` says how, and a whole search, alongside the next answers, decides which of them are good.
    """
    copies = Copies.of(graph)
    if copies is None:
        return _resume_once(graph, labels, run)
    estimate = _resume_once(copies.once, copies.labels_once(labels), run)
    return None if estimate is None else with_copies(estimate, copies)


def _resume_once(graph: ViewGraph, labels: KeptLabels, run: Run) -> Estimate | None:
    """The same for a graph without repeated edges."""
    if run.warm_start is None or labels.by_places is not has_places(graph):
        return None
    is_known = len(labels.noise) == len(fields(Noise)) and Noise(*labels.noise.tolist()).is_possible
    if not is_known or not begins_with(graph, labels.graph, len(labels.trusted)):
        return None
    with run.watch.stage("update"):
        graph, links = with_links(graph)
        start = run.warm_start.double()
        joints = _joints(graph, labels.are_known(graph.num_edges))
        found = SlamMemory.of_labels(labels, graph, _networks(run), start, _far_from(graph, joints, start))
        estimate, memory = found.estimate, found.estimate.memory
        assert isinstance(memory, SlamMemory)
        memory = replace(memory, links=links)
        estimate = replace(estimate, memory=memory.with_all_unexplained() if len(joints) else memory)
        if labels.by_places:
            estimate = with_poses(graph, estimate, poses_of_kept(memory.calibrated(graph), found.mode, labels))
    return replace(estimate, warnings=memory.notes, is_anew=False)


def _joints(graph: ViewGraph, is_known: np.ndarray) -> np.ndarray:
    """``(n,)`` closures that join parts which known edges, ``(M,)`` bool, and odometry leave separate."""
    apart = graph.select_edges(torch.from_numpy(is_known) | graph.is_odometry).components()
    return torch.nonzero(apart[graph.source] != apart[graph.target])[:, 0].numpy()


def _far_from(graph: ViewGraph, edges: np.ndarray, start: torch.Tensor) -> np.ndarray:
    """Those of some edges ``(n,)`` that contradict orientations ``(N, 4)`` by more than ``_FAR``."""
    chosen = graph.select_edges(torch.from_numpy(edges))
    off = edge_residual(start, chosen.target_from_source, chosen.source, chosen.target)
    return np.asarray(edges[(rotations.angle(off) > _FAR).numpy()])


def advance(memory: SlamMemory, work: float) -> None:
    """Continues the suspended solves of ``memory`` for ``work`` units; the next tick uses the result."""
    update, ahead = memory.update, memory.ahead
    with metered() as meter:
        if update is not None and not update.has_failed:
            update.go_on(work if ahead is None else _UPDATES * work)
        if ahead is not None and not ahead.has_failed:
            ahead.go_on(work - meter.spent)


def _searched_ahead(graph: ViewGraph, known: SlamMemory, run: Run) -> SlamMemory:
    """The memory, with a whole search under way if one is due."""
    ahead = known.ahead
    if ahead is not None and ahead.has_failed:
        known = replace(known, ahead=None, anew=False)
    if (known.ahead is not None and known.anew >= run.anew) or not (run.anew or known.is_due):
        return known
    own = _by_itself(run)
    own = replace(own, warm_start=None) if run.anew else own
    return replace(known, ahead=Resumable(partial(whole, graph, SlamStages(), own)), anew=run.anew)


def _going_on_from(found: SlamMemory, graph: ViewGraph, known: SlamMemory, run: Run) -> SlamMemory:
    """The memory after a whole search; closures that came meanwhile count as before until an update includes them."""
    found, graph = replace(found, update_work=known.update_work), found.seen(graph)
    if _num_new_closures(graph, found) == 0:
        return found
    searched = replace(known, searched=found.searched, is_divided=found.is_divided, unexplained=0)
    update = Resumable(partial(_updated, graph, found, _by_itself(run)))
    return replace(searched, ahead=None, anew=False, update=update)


def _is_same(graph: ViewGraph, other: ViewGraph) -> bool:
    return (graph.num_nodes, graph.num_edges) == (other.num_nodes, other.num_edges)


def _by_itself(run: Run) -> Run:
    """Arguments for a solve that outlives this one."""
    return replace(run, watch=Stopwatch(), memory=None, work=None, anew=False)


def _caught_up(graph: ViewGraph, memory: SlamMemory, run: Run) -> SlamMemory | None:
    """The memory after an update with the new closures, as far as the work allows; None if none can be made.

    An update that is not expected to end within the work is not begun before the answer; it runs afterwards.
    """
    known, ration = memory, math.inf if run.work is None else run.work
    stated = graph
    with metered() as meter:
        while True:
            graph = known.seen(stated)
            if not known.is_grown_to(graph):
                return None
            update = known.update
            has_none = update is None or update.has_failed
            growth = _growth(graph, known, known.graph)
            hangs_on = growth is not None
            if has_none and growth is not None and not _is_more(graph, known, growth):
                return replace(known, update=None)
            if update is None or has_none:
                before = replace(known, ahead=None, update=None, columns=None)
                update = Resumable(partial(_updated, graph, before, _by_itself(run)))
            # Nodes that are not attached by odometry cannot be placed until the update has ended.
            left = ration - meter.spent if hangs_on else math.inf
            if not update.has_ended and (known.update_work > left or not update.go_on(left)):
                return replace(known, update=update)
            if (after := update.result) is None:
                return None
            if after.columns is None:
                after, graph = replace(after, update_work=update.spent), after.seen(stated)
                if _num_new_closures(graph, after) > _most_columns(_linear(after), left):
                    update = Resumable(partial(_with_columns, graph, after))
                    return replace(known, update=update, update_work=after.update_work)
            known = replace(after, ahead=known.ahead, anew=known.anew)


def _thinned_out(graph: ViewGraph, memory: SlamMemory, run: Run) -> SlamMemory | None:
    """The memory for a graph that has lost keyframes, solved with the remaining labels; None if that is impossible.

    There is no answer to fall back on, so this solve is not suspended.
    """
    links = memory.links
    if len(links):
        graph, links = with_links(graph)
    before = memory.thinned_to(graph)
    if before is None or run.warm_start is None or (memory.poses is None) is has_places(graph):
        return None
    found = before.updated(graph, _networks(run), run.warm_start.double())
    estimate = found.estimate
    if memory.poses is not None:
        estimate = with_poses(graph, estimate, poses_of_labels(before.calibrated(graph), found.mode))
    assert isinstance(estimate.memory, SlamMemory)
    return replace(estimate.memory, links=links)


def _networks(run: Run) -> tuple[SlamCleanNet, SlamFineNet]:
    return run.networks.load(SlamCleanNet), run.networks.load(SlamFineNet)


def _growth(graph: ViewGraph, known: SlamMemory, since: ViewGraph | Linear) -> Growth | None:
    """How nodes newer than ``since`` are attached to older ones; None if some are not, or odometry joins chains."""
    new = np.arange(since.num_edges, graph.num_edges)
    new = new[graph.is_odometry[new].numpy()]
    growth = Growth.of(known.calibrated(graph), new, since.num_nodes)
    if growth is None or len(growth.edge) == len(new):
        return growth
    beside = torch.ones(graph.num_edges, dtype=torch.bool)
    beside[: since.num_edges] = beside[growth.edge] = False
    apart = graph.select_edges(~beside).components()
    ends = apart[graph.source[new]], apart[graph.target[new]]
    return growth if torch.equal(*ends) else None


def _is_more(graph: ViewGraph, known: SlamMemory, growth: Growth) -> bool:
    """Whether new edges do more than to attach the nodes of this growth."""
    return graph.num_edges - known.graph.num_edges > len(growth.edge)


def _updated(graph: ViewGraph, memory: SlamMemory, run: Run) -> SlamMemory | None:
    """The memory after a solve from the previous labelling, with new closures judged; None if it cannot be made."""
    assert run.warm_start is not None
    graph, links = with_more_links(graph, memory.links, memory.graph.num_edges)
    before = memory.poses
    calibrated = memory.calibrated(graph)
    if (before is None) is has_places(graph):
        return None
    alone = None if before is None else before.start_alone(calibrated)
    found = memory.updated(graph, _networks(run), run.warm_start.double() if alone is None else alone)
    estimate = found.estimate
    if before is not None:
        estimate = with_poses(graph, estimate, poses_of_update(calibrated, found.mode, before))
    assert isinstance(estimate.memory, SlamMemory)
    return replace(estimate.memory, links=links).since(memory, estimate.outlier_score)


def _laid_on(graph: ViewGraph, known: SlamMemory, ration: float) -> Estimate | None:
    """The known answer with new odometry appended and new closures included by linearisation; None if impossible."""
    edges = np.arange(graph.num_edges)
    waits = (edges >= known.graph.num_edges) & ~graph.is_odometry.numpy()
    kept, closure = np.flatnonzero(~waits), np.flatnonzero(waits)
    growth = _growth(graph, known, known.graph)
    if growth is None:
        return None
    if len(closure) == 0:
        alone = known.along_odometry(graph, growth)
        # Odometry beside the chain waits for the update, as closures do.
        return replace(alone, memory=known) if alone is not None and _is_more(graph, known, growth) else alone
    older = known.graph.num_edges
    along = graph.first_edges(older, torch.from_numpy(kept[older:]))
    estimate = known.along_odometry(along, growth.among(kept))
    linear = _linear(known)
    if linear.num_nodes != known.graph.num_nodes:
        growth = _growth(graph, known, linear)
    if estimate is None or growth is None:
        return None
    places = estimate.places
    variance = np.stack((estimate.variance.numpy(), np.zeros(graph.num_nodes)))
    if places is not None:
        variance[1] = places.variance.numpy()
    laid = LaidOn(
        known.calibrated(graph),
        estimate.body_from_world,
        None if places is None else places.position.numpy(),
        variance,
    )
    columns = known.columns or Columns.none()
    most = min(_most_columns(linear, ration), _MOST - len(columns.edge))
    told = conditioned(linear, laid, growth, closure, columns, most)
    memory = replace(known, columns=told.columns)
    return replace(_with_closures(estimate, told, (kept, closure)), memory=memory)


def _linear(known: SlamMemory) -> Linear:
    """The linearisation about the last solve."""
    return Linear.of_rotations(known.mode) if known.poses is None else Linear.of_poses(known.poses.pose)


def _most_columns(linear: Linear, ration: float) -> int:
    """Maximum number of new closures whose columns a tick may compute."""
    return int(min(max(1.0, _COLUMNS * ration / (linear.column_work * linear.size)), _MOST))


def _num_new_closures(graph: ViewGraph, known: SlamMemory) -> int:
    return int((~graph.is_odometry[known.graph.num_edges :]).sum())


def _with_columns(graph: ViewGraph, known: SlamMemory) -> SlamMemory | None:
    """The memory with the columns of all new closures, so that none loses its influence when an update replaces it."""
    estimate = _laid_on(graph, known, math.inf)
    return None if estimate is None else cast(SlamMemory, estimate.memory)


def _with_closures(estimate: Estimate, told: Conditioned, edges: tuple[np.ndarray, np.ndarray]) -> Estimate:
    """The estimate with further closures.

    Args:
        estimate: estimate on m edges.
        told: result for the n further closures.
        edges: ``(m,)`` and ``(n,)`` numbers of both in the whole graph.
    """
    kept, closure = (torch.from_numpy(each) for each in edges)
    laid = told.laid

    def merged(before: torch.Tensor, value: np.ndarray) -> torch.Tensor:
        both = before.new_empty(len(before) + len(value), *before.shape[1:])
        both[kept], both[closure] = before, torch.from_numpy(value)
        return both

    places = estimate.places
    if places is not None and laid.position is not None:
        places = replace(
            places,
            position=torch.from_numpy(laid.position),
            variance=torch.from_numpy(laid.variance[1]),
            rotation_score=merged(places.rotation_score, told.rotation_score),
            precision=merged(places.precision, np.where((told.score > _FLAGGED)[:, None], 0.0, told.precision)),
        )
    score = merged(estimate.outlier_score, told.score)
    variance = torch.from_numpy(laid.variance[0])
    estimate = replace(estimate, body_from_world=laid.body_from_world, variance=variance)
    return replace(estimate, outlier_score=score, places=places)
