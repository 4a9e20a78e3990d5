"""COLMAP's rotation averaging."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from rotavg_ros.baselines.start import solve_by_component
from rotavg_ros.evaluation.common.answers import Answer, Clock
from rotavg_ros.evaluation.common.peers.running import PeerError, from_rows, load, timed
from rotavg_ros.view_graph import ViewGraph


def colmap(graph: ViewGraph) -> Answer:
    """COLMAP's rotation averaging (ℓ1 and then Geman–McClure IRLS) with its default options except one.

    By default it removes, after the estimate, the orientations of nodes that no edge agrees with to 10°; here it
    answers for every node, as all others do. It uses the first of parallel edges. It is given neither a start nor
    precisions, and not told which edges are odometry.
    """
    pycolmap = load("pycolmap")
    options = pycolmap.RotationEstimatorOptions()
    options.max_rotation_error_deg = 180.0
    clock = Clock()

    def solve_connected(part: ViewGraph, _: Tensor | None) -> Tensor:
        pose_graph, reconstruction = _colmap_input(pycolmap, part)
        pycolmap.logging.minloglevel = pycolmap.logging.ERROR
        with timed(clock):
            solved = pycolmap.run_rotation_averaging(options, pose_graph, reconstruction, [])
        images = [reconstruction.image(node + 1) for node in range(part.num_nodes)]
        if not solved or not all(image.has_pose for image in images):
            raise PeerError("COLMAP's rotation averaging left nodes without an orientation")
        return from_rows([image.cam_from_world().rotation.quat for image in images])

    return Answer(solve_by_component(graph, None, solve_connected), clock.seconds, clock.cpu_seconds)


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
