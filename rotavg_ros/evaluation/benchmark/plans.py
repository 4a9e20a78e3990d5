"""The graphs of the benchmark, from a hundred cameras to 25 000, drawn from fixed seeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.evaluation.common.cases import SFM, SLAM, Case, CaseKey
from rotavg_ros.view_graph import ViewGraph

_COLUMNS = ("source", "target", "target_from_source", "kind", "precision")


@dataclass(frozen=True)
class Plan:
    """A graph to be drawn.

    Attributes:
        family: of :data:`FAMILIES`.
        nodes: cameras or keyframes.
        expected_edges: about how many it will have.
        seed: of its random numbers.
    """

    family: str
    nodes: int
    expected_edges: int
    seed: int = 0

    @property
    def key(self) -> CaseKey:
        return CaseKey(f"{self.family}-{self.nodes}-{self.seed}", self.family, self.seed)

    def draw(self) -> Case:
        """The graph; the same in every call."""
        return FAMILIES[self.family].draw(self, np.random.default_rng((self.seed, self.nodes)))


@dataclass(frozen=True)
class Series:
    """Graphs of one kind, growing.

    Attributes:
        title: of its table.
        plans: in ascending size.
        draw: draws one of them.
        contenders: of ``measure.py``, in the order in which they run.
        share: share of the available time, relative to the other families.
    """

    title: str
    plans: tuple[Plan, ...]
    draw: Callable[[Plan, np.random.Generator], Case]
    contenders: tuple[str, ...]
    share: float = 1.0


def save(path: Path, case: Case) -> None:
    """Write a case for the processes that solve it."""
    graph = case.graph
    columns = {name: getattr(graph, name).numpy() for name in _COLUMNS}
    np.savez(path, key=np.array(case.key, dtype=str), num_nodes=graph.num_nodes, truth=case.truth.numpy(), **columns)


def load(path: Path) -> Case:
    """What :func:`save` wrote."""
    with np.load(path) as file:
        name, kind, seed = file["key"].tolist()
        columns = {column: torch.from_numpy(file[column]) for column in _COLUMNS}
        truth = torch.from_numpy(file["truth"])
        label = torch.zeros(len(columns["source"]), dtype=torch.int64)
        steps = torch.ones(len(columns["source"]), dtype=torch.float64)
        graph = ViewGraph(num_nodes=int(file["num_nodes"]), label=label, steps=steps, **columns)
    return Case(CaseKey(name, kind, int(seed)), graph, truth, SLAM if bool(graph.is_odometry.any()) else SFM)


def _draw_sfm(plan: Plan, rng: np.random.Generator) -> Case:
    """The paper's recipe with its middle noise, at the wanted share of all pairs."""
    share = 2 * plan.expected_edges / (plan.nodes * (plan.nodes - 1))
    recipe = PaperRecipe((plan.nodes, plan.nodes), (share, share), noise_deg=(15, 15), outlier_share=(0.15, 0.15))
    sample = recipe.sample(rng)
    return Case(plan.key, sample.graph, sample.body_from_world)


def _draw_recipe(plan: Plan, rng: np.random.Generator) -> Case:
    """The paper's recipe unchanged: 250–1000 cameras, everything random."""
    sample = PaperRecipe().sample(rng)
    return Case(plan.key, sample.graph, sample.body_from_world)


def _draw_city(plan: Plan, rng: np.random.Generator) -> Case:
    """Drives through a city, a loop closure per keyframe, one in ten of them false."""
    config = SlamSimulationConfig(
        world=World.CITY,
        num_keyframes=plan.nodes,
        laps=8,
        keyframe_distance_m=2.0,
        closure_radius_m=6.0,
        closures_per_keyframe=plan.expected_edges / plan.nodes - 1,
        false_share=0.1,
    )
    run = simulate_slam_graph(config, rng)
    return Case(plan.key, run.graph, rotations.inverse(torch.from_numpy(run.world_from_body)), SLAM)


def _dense(nodes: int, share: float) -> Plan:
    return Plan("sfm-dense", nodes, round(share * nodes * (nodes - 1) / 2))


_SFM = ("neurora", "neurora-v1", "neurora-cuda", "colmap", "shonan")
FAMILIES = {
    "recipe": Series(
        "The paper's recipe: 250–1000 cameras",
        tuple(Plan("recipe", 625, 39_000, seed) for seed in range(3)),
        _draw_recipe,
        ("neurora", "neurora-v1", "neurora-cuda", "colmap"),
    ),
    "sfm-sparse": Series(
        "SfM, sparse: 20 neighbours a camera",
        tuple(Plan("sfm-sparse", nodes, 10 * nodes) for nodes in (100, 250, 1000, 2500, 10_000, 25_000)),
        _draw_sfm,
        _SFM,
    ),
    "slam": Series(
        "SLAM: a city, one loop closure a keyframe, a tenth of them false",
        tuple(Plan("slam", nodes, 2 * nodes) for nodes in (100, 250, 1000, 2500, 10_000, 25_000)),
        _draw_city,
        ("neurora", "gnc", "colmap"),
    ),
    "sfm-dense": Series(
        "SfM, dense: 25 % of all pairs up to 1000 cameras, then 10, 5, 2.5 %",
        (
            *(_dense(nodes, 0.25) for nodes in (100, 250, 500, 1000)),
            _dense(2500, 0.1),
            _dense(5000, 0.05),
            *(_dense(nodes, 0.025) for nodes in (10_000, 25_000)),
            _dense(25_000, 0.077),
        ),
        _draw_sfm,
        _SFM,
        share=4.0,
    ),
}
