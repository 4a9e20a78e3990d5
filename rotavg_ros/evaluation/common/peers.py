"""Independent implementations to compare with: COLMAP's rotation averaging, and GTSAM's Shonan, GNC and iSAM2.

They come with ``pip install pycolmap gtsam`` and are imported only when one of them runs. Each takes a view-graph and
times its own work alone: the clock starts when the graph is in the peer's form and stops before its answer is
translated back. Pose-graph methods get rotation factors only, with the precisions that the graph states, since
rotations are all that the others get.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.baselines.start import depths, solve_by_component, spanning_forest, start_orientations
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.answers import Answer, Clock
from rotavg_ros.view_graph import ViewGraph

# An edge that states no precision counts as this good.
_DEFAULT_SIGMA = np.radians(1.0)
# GNC calls a residual an outlier's beyond this quantile of its χ² distribution.
_GNC_INLIER_PROBABILITY = 0.99
# Huber's threshold in standard deviations, for 95 % efficiency.
_HUBER_THRESHOLD = 1.345
# What ties the first node of a component down.
_ANCHOR_SIGMA = 1e-4
# Shonan lifts to rotations of at most this dimension before it gives up on a certificate.
_SHONAN_MAX_DIMENSION = 10


class PeerError(UserError):
    """A peer that is not installed or that gave no answer."""


@contextmanager
def _timed(clock: Clock) -> Iterator[None]:
    """Count the time of the peer's own work; what it raises when it gives up becomes a PeerError."""
    try:
        with clock.running():
            yield
    except RuntimeError as error:  # GTSAM's word for a linear system without a solution
        raise PeerError(f"the peer gave up: {error}") from None


def colmap(graph: ViewGraph) -> Answer:
    """COLMAP's rotation averaging (ℓ1 and then Geman–McClure IRLS) with its default options but for one.

    By default it withdraws, after the estimate, the orientations of nodes that no edge agrees with to 10°; here it
    answers for every node, as all others do. Of parallel edges it takes the first.
    """
    pycolmap = _load("pycolmap")
    options = pycolmap.RotationEstimatorOptions()
    options.max_rotation_error_deg = 180.0
    clock = Clock()

    def solve_connected(part: ViewGraph, _: Tensor | None) -> Tensor:
        pose_graph, reconstruction = _colmap_input(pycolmap, part)
        pycolmap.logging.minloglevel = pycolmap.logging.ERROR
        with _timed(clock):
            solved = pycolmap.run_rotation_averaging(options, pose_graph, reconstruction, [])
        images = [reconstruction.image(node + 1) for node in range(part.num_nodes)]
        if not solved or not all(image.has_pose for image in images):
            raise PeerError("COLMAP's rotation averaging left nodes without an orientation")
        return _from_rows([image.cam_from_world().rotation.quat for image in images])

    return Answer(solve_by_component(graph, None, solve_connected), clock.seconds, clock.cpu_seconds)


def shonan(graph: ViewGraph) -> Answer:
    """GTSAM's Shonan averaging: the certifiably optimal least-squares solution, without robustness."""
    gtsam = _load("gtsam")
    clock = Clock()

    def solve_connected(part: ViewGraph, _: Tensor | None) -> Tensor:
        noise = _noise_models(gtsam, part)
        edges = zip(part.source.tolist(), part.target.tolist(), _source_from_target(gtsam, part), noise, strict=True)
        averaging = gtsam.ShonanAveraging3(
            [gtsam.BinaryMeasurementRot3(*edge) for edge in edges],
            gtsam.ShonanAveragingParameters3(gtsam.LevenbergMarquardtParams.CeresDefaults()),
        )
        with _timed(clock):
            values, _ = averaging.run(averaging.initializeRandomly(), 3, _SHONAN_MAX_DIMENSION)
        return _body_from_world(values, part.num_nodes)

    return Answer(solve_by_component(graph, None, solve_connected), clock.seconds, clock.cpu_seconds)


def gnc(graph: ViewGraph) -> Answer:
    """GTSAM's graduated non-convexity (truncated least squares), with odometry as known inliers and as the start."""
    gtsam = _load("gtsam")
    forest = spanning_forest(graph)
    factors = gtsam.NonlinearFactorGraph()
    for factor in _between_factors(gtsam, graph):
        factors.add(factor)
    for root in forest.roots.tolist():
        factors.add(_anchor(gtsam, root))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    anchors = range(graph.num_edges, graph.num_edges + len(forest.roots))
    parameters.setKnownInliers([*torch.nonzero(graph.is_odometry).flatten().tolist(), *anchors])
    optimizer = gtsam.GncLMOptimizer(factors, _start_values(gtsam, graph), parameters)
    optimizer.setInlierCostThresholdsAtProbability(_GNC_INLIER_PROBABILITY)
    clock = Clock()
    with _timed(clock):
        values = optimizer.optimize()
    # A weight is 1 for an inlier and 0 for an outlier where the annealing has ended.
    score = torch.from_numpy(1 - np.asarray(optimizer.getWeights())[: graph.num_edges])
    return Answer(_body_from_world(values, graph.num_nodes), clock.seconds, clock.cpu_seconds, score)


