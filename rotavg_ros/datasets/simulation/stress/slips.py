"""Odometry that slips: small slips in streets, slips where closures can locate them, and one with few witnesses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.false_closures import insert_slips, random_turns
from rotavg_ros.datasets.simulation.slip_places import LOCATABLE
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph, IntArray, per_axis
from rotavg_ros.view_graph import EdgeKind, ViewGraph

_SMALL_DEG = (3.0, 13.0)
_LONE_DEG = (15.0, 170.0)
_LOCATABLE_SHARE = 0.01
# Most steps between the slip and the nearest ends of the closures that bracket it.
BRACKET = 3
# Steps over which the ends of closures count as one place.
PLACE = 20
_NUM_PLACES = 3
_WITNESS_DEG = 1.0
_SEEN_AGAIN_M = 1.0


class NoWitnesses(Exception):  # noqa: N818 - not an error: the next step is tried
    """No closures of the requested kind span a step."""


def small_slips(share: float, drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """A share of the steps is off by 3–13°."""
    steps = np.flatnonzero(~drawn.is_closure)
    chosen = np.sort(rng.permutation(steps)[: round(share * len(steps))])
    return _slipped(drawn, chosen, random_turns(len(chosen), _SMALL_DEG, drawn.planar, rng))


def locatable_slips(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """One step in a hundred is off by 20–60°, where good closures can tell which."""
    spoiled = insert_slips(drawn.to_graph_file(), drawn.body_from_world, _LOCATABLE_SHARE, rng, rule=LOCATABLE)
    return replace(drawn, graph=spoiled.graph_file.graph, is_wrong=drawn.is_wrong | spoiled.spoiled)


def lone_slip(witnesses: int, from_one_pair: bool, drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """One step is off by 15–170°; only ``witnesses`` closures across it are left, all good.

    Args:
        witnesses: number of closures across.
        from_one_pair: whether they join one pair of places; otherwise at least three pairs, whose ends lie within three
            steps of the slip on either side.
        drawn: without false closures.
    """
    num_nodes = drawn.graph.num_nodes
    again = KDTree(drawn.position).query_pairs(_SEEN_AGAIN_M, output_type="ndarray")
    again = again[again[:, 1] - again[:, 0] > 2 * PLACE]
    choose = _one_pair if from_one_pair else _several_pairs
    for step in rng.permutation(np.arange(num_nodes // 3, 2 * num_nodes // 3)):
        across = again[(again[:, 0] <= step) & (again[:, 1] > step)]
        try:
            older, newer = choose(across, int(step), witnesses, rng).T
        except NoWitnesses:
            continue
        first, last = drawn.ends
        drawn = drawn.selected(~drawn.is_closure | (last <= step) | (first > step))
        sigma = per_axis(_WITNESS_DEG, drawn.planar)
        before = drawn.graph.num_edges
        drawn = _with_closures(drawn, older, newer, sigma)
        assert drawn.graph.num_edges == before + witnesses
        is_witness = drawn.is_closure & (drawn.ends[0] <= step) & (drawn.ends[1] > step)
        drawn = drawn.gaussian(is_witness, np.full(witnesses, sigma), rng, sigma)
        slip = np.flatnonzero(~drawn.is_closure & (drawn.ends[0] == step))
        return _slipped(drawn, slip, random_turns(1, _LONE_DEG, drawn.planar, rng))
    raise NoWitnesses("no step of the run has such closures across it")


def _one_pair(across: np.ndarray, step: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """``(count, 2)`` of the pairs, with ends in two stretches of a place's length."""
    for seed in rng.permutation(len(across))[:50]:
        offset = across - across[seed]
        near = across[((offset >= 0) & (offset < PLACE)).all(axis=1)]
        if len(near) >= count:
            return np.asarray(near[rng.permutation(len(near))[:count]])
    raise NoWitnesses


def _several_pairs(across: np.ndarray, step: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """``(count, 2)`` of the pairs, at three pairs of places: ending at the step, beginning there, away from it."""
    before, after = step - across[:, 0], across[:, 1] - step - 1
    beside = (before < BRACKET) & (after >= PLACE), (after < BRACKET) & (before >= PLACE)
    away = (before >= 2 * PLACE) & (after >= 2 * PLACE)
    share = -(-count // _NUM_PLACES)
    chosen = []
    for group, size in zip((*beside, away), (share, share, count - 2 * share), strict=True):
        found = across[group]
        if len(found) == 0:
            raise NoWitnesses
        # Pairs of one place: those near a random one.
        centre = found[rng.integers(len(found))]
        near = found[(np.abs(found - centre) < PLACE / 2).all(axis=1)]
        if len(near) < size:
            raise NoWitnesses
        chosen.append(near[rng.permutation(len(near))[:size]])
    return np.concatenate(chosen)


def _with_closures(drawn: DrawnGraph, older: IntArray, newer: IntArray, sigma: float) -> DrawnGraph:
    """Add exact closures from older to newer keyframes, in the order in which a robot would report them.

    Args:
        older, newer: ``(K,)`` keyframes, ``older`` < ``newer``.
        sigma: rad per component, the standard deviation that they state.
    """
    body_from_world = Rotation.from_quat(drawn.body_from_world)
    true = (body_from_world[newer] * body_from_world[older].inv()).as_quat()
    step = body_from_world[older].apply(drawn.position[newer] - drawn.position[older])
    graph, count = drawn.graph, len(older)
    source = np.concatenate((graph.source.numpy(), older))
    target = np.concatenate((graph.target.numpy(), newer))
    kind = np.concatenate((graph.kind.numpy(), np.full(count, EdgeKind.LOOP_CLOSURE)))
    more = replace(
        drawn,
        graph=ViewGraph.create(
            source,
            target,
            np.concatenate((graph.target_from_source.numpy(), true)),
            num_nodes=graph.num_nodes,
            kind=kind,
            precision=np.concatenate((graph.precision.numpy(), np.full(count, sigma**-2))),
        ),
        edge_translation=np.concatenate((drawn.edge_translation, step)),
        is_wrong=np.concatenate((drawn.is_wrong, np.zeros(count, dtype=bool))),
        sigma=np.concatenate((drawn.sigma, np.zeros(count))),
    )
    return more.selected(np.lexsort((kind, np.maximum(source, target))))


def _slipped(drawn: DrawnGraph, edges: np.ndarray, turns: Rotation) -> DrawnGraph:
    measured = drawn.measured.as_quat()
    measured[edges] = (turns * drawn.measured[edges]).as_quat()
    is_wrong = drawn.is_wrong.copy()
    is_wrong[edges] = True
    return replace(drawn.measuring(Rotation.from_quat(measured)), is_wrong=is_wrong)
