"""A robot on the streets of a right-angled town, most of whose false closures say "you are back where you were"."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotavg_ros import ViewGraph
from test.solver.slam.posterior.planar import yaw

BLOCK = 5  # keyframes from one crossing to the next
STEP_DEG, CLOSURE_DEG, FALSE_DEG = 1.3, 1.4, 10.0


class Town(NamedTuple):
    """A graph by rotations alone, headings of its keyframes, and which of its edges are false.

    Attributes:
        graph: N keyframes, M edges.
        heading: ``(N,)`` rad.
        is_false: ``(M,)`` bool.
        off_deg: ``(M,)`` the error of each edge.
    """

    graph: ViewGraph
    heading: np.ndarray
    is_false: np.ndarray
    off_deg: np.ndarray


def town(seed: int, keyframes: int, tail: int, closures: int, false: int, blocks: int = 4) -> Town:
    """Draws a run whose last ``tail`` keyframes only odometry, and false closures, join to the rest.

    False closures join any two keyframes and state a turn of 10° (1 σ), as Sünderhauf & Protzel (IROS 2012) draw them.
    In a right-angled town a good part of their rotations is right by chance.
    """
    rng = np.random.default_rng(seed)
    quarter, place = _run(rng, keyframes, blocks)
    good = _seen_again(place[: keyframes - tail])
    good = good[rng.permutation(len(good))[:closures]]
    wrong = np.sort(rng.integers(0, keyframes, (4 * false, 2)), axis=1)
    wrong = wrong[wrong[:, 1] - wrong[:, 0] > 1][:false]
    source, target = np.concatenate((np.stack((np.arange(keyframes - 1), np.arange(1, keyframes))).T, good, wrong)).T
    kind = np.repeat([0, 1, 1], [keyframes - 1, len(good), len(wrong)])
    is_false = np.repeat([False, False, True], [keyframes - 1, len(good), len(wrong)])
    heading = np.pi / 2 * quarter
    turn = heading[target] - heading[source]
    measured = turn + np.radians(np.where(kind == 0, STEP_DEG, CLOSURE_DEG)) * rng.normal(size=len(source))
    measured = np.where(is_false, np.radians(FALSE_DEG) * rng.normal(size=len(source)), measured)
    off_deg = np.degrees(np.abs((measured - turn + np.pi) % (2 * np.pi) - np.pi))
    graph = ViewGraph.create(source, target, source_from_target=yaw(measured), num_nodes=keyframes, kind=kind)
    return Town(graph, heading, is_false, off_deg)


def _run(rng: np.random.Generator, keyframes: int, blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """``(N,)`` headings in quarter turns, and ``(N, 2)`` places, of a walk that turns at random at crossings."""
    ahead = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    quarter, place = np.zeros(keyframes, dtype=int), np.zeros((keyframes, 2), dtype=int)
    for i in range(1, keyframes):
        place[i] = place[i - 1] + ahead[quarter[i - 1]]
        quarter[i] = quarter[i - 1]
        if i % BLOCK == 0:
            ways = (quarter[i] + np.array([0, 1, 3])) % 4
            inside = (np.abs(place[i] + BLOCK * ahead[ways]) <= BLOCK * blocks / 2).all(axis=1)
            quarter[i] = rng.choice(ways[inside]) if inside.any() else (quarter[i] + 2) % 4
    return quarter, place


def _seen_again(place: np.ndarray) -> np.ndarray:
    """``(n, 2)`` keyframes at the same place, more than twenty steps apart."""
    older, newer = np.triu_indices(len(place), 21)
    same = (place[older] == place[newer]).all(axis=1)
    return np.stack((older[same], newer[same]), axis=1)