def isam2_huber(graph: ViewGraph) -> Answer:
    """GTSAM's iSAM2, one update per node in the order of the odometry, Huber's loss on closures."""
    gtsam = _load("gtsam")
    forest = spanning_forest(graph)
    depth = depths(forest)
    order = np.argsort(depth, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(graph.num_nodes)
    # An edge arrives with the later of its ends.
    arrival = np.maximum(rank[graph.source.numpy()], rank[graph.target.numpy()])
    edges_by_arrival = np.argsort(arrival, kind="stable")
    bounds = np.searchsorted(arrival[edges_by_arrival], np.arange(graph.num_nodes + 1))
    factors = _between_factors(gtsam, graph, huber_on_closures=True)
    start = _start_values(gtsam, graph)
    isam = gtsam.ISAM2(gtsam.ISAM2Params())
    clock = Clock()
    for step, node in enumerate(order.tolist()):
        added, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for edge in edges_by_arrival[bounds[step] : bounds[step + 1]].tolist():
            added.add(factors[edge])
        parent = int(forest.parent[node])
        with _timed(clock):
            if parent == node:
                added.add(_anchor(gtsam, node))
                values.insert(node, start.atRot3(node))
            else:
                node_from_parent = start.atRot3(parent).between(start.atRot3(node))
                values.insert(node, isam.calculateEstimateRot3(parent).compose(node_from_parent))
            isam.update(added, values)
    return Answer(_body_from_world(isam.calculateEstimate(), graph.num_nodes), clock.seconds, clock.cpu_seconds)


def _load(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise PeerError(f"this comparison needs {name}, which is not installed; run: pip install {name}") from None


def _colmap_input(pycolmap: Any, graph: ViewGraph) -> tuple[Any, Any]:
    reconstruction = pycolmap.Reconstruction()
    model = pycolmap.CameraModelId.SIMPLE_PINHOLE
    reconstruction.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1))
    for node in range(graph.num_nodes):
        image = pycolmap.Image(name=str(node), camera_id=1, image_id=node + 1)
        reconstruction.add_image_with_trivial_frame(image)
    pose_graph = pycolmap.PoseGraph()
    ends = zip(graph.source.tolist(), graph.target.tolist(), strict=True)
    for (source, target), quaternion in zip(ends, graph.target_from_source.numpy(), strict=True):
        if not pose_graph.has_edge(source + 1, target + 1):
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion), np.zeros(3))
            pose_graph.add_edge(source + 1, target + 1, pycolmap.PoseGraphEdge(cam2_from_cam1=pose))
    return pose_graph, reconstruction


def _source_from_target(gtsam: Any, graph: ViewGraph) -> list[Any]:
    """GTSAM's measurements: its values are world_from_body, so an edge is their difference the other way round."""
    return _rot3(gtsam, rotations.inverse(graph.target_from_source))


def _rot3(gtsam: Any, quaternion: Tensor) -> list[Any]:
    return [gtsam.Rot3.Quaternion(w, x, y, z) for x, y, z, w in quaternion.tolist()]


def _noise_models(gtsam: Any, graph: ViewGraph) -> list[Any]:
    sigma = torch.where(graph.precision.isnan(), _DEFAULT_SIGMA, graph.precision.rsqrt())
    return [gtsam.noiseModel.Isotropic.Sigma(3, value) for value in sigma.tolist()]


def _between_factors(gtsam: Any, graph: ViewGraph, huber_on_closures: bool = False) -> list[Any]:
    noise = _noise_models(gtsam, graph)
    if huber_on_closures:
        huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER_THRESHOLD)
        noise = [
            model if is_odometry else gtsam.noiseModel.Robust.Create(huber, model)
            for model, is_odometry in zip(noise, graph.is_odometry.tolist(), strict=True)
        ]
    edges = zip(graph.source.tolist(), graph.target.tolist(), _source_from_target(gtsam, graph), noise, strict=True)
    return [gtsam.BetweenFactorRot3(*edge) for edge in edges]


def _anchor(gtsam: Any, node: int) -> Any:
    return gtsam.PriorFactorRot3(node, gtsam.Rot3(), gtsam.noiseModel.Isotropic.Sigma(3, _ANCHOR_SIGMA))


def _start_values(gtsam: Any, graph: ViewGraph) -> Any:
    """Orientations along the odometry; roots are at the identity, where they are anchored."""
    values = gtsam.Values()
    orientations = rotations.inverse(start_orientations(graph)[0])
    for node, orientation in enumerate(_rot3(gtsam, orientations)):
        values.insert(node, orientation)
    return values


def _body_from_world(values: Any, num_nodes: int) -> Tensor:
    world_from_body = [values.atRot3(node).toQuaternion() for node in range(num_nodes)]
    return rotations.inverse(_from_rows([[q.x(), q.y(), q.z(), q.w()] for q in world_from_body]))


def _from_rows(quaternions: list[Any]) -> Tensor:
    return rotations.normalize(torch.tensor(np.array(quaternions, dtype=np.float64).reshape(-1, 4)))
