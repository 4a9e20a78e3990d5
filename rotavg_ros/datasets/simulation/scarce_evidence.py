"""Runs with little evidence: a slip that few closures span, and robots joined only by closures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.false_closures import random_turns
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun

_WITNESSES = (2.0, 30.0)
_SLIP_DEG = (5.0, 170.0)
# Most pairs of places that witnesses join, unless they join any.
_PLACES = 3
_ROBOTS = (2, 6)


def slip_with_few_witnesses(run: SimulatedRun, rng: np.random.Generator) -> SimulatedRun:
    """A step is off by 5–170°; at most 2 to 30 good closures across it are left, and the same share of the false ones.

    The good ones join one to three pairs of places (those nearest to as many of them), or are any. Nothing happens if
    no good closure spans the step. Dead reckoning stays as it was.

    Args:
        run: the run, some of whose closures are left out.
        rng: source of every random choice.
    """
    graph = run.graph
    is_odometry, ends = graph.is_odometry.numpy(), _ends(run)
    slip = int(rng.choice(np.flatnonzero(is_odometry)))
    across = ~is_odometry & (ends[0] <= ends[0, slip]) & (ends[1] > ends[0, slip])
    good, false = (np.flatnonzero(across & (run.closure_is_false == is_false)) for is_false in (False, True))
    if len(good) == 0:
        return run
    count = min(len(good), round(float(np.exp(rng.uniform(*np.log(_WITNESSES))))))
    left_false = rng.permutation(false)[: round(len(false) * count / len(good))]
    left = np.concatenate((np.flatnonzero(~across), _chosen(ends[:, good].T, count, rng, good), left_false))
    turn = random_turns(1, _SLIP_DEG, run.planar, rng)
    measured, noise = graph.target_from_source.numpy().copy(), run.edge_noise.copy()
    turned = turn * Rotation.from_quat(measured[slip])
    source, target = (
        Rotation.from_quat(run.world_from_body[int(nodes[slip])]) for nodes in (graph.source, graph.target)
    )
    measured[slip] = turned.as_quat(canonical=True)[0]
    noise[slip] = (turned * (target.inv() * source).inv()).magnitude()[0]
    slipped = replace(graph, target_from_source=torch.from_numpy(measured))
    return _selected(replace(run, graph=slipped, edge_noise=noise), np.sort(left))


def several_robots(run: SimulatedRun, rng: np.random.Generator) -> SimulatedRun:
    """One long drive as if by two to six robots: odometry is left out where the next one takes over."""
    count, ends = int(rng.integers(_ROBOTS[0], _ROBOTS[1] + 1)), _ends(run)
    first = np.sort(rng.choice(np.arange(1, run.graph.num_nodes), count - 1, replace=False))
    robot = np.searchsorted(first, ends, side="right")
    return _selected(run, np.flatnonzero(~run.graph.is_odometry.numpy() | (robot[0] == robot[1])))


def _ends(run: SimulatedRun) -> np.ndarray:
    """``(2, M)`` the earlier and the later end of every edge."""
    return np.sort(np.stack((run.graph.source.numpy(), run.graph.target.numpy())), axis=0)


def _chosen(ends: np.ndarray, count: int, rng: np.random.Generator, closures: np.ndarray) -> np.ndarray:
    """``(count,)`` of ``closures`` with ends ``(C, 2)``: those nearest to one to three of them, or any."""
    places = int(rng.integers(1, _PLACES + 2))
    if places > _PLACES:
        return rng.permutation(closures)[:count]
    centre = rng.permutation(len(closures))[:places]
    distance = np.abs(ends[:, None, :] - ends[centre]).sum(axis=2)
    # In turn, so that each place gets its share.
    rank = np.argsort(np.argsort(distance, axis=0, kind="stable"), axis=0, kind="stable").min(axis=1)
    return closures[np.argsort(rank, kind="stable")[:count]]


def _selected(run: SimulatedRun, edges: np.ndarray) -> SimulatedRun:
    """The run with only some of the edges."""
    return replace(
        run,
        graph=run.graph.select_edges(torch.from_numpy(edges)),
        edge_translation=run.edge_translation[edges],
        edge_noise=run.edge_noise[edges],
        closure_is_false=run.closure_is_false[edges],
    )
