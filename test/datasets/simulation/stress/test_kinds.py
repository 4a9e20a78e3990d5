"""What the stress kinds draw is what their names say, and what is said of it is true."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.datasets.simulation.stress.kinds import KINDS, REPORTING_SEEDS, TUNING_SEEDS
from rotavg_ros.datasets.simulation.stress.slips import BRACKET, PLACE

BY_NAME = {kind.name: kind for kind in KINDS}
# Too large to be drawn several times.
SMALL = [kind for kind in KINDS if "15 000" not in kind.name]
LONE = [kind for kind in KINDS if kind.world == "lone slip"]


def closures(drawn: DrawnGraph) -> tuple[int, int]:
    """Number of good and of false ones."""
    false = drawn.is_closure & drawn.is_false
    return int((drawn.is_closure & ~false).sum()), int(false.sum())


def test_names_and_seeds() -> None:
    assert len(BY_NAME) == len(KINDS)
    assert 90 <= len(KINDS) <= 110
    assert not set(TUNING_SEEDS) & set(REPORTING_SEEDS)


@pytest.mark.parametrize("kind", SMALL, ids=lambda kind: kind.name)
def test_drawn(kind: object) -> None:
    drawn, again, other = kind.drawn(3), kind.drawn(3), kind.drawn(4)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(drawn.graph.target_from_source, again.graph.target_from_source)
    np.testing.assert_array_equal(drawn.graph.precision, again.graph.precision)
    assert not np.array_equal(drawn.body_from_world, other.body_from_world)

    noise_deg = np.degrees(drawn.error.magnitude())
    np.testing.assert_array_equal(drawn.is_false[drawn.is_closure], noise_deg[drawn.is_closure] > 10)
    np.testing.assert_array_equal(drawn.is_false[~drawn.is_closure], drawn.is_slip[~drawn.is_closure])
    # What was made wrong is at least 10° off but for the noise on top.
    assert noise_deg[drawn.is_closure & drawn.is_wrong].min(initial=10) > 10 - 5 * np.degrees(drawn.sigma.max())
    assert not (drawn.is_intact & (drawn.is_false | drawn.is_wrong)).any()
    # Good edges err as their true variance says: the mean square of what is normalised is that of one component.
    good = drawn.is_intact & (drawn.sigma > 0)
    normalized = drawn.error.as_rotvec()[good] / drawn.sigma[good, None]
    components = 1 if drawn.planar else 3
    if "heavy" not in kind.name and "Student" not in kind.name:  # type: ignore[attr-defined]
        assert 0.35 < (normalized**2).sum() / components / good.sum() < 1.3

    assert drawn.graph.num_nodes <= 3000
    assert drawn.position.shape == (drawn.graph.num_nodes, 3)
    assert drawn.edge_translation.shape == (drawn.graph.num_edges, 3)
    assert np.isfinite(drawn.position).all() and np.isfinite(drawn.edge_translation).all()
    assert np.isfinite(drawn.true_precision).all()
    if drawn.planar:
        assert np.abs(drawn.error.as_rotvec()[:, :2]).max() < 1e-6
    assert len(set(drawn.graph.components().tolist())) == 1


@pytest.mark.parametrize("kind", LONE, ids=lambda kind: kind.name)
@pytest.mark.parametrize("seed", [0, 1, 1000])
def test_witnesses_of_a_lone_slip(kind: object, seed: int) -> None:
    drawn = kind.drawn(seed)  # type: ignore[attr-defined]
    (slip,) = np.flatnonzero(drawn.is_slip)
    first, last = drawn.ends
    step = first[slip]
    assert last[slip] == step + 1
    assert 14 < np.degrees(drawn.error[slip].magnitude()) < 171
    assert closures(drawn)[1] == 0
    across = drawn.is_closure & (first <= step) & (last > step)
    ends = np.stack((first[across], last[across]), axis=1)
    words = kind.condition.split()  # type: ignore[attr-defined]
    assert len(np.unique(ends, axis=0)) == int(words[0])
    if words[2] == "one":
        assert (np.ptp(ends, axis=0) < PLACE).all()
        return
    assert (step - ends[:, 0] < BRACKET).any()
    assert (ends[:, 1] - step - 1 < BRACKET).any()
    # Three of them lie apart from each other at one end or the other.
    chosen = [ends[0]]
    for pair in ends:
        if all(np.abs(pair - other).max() >= PLACE for other in chosen):
            chosen.append(pair)
    assert len(chosen) >= 3


def test_a_near_miss_that_fits_is_not_intact() -> None:
    """Turned by little more than 10°, and back by its noise: not called false, and nothing for an oracle."""
    drawn = [BY_NAME["building: 30 % near misses"].drawn(seed) for seed in range(3)]
    assert [int(graph.is_wrong.sum()) for graph in drawn] == [60, 60, 60]
    assert any((graph.is_wrong & ~graph.is_false).any() for graph in drawn)


def test_shares_and_numbers() -> None:
    assert closures(BY_NAME["building: 80 % random"].drawn(0)) == (40, 160)
    assert closures(BY_NAME["sphere: 15 closures"].drawn(0)) == (12, 3)
    for agreeing in ("exactly", "with noise"):
        assert closures(BY_NAME[f"drive: 26 closures, 16 agree {agreeing}"].drawn(0)) == (10, 16)
    assert BY_NAME["building: 15 000 poses of uneven drift"].drawn(0).graph.num_nodes == 15_000
    slipped = BY_NAME["city: small slips, 30 % random, exact closures"].drawn(0)
    assert slipped.is_slip.sum() == 8


def test_false_closures_that_agree_exactly() -> None:
    """In a group all believe in the same turn of the world from the earlier to the later end."""
    drawn = BY_NAME["drive: 26 closures, 16 agree exactly"].drawn(0)
    turns = world_turns(drawn)
    assert len(np.unique(turns.round(6), axis=0)) <= 4


def test_places_that_look_alike_turn_one_way() -> None:
    turns = world_turns(BY_NAME["building: 30 % of two places that look alike"].drawn(0))
    angles = np.degrees(np.abs(turns[:, 2]))
    assert np.ptp(np.minimum(angles, 360 - angles)) < 10


def test_robots_are_joined_by_closures_alone() -> None:
    drawn = BY_NAME["8 robots: half random"].drawn(0)
    chains = drawn.graph.components(drawn.graph.is_odometry)
    assert chains.max() == 7


def test_copies_are_the_same_measurement() -> None:
    drawn = BY_NAME["hills: a fifth of the edges five times"].drawn(0)
    rows = np.concatenate((np.stack(drawn.ends, axis=1), drawn.graph.target_from_source.numpy()), axis=1)
    counts = np.unique(rows, axis=0, return_counts=True)[1]
    assert set(counts) == {1, 5}


def test_what_is_stated() -> None:
    lying = BY_NAME["building: precisions that lie"].drawn(0)
    ratio = lying.graph.precision.numpy() * lying.sigma**2
    assert set(np.round(ratio[lying.is_wrong], 3)) == {30, round(1 / 30, 3)}
    assert 0.03 < (ratio[~lying.is_wrong & lying.is_closure] > 29).mean() < 0.2
    silent = BY_NAME["grid: odometry without precision"].drawn(0)
    np.testing.assert_array_equal(np.isnan(silent.graph.precision.numpy()), ~silent.is_closure)


def world_turns(drawn: DrawnGraph) -> np.ndarray:
    """``(K, 3)`` what false closures believe of the world, from the earlier to the later end."""
    false = np.flatnonzero(drawn.is_closure & drawn.is_false)
    source, target = drawn.graph.source.numpy()[false], drawn.graph.target.numpy()[false]
    error = drawn.error[false].as_rotvec()
    # From the target's frame to the world's.
    in_world = Rotation.from_quat(drawn.body_from_world[target]).inv().apply(error)
    return in_world * np.where(source < target, 1, -1)[:, None]
