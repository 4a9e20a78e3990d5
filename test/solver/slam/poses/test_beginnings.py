"""Rejected runs at which poses are begun once more."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros import solve
from rotavg_ros.datasets.simulation.slam_config import World
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.solver.slam.poses.em.convergence import Ending
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.search.beginnings import begun_at_runs, could_be_right_together, runs_to_begin_at
from rotavg_ros.solver.slam.poses.search.settling import Rival
from rotavg_ros.solver.slam.poses.solved import PoseMode

from .test_floors import building
from .test_poses import pose_mode


def ended(pose: PoseMode, believed: np.ndarray) -> Rival:
    """Where poses of a labelling end that begin with these closures ``(C,)`` believed, and all others doubted."""
    start = PoseStart.joining(pose, np.flatnonzero(believed), np.flatnonzero(~believed))
    return Rival(pose.problem.mode, estimate_poses(pose.problem, hold=True, start=start))


@pytest.mark.large
def test_a_right_run_that_false_ones_outdo_is_found_and_nothing_that_is_false() -> None:
    made = building(4, false_share=0.65, tilts=0.05)
    pose = pose_mode(made.graph)
    is_false = np.zeros(made.graph.num_edges, dtype=bool)
    is_false[~made.graph.is_odometry.numpy()] = made.is_false
    is_false = is_false[pose.problem.closures]
    without = solve(made.graph, method="neurora~other-beginnings")

    rival = ended(pose, without.outlier_score.numpy()[pose.problem.closures] < 0.5)
    right = rival.pose.solved.places.right > 0.5
    assert (right & is_false).sum() > 20 and (~right & ~is_false).sum() > 10
    best = runs_to_begin_at(rival.pose)[0]
    assert not is_false[best].any() and not right[best].any()
    begun = begun_at_runs(rival)
    assert begun.cost < rival.cost - 30
    assert ((begun.pose.solved.places.right < 0.5) == is_false).all()

    # Odometry alone predicts each of the rejected runs worse than all that are believed.
    truth = ended(pose, ~is_false)
    assert ((truth.pose.solved.places.right < 0.5) == is_false).all()
    assert runs_to_begin_at(truth.pose) == []
    assert begun_at_runs(truth) is truth


def test_closures_that_contradict_each_other_are_no_beginning() -> None:
    """Where closures are many, random ones are near each other by chance, and odometry predicts some of them well."""
    config = SlamSimulationConfig(
        world=World.CITY,
        num_keyframes=500,
        laps=4,
        keyframe_distance_m=2.0,
        closure_radius_m=6.0,
        closures_per_keyframe=1.0,
        false_share=0.2,
    )
    run = simulate_slam_graph(config, np.random.default_rng(0))
    pose = pose_mode(run.to_graph_file().graph)
    alone = estimate_poses(pose.problem, ending=Ending(held_for=1))
    rejected = pose.solved.places.right < 0.5
    of_runs = [np.flatnonzero(rejected & (pose.problem.told.run == each)) for each in np.unique(pose.problem.told.run)]
    contradicting = [each for each in of_runs if len(each) > 1 and not could_be_right_together(alone, each)]
    assert len(contradicting) >= 5
    assert runs_to_begin_at(pose) == []
    twice = np.repeat(contradicting[0][:1], 2)
    assert could_be_right_together(alone, twice)
