"""Nodes inside segments of odometry: their poses, and their covariances.

A fraction f of the way along a segment a → b, with A, B and d of the part so far (``displacements.py``), the bridge's
turn β and the shift's own error w,

    δ = (1 − f) δ_a + f δ_b + β,      p = p_a + A + B + A × δ_a + B × δ_b + u,      u = ∫ d × dε + w,

where B = ∫ x dq with x the way from q up to the node, and d = x − B. Of the inside the rows tell only z, the error of
the segment's shift, which is u at b, with the covariance C. So given the ends it is normal with the mean above plus
G z, and with the covariance Cov − G C Gᵀ, where G = Cov((β, u), z) C⁻¹. Test: GTSAM's marginals of the whole graph.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.poses.displacements import Displacements
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.row_errors import bent_by, bridge_variance, segment_spread
from rotavg_ros.solver.slam.poses.rows import Arms, crossed, jacobian
from rotavg_ros.solver.slam.poses.solved import PoseMode

_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class NodePoses:
    """Poses of all N nodes.

    Attributes:
        body_from_world: ``(N, 4)``.
        position: ``(N, 3)`` metres.
        passed: ``(N,)`` each inner node's share of the variance of its segment's shift so far; 0 for key nodes.
        way: displacements at these orientations.
    """

    body_from_world: np.ndarray
    position: np.ndarray
    passed: np.ndarray
    way: Displacements


def poses_of_nodes(pose: PoseMode) -> NodePoses:
    """Poses of all nodes: z bends a segment by G_β z, and what is left of it goes by the distance travelled."""
    problem, state, drawn = pose.problem, pose.state, pose.problem.drawn
    segments, shifts = slice(drawn.num_segments), problem.bases[1]
    orientation = problem.orientations(state)
    inner = np.flatnonzero(problem.segment_of_node >= 0)
    segment = problem.segment_of_node[inner]
    way = problem.displacements(orientation)
    ends = state.position[drawn.target[segments]] - state.position[drawn.source[segments]]
    off = (way.displacement[segments] - ends) @ shifts
    pulled = np.linalg.solve(pose.solved.covariance[segments], off[:, :, None])[:, :, 0] @ shifts.T
    bent = np.zeros((3, drawn.paths.forest.parent.shape[0]))
    lever = np.cross(way.lever[inner], pulled[segment]) @ problem.bases[0]
    about = lever @ problem.about_drift_axis
    of_about, of_others = bridge_variance(problem, state.noise)[:, segment, None]
    bent[:, inner] = ((of_about * about + of_others * (lever - about)) @ problem.bases[0].T).T
    turned = quaternion_rows.multiply(np.ascontiguousarray(orientation.T), quaternion_rows.exp(bent))
    orientation = np.ascontiguousarray(quaternion_rows.normalize(turned).T)
    way = problem.displacements(orientation)
    position = state.position[drawn.above] + way.way
    passed = np.zeros(len(position))
    behind, whole = (state.noise.of_odometry(each) for each in (way.passed[inner], way.travelled[segment]))
    if problem.jump is not None:
        behind += problem.drawn_steps.up_to_nodes(problem.jump)[inner]
        whole += problem.jumps[segment]
    passed[inner] = behind / np.maximum(whole, _TINY)
    position[inner] += passed[inner, None] * (ends - way.displacement[segments])[segment]
    return NodePoses(orientation, position, passed, way)


class _Points(NamedTuple):
    """n points of segments.

    Attributes:
        passed, whole: ``(n,)`` variance of the turns so far, and of the whole segment, in units of one step's.
        beyond: ``(n, 3)`` metres, the way so far minus the whole segment's A.
        lever, square: ``(n, 3)`` and ``(n, 3, 3)`` integrals of the whole segment's d and d dᵀ so far.
        share: ``(n,)`` of the variance of the shift's own error so far.
    """

    passed: np.ndarray
    whole: np.ndarray
    beyond: np.ndarray
    lever: np.ndarray
    square: np.ndarray
    share: np.ndarray

    @property
    def at_target(self) -> np.ndarray:
        """``(n, 3)`` metres, B up to each point: of the whole segment x is d plus ``beyond``."""
        return np.asarray((self.passed[:, None] * self.beyond + self.lever) / np.maximum(self.whole, _TINY)[:, None])


@dataclass(frozen=True)
class InnerNodes:
    """The n nodes inside segments, given the unknowns of the key nodes; d = k + m.

    Attributes:
        node, segment: ``(n,)``.
        points: where in these they lie.
        of_shift: ``(n, m, m)`` m², C of their segments.
        gain: ``(n, d, m)`` G.
        jacobian: ``(n, d, 3 d)`` how turns and positions depend on the blocks of their segment's row.
        left: ``(n, d, d)`` their covariance if the key nodes are given.
    """

    node: np.ndarray
    segment: np.ndarray
    points: _Points
    of_shift: np.ndarray
    gain: np.ndarray
    jacobian: np.ndarray
    left: np.ndarray

    @classmethod
    def of(cls, pose: PoseMode, nodes: NodePoses) -> InnerNodes:
        """From the poses of a labelling."""
        problem, m = pose.problem, pose.problem.shifts
        node = np.flatnonzero(problem.segment_of_node >= 0)
        segment = problem.segment_of_node[node]
        here, end = _inner_points(problem, nodes, node), _ends(problem, nodes.way, segment)
        # C along the bent way, as all else here: a slip bends a segment so far that the row's own one is another.
        of_shift = _covariance(pose, nodes.way, segment, end, end)[:, -m:, -m:]
        told = _covariance(pose, nodes.way, segment, here, end)[:, :, -m:]
        gain = np.linalg.solve(of_shift, told.transpose(0, 2, 1)).transpose(0, 2, 1)
        left = _covariance(pose, nodes.way, segment, here, here) - gain @ told.transpose(0, 2, 1)
        jacobian_of = _from_ends(problem, nodes.way, (node, segment, here), gain)
        return cls(node, segment, here, of_shift, gain, jacobian_of, left)

    def left_with(self, pose: PoseMode, way: Displacements, some: np.ndarray, others: np.ndarray) -> np.ndarray:
        """``(q, d, d)`` as :attr:`left`, of some ``(q,)`` of the n nodes with others ``(q,)`` of the same segments."""
        segment, of_shift = self.segment[some], self.of_shift[some]
        one, other = (_Points(*(value[each] for value in self.points)) for each in (some, others))
        prior = _covariance(pose, way, segment, one, other)
        return np.asarray(prior - self.gain[some] @ of_shift @ self.gain[others].transpose(0, 2, 1))

    def covariance(self, pose: PoseMode) -> np.ndarray:
        """``(n, d, d)`` of their turns and positions."""
        return np.asarray(pose.solved.factor.covariance(self.jacobian, self.segment) + self.left)


def _inner_points(problem: PoseProblem, nodes: NodePoses, node: np.ndarray) -> _Points:
    """Of inner nodes ``(n,)``."""
    way, segment = nodes.way, problem.segment_of_node[node]
    whole = problem.steps[segment]
    return _Points(
        whole * problem.drawn.fraction[node],
        whole,
        way.way[node] - way.at_source[segment],
        way.lever[node],
        problem.drawn_steps.squares(nodes.body_from_world, way)[node],
        nodes.passed[node],
    )


def _ends(problem: PoseProblem, way: Displacements, segment: np.ndarray) -> _Points:
    """The ends of segments ``(n,)``."""
    whole, bridge = problem.steps[segment], way.bridge[segment]
    square = np.trace(bridge, axis1=1, axis2=2)[:, None, None] / 2 * np.eye(3) - bridge
    beyond = way.at_target[segment]
    return _Points(whole, whole, beyond, np.zeros_like(beyond), square, np.ones(len(segment)))


def _covariance(pose: PoseMode, way: Displacements, segment: np.ndarray, one: _Points, other: _Points) -> np.ndarray:
    """``(n, d, d)`` prior covariance of (β, u) at one point of each segment ``(n,)`` with that at another one."""
    problem, noise, k = pose.problem, pose.state.noise, pose.problem.turns
    is_before = (one.passed <= other.passed)[:, None]
    passed = np.minimum(one.passed, other.passed)[:, None]
    lever = np.where(is_before, one.lever, other.lever)
    square = np.where(is_before[:, :, None], one.square, other.square)
    ahead, behind = one.at_target, other.at_target
    square = square + _outer(passed * one.beyond, other.beyond) - _outer(one.whole[:, None] * ahead, behind)
    square += _outer(one.beyond, lever) + _outer(lever, other.beyond)
    whole = np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(3) - square.transpose(0, 2, 1)
    of_axes = bridge_variance(problem, noise)[:, segment, None, None]
    axes = of_axes[0] * problem.about_drift_axis + of_axes[1] * (np.eye(k) - problem.about_drift_axis)
    turn = passed[:, 0] - one.passed * other.passed / np.maximum(one.whole, _TINY)
    found = np.zeros((len(segment), k + problem.shifts, k + problem.shifts))
    found[:, :k, :k] = (turn * problem.even_turns.mean_square[segment])[:, None, None] * axes
    arm = passed * other.beyond + lever - one.passed[:, None] * behind
    back = passed * one.beyond + lever - other.passed[:, None] * ahead
    found[:, :k, k:] = axes @ crossed(problem, arm).transpose(0, 2, 1)
    found[:, k:, :k] = crossed(problem, back) @ axes
    own = segment_spread(problem, noise, way)[segment] * np.minimum(one.share, other.share)
    found[:, k:, k:] = (of_axes * bent_by(problem, square, whole)).sum(axis=0)
    found[:, k:, k:] += own[:, None, None] * np.eye(problem.shifts)
    return found


def _outer(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """``(n, 3, 3)`` products of vectors ``(n, 3)``."""
    return np.asarray(one[:, :, None] * other[:, None, :])


def _from_ends(
    problem: PoseProblem, way: Displacements, inner: tuple[np.ndarray, np.ndarray, _Points], gain: np.ndarray
) -> np.ndarray:
    """``(n, d, 3 d)`` how turns and positions of inner nodes depend on the blocks of their segments' rows.

    Args:
        problem: the graph.
        way: displacements.
        inner: ``(n,)`` nodes, their segments, and where in these they lie.
        gain: ``(n, d, m)`` G.
    """
    node, segment, here = inner
    k, d = problem.turns, problem.turns + problem.shifts
    rows = np.zeros((len(node), d, 3 * d))
    fraction = problem.drawn.fraction[node][:, None, None]
    rows[:, :k, :k], rows[:, :k, d : d + k] = fraction * np.eye(k), (1 - fraction) * np.eye(k)
    rows[:, k:, d + k : 2 * d] = np.eye(problem.shifts)
    rows[:, k:, :k] = crossed(problem, here.at_target)
    rows[:, k:, d : d + k] = crossed(problem, way.way[node] - here.at_target)
    return np.asarray(rows + gain @ jacobian(problem, Arms(way.at_target, way.at_source))[segment][:, k:])
