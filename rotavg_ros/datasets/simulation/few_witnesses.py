"""One slip of the odometry that few closures tell of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.false_closures import random_turns
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun

_WITNESSES = (2.0, 30.0)
_SLIP_DEG = (5.0, 170.0)
# Witnesses join so many pairs of places at most, or any.
_PLACES = 3


def slip_with_few_witnesses(run: SimulatedRun, rng: np.random.Generator) -> SimulatedRun:
    """A step is off by 5–170°; of the closures across it 2 to 30 good ones are left, and as large a part of the false.

    The good ones join one to three pairs of places (those nearest to as many of them), or are any. Nothing happens
    where no good closure lies across.

    Args:
        run: its edges are those of M before, of which some closures are left out.
        rng: source of every random choice.
    """
    graph = run.graph
    odometry = np.flatnonzero(graph.is_odometry.numpy())
    ends = np.sort(np.stack((graph.source.numpy(), graph.target.numpy())), axis=0)
    slip = int(rng.choice(odometry))
    across = ~graph.is_odometry.numpy() & (ends[0] <= ends[0, slip]) & (ends[1] > ends[0, slip])
    good, false = (np.flatnonzero(across & (run.closure_is_false == is_false)) for is_false in (False, True))
    if len(good) == 0:
        return run
    count = min(len(good), round(float(np.exp(rng.uniform(*np.log(_WITNESSES))))))
    left_false = rng.permutation(false)[: round(len(false) * count / len(good))]
    left = np.concatenate((np.flatnonzero(~across), _chosen(ends[:, good].T, count, rng, good), left_false))
    left.sort()
    turn = random_turns(1, _SLIP_DEG, run.planar, rng)
    measured = graph.target_from_source.numpy().copy()
    measured[slip] = (turn * Rotation.from_quat(measured[slip])).as_quat(canonical=True)[0]
    slipped = replace(graph, target_from_source=torch.from_numpy(measured)).select_edges(torch.from_numpy(left))
    noise = run.edge_noise.copy()
    noise[slip] = turn.magnitude()[0]
    return replace(
        run,
        graph=slipped,
        edge_translation=run.edge_translation[left],
        edge_noise=noise[left],
        closure_is_false=run.closure_is_false[left],
    )


def _chosen(ends: np.ndarray, count: int, rng: np.random.Generator, closures: np.ndarray) -> np.ndarray:
    """``(count,)`` of ``closures``, whose ends are ``(C, 2)``: nearest to one to three of them, or any."""
    places = int(rng.integers(1, _PLACES + 2))
    if places > _PLACES:
        return rng.permutation(closures)[:count]
    centre = rng.permutation(len(closures))[:places]
    distance = np.abs(ends[:, None, :] - ends[centre]).sum(axis=2)
    # In turn, so that each place gets its share.
    rank = np.argsort(np.argsort(distance, axis=0, kind="stable"), axis=0, kind="stable").min(axis=1)
    return closures[np.argsort(rank, kind="stable")[:count]]
