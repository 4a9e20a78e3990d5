"""SfM training: its losses are those of docs/method-sfm.md, and networks see in it what they see in a solve."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.synthetic import SyntheticGraph
from rotavg_ros.solver.algebra.canonical_form import CanonicalForm
from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.fine_net import FineNet
from rotavg_ros.solver.neurora.message_passing import DirectedEdges
from rotavg_ros.solver.neurora.network_store import load_network
from rotavg_ros.solver.neurora.stages import clean, fine_tune
from rotavg_ros.training.fine_data import FineBatch, StartedGraph
from rotavg_ros.training.losses import clean_net_loss, fine_net_loss
from rotavg_ros.training.sfm_data import in_canonical_form, join, sample_graph

RECIPES = ("released", "released-round", "paper", "wide")


def drawn(recipe: str = "paper", seed: int = 0, cameras: tuple[int, int] = (30, 40)) -> SyntheticGraph:
    return sample_graph(recipe, cameras, np.random.default_rng(seed))


def mean_over_nodes(values: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
    """mean_v mean_u of the values of edges, over the nodes that have any."""
    ends, both = np.concatenate((source, target)), np.concatenate((values, values))
    return float(np.mean([both[ends == node].mean() for node in np.unique(ends)]))


def test_the_loss_of_clean_net() -> None:
    batch = join([drawn(seed=1)])
    generator = torch.Generator().manual_seed(0)
    found = rotations.random(len(batch.source), generator=generator).float()
    logit = torch.randn(len(batch.source), generator=generator)
    terms = clean_net_loss(found, logit, batch.true_relative, batch.is_outlier, batch.edges)
    apart = np.minimum(
        *(np.linalg.norm((found + sign * batch.true_relative).double().numpy(), axis=1) for sign in (1, -1))
    )
    rotation = mean_over_nodes(apart, batch.source.numpy(), batch.target.numpy())
    probability = torch.sigmoid(logit).double().numpy()
    entropy = -np.log(np.where(batch.is_outlier.numpy(), probability, 1 - probability)).mean()
    assert float(terms["rotation"]) == pytest.approx(rotation, rel=1e-4)
    assert float(terms["loss"]) == pytest.approx(rotation + 10 * entropy, rel=1e-4)


def test_the_loss_of_fine_net_is_in_units_of_each_graphs_noise_and_learns_no_gauge() -> None:
    """The errors of each of two graphs are small turns about their own gauge."""
    rng = np.random.default_rng(2)
    graphs = [drawn(seed=3), drawn(seed=4)]
    batch = join(graphs)
    sizes = [graph.graph.num_nodes for graph in graphs]
    group = np.repeat([0, 1], sizes)
    unit = np.array([0.02, 0.05])[group]
    errors = rng.normal(0, 0.03, (len(group), 3))
    truth = Rotation.random(len(group), random_state=5)

    def loss(gauge: Rotation) -> dict[str, float]:
        estimate = truth * Rotation.from_rotvec(errors) * gauge[group]
        terms = fine_net_loss(
            torch.from_numpy(estimate.as_quat()).float(),
            torch.from_numpy(truth.as_quat()).float(),
            torch.from_numpy(unit)[:, None].float(),
            torch.from_numpy(group),
            batch.edges,
        )
        return {name: float(value) for name, value in terms.items()}

    found = loss(Rotation.identity(2))
    source, target = batch.source.numpy(), batch.target.numpy()
    apart = np.linalg.norm(errors[target] - errors[source], axis=1) / (2 * unit[target])
    assert found["edge"] == pytest.approx(mean_over_nodes(apart, source, target), rel=1e-3)
    assert found["node"] == pytest.approx((np.linalg.norm(errors, axis=1) / (2 * unit)).mean(), rel=0.1)
    assert found["loss"] == pytest.approx(found["edge"] + found["node"], rel=1e-6)
    turned = loss(Rotation.from_rotvec([[0.1, 0, 0], [0, -0.1, 0.05]]))
    assert turned["node"] == pytest.approx(found["node"], rel=0.02)


@pytest.mark.parametrize("recipe", RECIPES)
def test_graphs_in_canonical_form_keep_their_truth(recipe: str) -> None:
    for seed in range(3):
        sample = drawn(recipe, seed)
        shown = in_canonical_form(sample)
        truth, graph = shown.body_from_world, shown.graph
        true_relative = rotations.multiply(truth[graph.target], rotations.inverse(truth[graph.source]))
        noise = rotations.angle_between(true_relative, graph.target_from_source)
        torch.testing.assert_close(noise, shown.noise_angle, atol=1e-6, rtol=0)
        assert int(shown.is_outlier.sum()) == int(sample.is_outlier.sum())
        again = CanonicalForm.of(graph).graph
        assert torch.equal(again.source, graph.source) and torch.equal(again.target, graph.target)


def test_clean_net_sees_a_joined_graph_as_a_solve_sees_it() -> None:
    network = load_network(CleanNet)
    graphs = [in_canonical_form(drawn(recipe, 6)) for recipe in RECIPES]
    batch = join(graphs)
    with torch.no_grad():
        result = network(batch.measured, batch.edges)
    alone = [clean(network, graph.graph) for graph in graphs]
    torch.testing.assert_close(
        torch.sigmoid(result.outlier_logit), torch.cat([each.outlier_probability for each in alone]), atol=1e-4, rtol=0
    )
    rectified = torch.cat([each.graph.target_from_source for each in alone])
    assert float(rotations.angle_between(result.target_from_source, rectified).max()) < 1e-3


def test_fine_net_sees_a_joined_graph_as_a_solve_sees_it() -> None:
    network, clean_net = load_network(FineNet), load_network(CleanNet)
    started = [StartedGraph.of(clean_net, in_canonical_form(drawn(recipe, 7))) for recipe in RECIPES]
    batch = FineBatch.of(started, 0.0, np.random.default_rng(0))
    with torch.no_grad():
        found, _ = batch.fine_tune(network, batch.start)
    alone = torch.cat([fine_tune(network, each.cleaned, each.start) for each in started])
    assert float(rotations.angle_between(found.double(), alone).max()) < 1e-3


def test_dropped_edges_and_outliers_take_no_part() -> None:
    started = [StartedGraph.of(load_network(CleanNet), drawn(seed=8, cameras=(60, 60)))]
    inliers = int(started[0].cleaned.is_inlier.sum())
    batch = FineBatch.of(started, 0.25, np.random.default_rng(0))
    assert len(batch.source) == pytest.approx(0.75 * inliers, rel=0.1)
    expected = DirectedEdges.of(batch.source, batch.target, 60)
    assert torch.equal(batch.edges.inverse_degree, expected.inverse_degree)
