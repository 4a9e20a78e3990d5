"""What FineNet says depends on nothing but what could be known: not on frame, gauge, scale, order or direction."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.slam.fine_net.evidence import Evidence
from rotavg_ros.solver.slam.fine_net.features import NUM_FEATURES, fine_features, joined
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.posterior.solve import search
from rotavg_ros.solver.slam.stages import bootstrap

_PER_EDGE = (
    *("source", "target", "is_odometry", "is_good", "own", "residual_square", "weight", "rest", "square"),
    *("predicted", "log_density", "log_relative", "position", "steps", "turn", "length", "stated"),
)


@cache
def evidence() -> Evidence:
    """Of a solved run on hills with uneven odometry and false closures."""
    drawn = next(kind for kind in KINDS if kind.name == "hills: uneven odometry").drawn(2)
    mode = search(drawn.graph, Networks("cpu").load(SlamCleanNet), bootstrap).modes[0]
    return Evidence.of(mode.problem, mode.state)


@cache
def network() -> SlamFineNet:
    """Drawn, its last layer too."""
    torch.manual_seed(4)
    drawn = SlamFineNet()
    for head in (drawn.segment_head, drawn.closure_head):
        torch.nn.init.normal_(head.weight, std=0.3)
    return drawn.eval()


@torch.no_grad()
def said(given_evidence: Evidence) -> np.ndarray:
    return np.asarray(network()(fine_features(given_evidence)).numpy())


def test_there_are_as_many_features_as_the_network_takes() -> None:
    features = fine_features(evidence())
    assert features.edges.shape == (len(evidence().own), NUM_FEATURES)
    assert torch.isfinite(features.edges).all()


@settings(max_examples=10, deadline=None)
@given(st.floats(-6, 6))
def test_the_scale_of_noise_does_not_matter(log_scale: float) -> None:
    scale, before = float(np.exp(log_scale)), evidence()
    noise = before.noise
    scaled = replace(
        before,
        own=scale * before.own,
        residual_square=scale * before.residual_square,
        weight=before.weight / scale,
        square=scale * before.square,
        predicted=scale * before.predicted,
        noise=replace(
            noise, step_variance=scale * noise.step_variance, closure_variance=scale * noise.closure_variance
        ),
    )
    np.testing.assert_allclose(said(scaled), said(before), atol=1e-4)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_order_and_direction_of_edges_and_names_of_nodes_do_not_matter(seed: int) -> None:
    rng, before = np.random.default_rng(seed), evidence()
    count, closures = len(before.own), int((~before.is_odometry).sum())
    order, name = rng.permutation(count), rng.permutation(int(max(before.source.max(), before.target.max())) + 1)
    turned = rng.random(count) < 0.5
    ends = np.where(turned, before.target, before.source), np.where(turned, before.source, before.target)
    relabelled = replace(before, source=name[ends[0]], target=name[ends[1]])
    permuted = replace(relabelled, **{field: getattr(relabelled, field)[order] for field in _PER_EDGE})
    rank = np.cumsum(~before.is_odometry) - 1
    closure_order = rank[order[~before.is_odometry[order]]]
    assert sorted(closure_order) == list(range(closures))
    permuted = replace(permuted, run=before.run[closure_order])
    np.testing.assert_allclose(said(permuted), said(before)[order], atol=1e-4)


def test_runs_the_other_way_say_the_same() -> None:
    before = evidence()
    backwards = replace(before, position=np.sort(-before.position, axis=1))
    np.testing.assert_allclose(said(backwards), said(before), atol=1e-4)


def test_the_mean_is_zero_over_good_edges_of_a_kind_and_nothing_is_said_of_others() -> None:
    value, before = said(evidence()), evidence()
    assert (~before.is_good).any()
    assert not value[~before.is_good].any()
    for kind in (before.is_odometry, ~before.is_odometry):
        assert abs(value[kind & before.is_good].mean()) < 1e-5
        assert value[kind & before.is_good].std() > 0.01


def test_joined_graphs_do_not_hear_of_each_other() -> None:
    one, other = evidence(), replace(evidence(), square=3 * evidence().square)
    with torch.no_grad():
        both = network()(joined([fine_features(one), fine_features(other)])).numpy()
    np.testing.assert_allclose(both, np.concatenate((said(one), said(other))), atol=1e-5)


def test_what_is_not_known_of_translations_is_as_if_all_steps_were_as_long() -> None:
    assert (evidence().length == 1).all()
