"""The contenders on positions, and what each is told about an edge's noise."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.baselines.consistent_closures import consistent_closures
from rotavg_ros.baselines.pose_least_squares import FloatArray, pose_least_squares, start_of_poses
from rotavg_ros.datasets.dead_reckoning import chain_poses
from rotavg_ros.evaluation.common import peers
from rotavg_ros.evaluation.common.answers import Answer, Clock
from rotavg_ros.evaluation.common.cases import SLAM, Case
from rotavg_ros.evaluation.common.contenders import OwnContender, Roster
from rotavg_ros.evaluation.common.peers import MissingPeerError, PeerError
from rotavg_ros.evaluation.slam.contenders import ORACLE, OURS
from rotavg_ros.solver import solve
from rotavg_ros.solver.positions import Translations, fit_positions
from rotavg_ros.view_graph import FALSE_CLOSURE_M

ROTATIONS_ALONE = "neurora-rotations"
# Factor by which the deviations of odometry that one of the peers is told are too small.
_WRONG_FACTOR = 5.0
# Most closures that are compared in pairs: four times as many take minutes.
_MOST_PAIRED = 2000


def odometry(case: Case) -> Answer:
    """Dead reckoning; a closure is judged by its residual."""
    clock = Clock()
    with clock.running():
        position, world_from_body = chain_poses(case.graph, _translation(case))
    return _answer(case, Rotation.from_quat(world_from_body).inv(), position, clock)


def oracle(case: Case) -> Answer:
    """Least squares on poses, on the true inliers with the true deviations."""
    return _least_squares(case, case.is_inlier.numpy(), Clock())


def pairwise_consistency(case: Case) -> Answer | None:
    """Pairwise consistency maximisation with the true deviations, then least squares on what is left."""
    if int(case.is_closure.sum()) > _MOST_PAIRED:
        return None
    clock = Clock()
    with clock.running():
        is_kept = consistent_closures(case.graph, _sigma(case), chain_poses(case.graph, _translation(case)))
    answer = _least_squares(case, is_kept, clock)
    return replace(answer, outlier_score=torch.from_numpy(~is_kept).double())


def rotations_alone(case: Case) -> Answer:
    """Our default without translations, and positions fitted to them along its orientations."""
    clock = Clock()
    with clock.running():
        solution = solve(replace(case.graph, translation=None), method=OURS, profile=case.family.profile)
        edges = Translations(
            case.graph.source.numpy(),
            case.graph.target.numpy(),
            _translation(case),
            case.graph.is_odometry.numpy(),
            solution.outlier_score.numpy(),
            case.graph.steps.numpy(),
        )
        position = fit_positions(solution.world_from_body.numpy(), edges, np.zeros((case.graph.num_nodes, 3)))
    return Answer(
        solution.body_from_world,
        clock.seconds,
        clock.cpu_seconds,
        solution.outlier_score,
        position=torch.from_numpy(position),
    )


def gnc(told: str, case: Case) -> Answer | None:
    """GTSAM's graduated non-convexity.

    Args:
        told: "stated", "true" or "wrong" deviations.
    """
    assert case.poses is not None
    sigma = case.poses.stated.numpy() if told == "stated" else _sigma(case)
    if told == "wrong":
        sigma = np.where(case.is_closure.numpy()[:, None], sigma, sigma / _WRONG_FACTOR)
    try:
        return peers.gnc_on_poses(case.graph, sigma, chain_poses(case.graph, _translation(case)))
    except MissingPeerError:
        raise
    except PeerError:
        return None


def isam2(case: Case) -> Answer | None:
    """GTSAM's iSAM2 with Cauchy's loss and the true deviations; a closure is judged by its residual."""
    try:
        answer = peers.isam2_on_poses(case.graph, _sigma(case), chain_poses(case.graph, _translation(case)))
    except MissingPeerError:
        raise
    except PeerError:
        return None
    assert answer.position is not None
    orientations = Rotation.from_quat(answer.body_from_world.numpy())
    return _answer(case, orientations, answer.position.numpy(), Clock(answer.seconds, answer.cpu_seconds))


def residual_verdicts(case: Case, body_from_world: Rotation, position: FloatArray) -> torch.Tensor:
    """``(M,)``: 1 for closures that lie more than 10° or 2 m off an answer, else 0."""
    source, target = case.graph.source.numpy(), case.graph.target.numpy()
    measured = Rotation.from_quat(case.graph.target_from_source.numpy())
    turn = (measured * body_from_world[source] * body_from_world[target].inv()).magnitude()
    shift = body_from_world[source].apply(position[target] - position[source]) - _translation(case)
    is_off = (turn > case.family.outlier_angle) | (np.linalg.norm(shift, axis=1) > FALSE_CLOSURE_M)
    return torch.from_numpy(is_off & case.is_closure.numpy()).double()


def _least_squares(case: Case, is_used: np.ndarray, clock: Clock) -> Answer:
    """Odometry is among the edges that are used, so that they connect all nodes."""
    with clock.running():
        graph, sigma = case.graph.select_edges(torch.from_numpy(is_used)), _sigma(case)[is_used]
        found = pose_least_squares(graph, sigma, start_of_poses(graph, sigma))
    return _answer(case, Rotation.from_quat(found.body_from_world.numpy()), found.position, clock)


def _answer(case: Case, body_from_world: Rotation, position: FloatArray, clock: Clock) -> Answer:
    return Answer(
        torch.from_numpy(body_from_world.as_quat(canonical=True)),
        clock.seconds,
        clock.cpu_seconds,
        residual_verdicts(case, body_from_world, position),
        position=torch.from_numpy(position),
    )


def _sigma(case: Case) -> FloatArray:
    assert case.poses is not None
    return np.asarray(case.poses.sigma.numpy())


def _translation(case: Case) -> FloatArray:
    assert case.graph.translation is not None
    return np.asarray(case.graph.translation.numpy())


GNC_STATED, GNC_TRUE, GNC_WRONG = "gnc-stated", "gnc-true", "gnc-wrong"
PEERS = (GNC_STATED, GNC_TRUE, GNC_WRONG, "isam2-cauchy", "pcm")
ROSTER = Roster(
    SLAM,
    peers=(),
    references={},
    own={
        ROTATIONS_ALONE: OwnContender(rotations_alone),
        GNC_STATED: OwnContender(partial(gnc, "stated"), "gtsam"),
        GNC_TRUE: OwnContender(partial(gnc, "true"), "gtsam"),
        GNC_WRONG: OwnContender(partial(gnc, "wrong"), "gtsam"),
        "isam2-cauchy": OwnContender(isam2, "gtsam"),
        "pcm": OwnContender(pairwise_consistency),
        "odometry": OwnContender(odometry),
        ORACLE: OwnContender(oracle),
    },
)
ROWS: dict[str, str] = {
    OURS: "**ours** (NeuRoRA for SLAM)",
    ROTATIONS_ALONE: "· without translations, positions fitted afterwards",
    GNC_STATED: "GNC on poses (GTSAM), stated deviations",
    GNC_TRUE: "GNC on poses (GTSAM), true deviations",
    GNC_WRONG: "GNC on poses (GTSAM), odometry's deviations told five times too small",
    "isam2-cauchy": "iSAM2 on poses with Cauchy's loss (GTSAM), incremental",
    "pcm": "pairwise consistent closures (PCM), then least squares",
    "odometry": "odometry alone",
    ORACLE: "oracle: least squares on the true inliers",
}
TOLD: dict[str, str] = {
    OURS: "rotations, translations, stated precisions of rotations (treated with suspicion); no deviation of a shift",
    ROTATIONS_ALONE: "the same, but no translations in the solve",
    GNC_STATED: "deviations as edges state them: simulated graphs the true ones, others what their files state; that "
    "odometry is right",
    GNC_TRUE: "the deviations that the noise was drawn with; that odometry is right",
    GNC_WRONG: "those of closures right, those of odometry divided by five; that odometry is right",
    "isam2-cauchy": "the deviations that the noise was drawn with; that odometry is right",
    "pcm": "the deviations that the noise was drawn with; that odometry is right",
    "odometry": "odometry",
    ORACLE: "which closures are good, and the deviations that the noise was drawn with",
}
