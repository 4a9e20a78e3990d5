"""A pose graph as vertices and edges, as written to g2o's, TORO's and iSAM's files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.datasets.dead_reckoning import chain_poses
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.planar import heading_of_quaternion
from rotavg_ros.rotations import inverse
from rotavg_ros.view_graph import ViewGraph

# Where the diagonal of a 6 × 6 matrix over x, y, z and the rotation is in the 21 of its upper triangle, row by row.
POSITION_DIAGONAL = [0, 6, 11]
ANGULAR_DIAGONAL = [15, 18, 20]
# Information of an unknown position, m⁻²: practically none, but the matrix can still be inverted.
NO_INFORMATION = 1e-9
# Where the nine entries of a rotation's 3 × 3 block, row by row, are among these.
_ANGULAR_BLOCK = [15, 16, 17, 16, 18, 19, 17, 19, 20]


@dataclass(frozen=True)
class PoseGraphRows:
    """The content that the dialects of pose-graph files share (N vertices, M edges).

    Attributes:
        ids: ``(N,)``.
        position, world_from_body: ``(N, 3)`` metres and ``(N, 4)`` xyzw.
        ends: ids of the edges' sources and targets, ``(M,)`` each.
        translation, source_from_target: ``(M, 3)`` metres and ``(M, 4)`` xyzw.
        information: ``(M, 21)``, see :class:`GraphFile`.
    """

    ids: np.ndarray
    position: np.ndarray
    world_from_body: np.ndarray
    ends: tuple[np.ndarray, np.ndarray]
    translation: np.ndarray
    source_from_target: np.ndarray
    information: np.ndarray

    @property
    def planar_vertices(self) -> tuple[np.ndarray, np.ndarray]:
        """x, y and heading of the vertices."""
        return self.position[:, :2], heading_of_quaternion(self.world_from_body)

    @property
    def planar_edges(self) -> tuple[np.ndarray, np.ndarray]:
        """x, y and θ of the edges."""
        return self.translation[:, :2], heading_of_quaternion(self.source_from_target)


def lay_out(
    graph_file: GraphFile, body_from_world: np.ndarray | None = None, position: np.ndarray | None = None
) -> PoseGraphRows:
    """Vertices and edges as they are written; see :func:`rotavg_ros.datasets.files.g2o.write` for the arguments."""
    graph, ids = graph_file.graph, graph_file.node_ids
    translation = graph_file.edge_translation
    if translation is None:
        translation = np.full((graph.num_edges, 3), np.nan)
    is_known = np.isfinite(translation).all(axis=1, keepdims=True)
    translation = np.asarray(np.where(is_known, translation, 0.0))
    information = _information(graph_file)
    nothing = np.zeros(information.shape[1])
    nothing[POSITION_DIAGONAL] = NO_INFORMATION
    nothing[min(ANGULAR_DIAGONAL) :] = np.nan  # the rotation's stated part stays
    information = np.asarray(np.where(is_known | np.isnan(nothing), information, nothing))
    chained, world_from_body = chain_poses(graph, translation, body_from_world)
    return PoseGraphRows(
        ids,
        chained if position is None else position,
        world_from_body,
        (ids[graph.source.cpu().numpy()], ids[graph.target.cpu().numpy()]),
        translation,
        inverse(graph.target_from_source).cpu().numpy(),
        information,
    )


def without_position(translation: np.ndarray, information: np.ndarray) -> np.ndarray:
    """``(M,)`` bool, edges as read from a file whose translation is not known.

    Args:
        translation: ``(M, 3)`` metres.
        information: ``(M, 21)``.
    """
    stated = information[:, POSITION_DIAGONAL].max(axis=1, initial=0.0)
    is_nothing = (stated > 0) & (stated < 2 * NO_INFORMATION)  # iSAM writes roots
    return np.asarray(is_nothing & (translation == 0).all(axis=1))


def rotation_of(information: np.ndarray) -> np.ndarray | None:
    """A graph's information ``(M, 3, 3)`` of its edges' rotations, from the upper triangles ``(M, 21)`` of 6 × 6.

    An edge of g2o states the target's pose in the source's frame, with an error on its right side, Z exp(ξ): an
    error in the target's frame, as a graph has it. g2o takes x, y, z of a quaternion for ξ, half a rotation vector, so
    that its own files state four times the information; GTSAM and Ceres write them without that factor. The scale is
    left as stated, as that of precisions is: all edges have the same, and solves do not depend on it.

    None if every edge is equally exact about all axes, as its precision already states.
    """
    block = information[:, _ANGULAR_BLOCK].reshape(-1, 3, 3)
    is_round = (block == block[:, :1, :1] * np.eye(3)).all()
    return None if is_round else block


def rotation_information(graph: ViewGraph, precision: np.ndarray) -> np.ndarray:
    """``(M, 21)``, zero except for the rotation: the graph's information where known, else ``precision`` ``(M,)``."""
    blocks = precision[:, None, None] * np.eye(3)
    if graph.information is not None:
        stated = graph.information.cpu().numpy()
        blocks = np.where(np.isfinite(stated), stated, blocks)
    information = np.zeros((len(precision), 21))
    information[:, _ANGULAR_BLOCK] = blocks.reshape(-1, 9)
    return information


def _information(graph_file: GraphFile) -> np.ndarray:
    """``(M, 21)`` as stated; otherwise 1 for positions, known or not, and the graph's information for rotations."""
    precision = np.nan_to_num(graph_file.graph.precision.cpu().numpy(), nan=1.0)
    information = rotation_information(graph_file.graph, precision)
    information[:, POSITION_DIAGONAL] = 1
    stated = graph_file.edge_information
    if stated is None:
        return information
    return np.where(stated.any(axis=1, keepdims=True), stated, information)
