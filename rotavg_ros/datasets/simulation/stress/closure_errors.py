"""Errors of closures, and stated precisions of edges, that do not occur in the wide family of simulated runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.false_closures import random_runs, random_turns
from rotavg_ros.datasets.simulation.plane_paths import FloatArray
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph, per_axis

_NEAR_MISS_DEG = (10.0, 30.0)
_QUALITY_FACTOR = 4.0
# Standard deviation of the logarithm of stated over true precision.
_SPREAD = 1.5
_LIE = 30.0
# Radius of a place that looks like another one, metres.
_ALIKE_RADIUS_M = 3.0


def near_misses_in_groups(share: float, drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """A share of the closures, in runs of 4–12, is off by a turn of 10–30° that each run has in common."""
    closures = np.flatnonzero(drawn.is_closure)
    run = random_runs(len(closures), round(share * len(closures)), rng)
    turn = random_turns(int(run.max(initial=-1)) + 1, _NEAR_MISS_DEG, drawn.planar, rng)
    return drawn.with_wrong_turns(closures[run >= 0], turn[run[run >= 0]])


def two_qualities(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """Half of the closures err by 0.5°, the other half by four times that; all state the mean square."""
    closures = drawn.is_closure
    good = per_axis(0.5, drawn.planar)
    sigma = good * np.where(rng.random(int(closures.sum())) < 0.5, _QUALITY_FACTOR, 1.0)
    return drawn.gaussian(closures, sigma, rng, good * float(np.sqrt((1 + _QUALITY_FACTOR**2) / 2)))


def heavy_tailed(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """Student's t with three degrees of freedom and a scale of 1°."""
    return drawn.student(drawn.is_closure, 1.0, rng)


def few(good: int, false: int, drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """Only ``good`` good and ``false`` false closures are left."""
    keep = ~drawn.is_closure
    for closures, count in ((drawn.is_closure & ~drawn.is_wrong, good), (drawn.is_wrong, false)):
        keep[rng.permutation(np.flatnonzero(closures))[:count]] = True
    return drawn.selected(keep)


def repeated(share: float, times: int, drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """A share of the edges occurs ``times`` times with the same measurement, which adds no information."""
    count = np.where(rng.random(drawn.graph.num_edges) < share, times, 1)
    widened = replace(drawn, sigma=drawn.sigma * np.sqrt(count))
    return widened.selected(np.repeat(np.arange(drawn.graph.num_edges), count))


def spread_precisions(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """The ratio of stated to true precision is lognormal, with a standard deviation of 1.5 in the logarithm."""
    return _stating_times(drawn, np.exp(_SPREAD * rng.normal(size=drawn.graph.num_edges)))


def precisions_by_factors(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """Stated precisions are right up to a factor of 0.01–100 for odometry and another for closures."""
    odometry, closures = 10 ** rng.uniform(-2, 2, 2)
    return _stating_times(drawn, np.where(drawn.is_closure, closures, odometry))


def odometry_without_precision(drawn: DrawnGraph, _: np.random.Generator) -> DrawnGraph:
    """Closures state theirs, odometry does not."""
    return _stating_times(drawn, np.where(drawn.is_closure, 1.0, np.nan))


def lying_precisions(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """A tenth of the good closures states a precision 30 times too high; false ones 30 times too high or too low."""
    draw = rng.random(drawn.graph.num_edges)
    good = np.where(draw < 0.1, _LIE, 1.0)
    false = np.where(draw < 0.5, _LIE, 1 / _LIE)
    return _stating_times(drawn, np.where(drawn.is_closure, np.where(drawn.is_wrong, false, good), 1.0))


def places_that_look_alike(share: float, drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """A share of the closures joins the passes of one place with those of another, all with one wrong turn.

    The places are the two that were passed most often among 30 random pairs at least three radii apart. Distinct pairs
    of keyframes; there may be too few of them for the whole share.
    """
    passes = _passes_of_two_places(drawn, rng)
    first, second = (found.reshape(-1) for found in np.meshgrid(*passes, indexing="ij"))
    closures = np.flatnonzero(drawn.is_closure)
    count = min(round(share * len(closures)), len(first))
    chosen = np.sort(rng.permutation(closures)[:count])
    pair = rng.permutation(len(first))[:count]
    source, target = drawn.graph.source.clone(), drawn.graph.target.clone()
    forward = rng.random(count) < 0.5
    source.numpy()[chosen] = np.where(forward, first[pair], second[pair])
    target.numpy()[chosen] = np.where(forward, second[pair], first[pair])
    error = drawn.error
    moved = replace(drawn, graph=replace(drawn.graph, source=source, target=target))
    moved = moved.measuring(error * moved.true_target_from_source)
    turn = random_turns(1, (40.0, 180.0), drawn.planar, rng).as_rotvec()
    # The world turns from the first place to the second, whichever is passed earlier.
    earlier = np.where(first[pair] < second[pair], 1.0, -1.0)[:, None]
    translation = drawn.edge_translation.copy()
    translation[chosen] = rng.normal(size=(count, 3)) * [0.3, 0.3, 0.3 * (not drawn.planar)]
    turns = Rotation.from_rotvec(np.broadcast_to(turn, (count, 3)) * earlier)
    moved = replace(moved, edge_translation=translation).with_wrong_turns(chosen, turns)
    later = np.maximum(*moved.ends)
    return moved.selected(np.lexsort((moved.graph.kind.numpy(), later)))


def _passes_of_two_places(drawn: DrawnGraph, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    tree = KDTree(drawn.position)
    places = rng.integers(0, len(drawn.position), (30, 2))
    apart = np.linalg.norm(drawn.position[places[:, 0]] - drawn.position[places[:, 1]], axis=1) > 3 * _ALIKE_RADIUS_M
    passes = [tree.query_ball_point(drawn.position[pair], _ALIKE_RADIUS_M) for pair in places[apart]]
    first, second = max(passes, key=lambda pair: min(len(pair[0]), len(pair[1])))
    return np.array(first), np.array(second)


def _stating_times(drawn: DrawnGraph, factor: FloatArray) -> DrawnGraph:
    return drawn.stating(drawn.graph.precision.numpy() * factor)
