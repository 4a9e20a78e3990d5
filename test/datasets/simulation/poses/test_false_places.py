"""False closures are as many as asked for, and wrong in the way that they are called."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rotavg_ros.datasets.simulation.poses import false_places
from rotavg_ros.datasets.simulation.poses.drawn import DrawnPoses

from .runs import run

KINDS = [
    false_places.random_places,
    false_places.parallel_corridors,
    false_places.parallel_corridors_in_runs,
    false_places.symmetric_building,
]


def spoiled(add: false_places.Add, dimensions: int, share: float = 0.3) -> DrawnPoses:
    return false_places.with_share(run(dimensions), share, add, np.random.default_rng(3))


def wrong(drawn: DrawnPoses) -> tuple[np.ndarray, np.ndarray]:
    """Degrees and metres by which false closures err."""
    turn, shift = drawn.errors()
    return np.degrees(np.linalg.norm(turn, axis=1))[drawn.is_wrong], np.linalg.norm(shift, axis=1)[drawn.is_wrong]


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("add", KINDS)
def test_share_and_what_was_there_before(add: false_places.Add, dimensions: int) -> None:
    clean, drawn = run(dimensions), spoiled(add, dimensions)
    assert drawn.is_wrong.sum() / drawn.is_closure.sum() == pytest.approx(0.3, abs=0.005)
    assert not drawn.is_wrong[~drawn.is_closure].any()
    good = drawn.graph.select_edges(torch.from_numpy(~drawn.is_wrong))
    for name in ("source", "target", "target_from_source", "translation", "precision"):
        np.testing.assert_allclose(getattr(good, name), getattr(clean.graph, name), rtol=0, atol=1e-12)
    again = spoiled(add, dimensions)
    np.testing.assert_array_equal(drawn.graph.translation, again.graph.translation)
    assert false_places.with_share(clean, 0.0, add, np.random.default_rng(0)) is clean
    if dimensions == 2:
        assert drawn.graph.translation is not None
        assert not drawn.graph.translation[:, 2].any()
        assert not drawn.graph.target_from_source[:, :2].any()


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("add", KINDS[1:3])
def test_corridors_are_parallel(add: false_places.Add, dimensions: int) -> None:
    degrees, metres = wrong(spoiled(add, dimensions))
    assert degrees.max() <= 5.0
    assert metres.min() >= 5.0
    assert metres.max() <= 50.0


@pytest.mark.parametrize("dimensions", [2, 3])
def test_runs_agree_on_one_wrong_place(dimensions: int) -> None:
    """In the world frame neighbours of a run err by one vector, as far as the noise of good closures lets them."""
    drawn = spoiled(KINDS[2], dimensions)
    graph = drawn.graph
    assert graph.translation is not None
    edges = np.flatnonzero(drawn.is_wrong)
    source, target = graph.source.numpy()[edges], graph.target.numpy()[edges]
    _, shift = drawn.errors()
    moved = drawn.poses.world_from_body[source].apply(shift[edges]) * np.where(source < target, 1, -1)[:, None]
    # Each has another one that errs likewise; by themselves places that err by 5–50 m do not.
    apart = np.linalg.norm(moved[:, None] - moved[None], axis=2)
    both = np.minimum(apart, np.linalg.norm(moved[:, None] + moved[None], axis=2))
    np.fill_diagonal(both, np.inf)
    assert np.median(both.min(axis=1)) < 0.15


def test_random_places_are_wrong_in_both() -> None:
    degrees, metres = wrong(spoiled(KINDS[0], 2))
    assert np.median(degrees) > 45
    assert np.median(metres) > 5


@pytest.mark.parametrize("dimensions", [2, 3])
def test_buildings_are_symmetric(dimensions: int) -> None:
    degrees, metres = wrong(spoiled(KINDS[3], dimensions))
    off = np.minimum(np.abs(degrees - 90), np.abs(degrees - 180))
    assert off.max() < 6
    at_place = metres < 0.5
    assert at_place.mean() == pytest.approx(0.5, abs=0.02)
    assert (metres[~at_place] > 2.0).all()
