"""Judges closures that arrived since the last solve, and includes the good ones, by linearisation about that solve.

The unknowns of the last solve are N(0, H⁻¹) about their estimates. So the residuals r of new closures are N(0, S), with
S = A H⁻¹ Aᵀ + the variance of odometry since then + their own noise. The good ones move the unknowns by H⁻¹ Aᵀ S⁻¹ r
(the matrix inversion lemma, as in recursive least squares). This takes one solve with the existing factor for each
component of each closure, and no factorisation. It is as exact as the linearisation; noise, labels and FineNet's
weights stay as they are until the next solve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.special import expit

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.products import product
from rotavg_ros.solver.algebra.quaternion_rows import turned_back
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.graph.odometry_paths import Growth
from rotavg_ros.solver.slam.graph.routes import ways_by
from rotavg_ros.solver.slam.graph.walk import Dependence, Walk, common_walk
from rotavg_ros.solver.slam.poses.problem import crossing
from rotavg_ros.solver.slam.posterior.densities import log_false
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.update.columns import Columns
from rotavg_ros.solver.slam.update.given import Change, Given
from rotavg_ros.solver.slam.update.linear import Linear
from rotavg_ros.solver.slam.update.moved import Hangs, shifted, turned
from rotavg_ros.view_graph import ViewGraph

# Number of closures whose columns are computed at once.
_AT_ONCE = 8
# Maximum number of rounds of judging the new closures, each given those that were good in the round before.
_ROUNDS = 3
# Precision of an unknown translation, relative to that of one anywhere on the map.
_NOTHING = 1e-6
# Least share of a node's variance that closures leave: both are estimates, so their difference may come out too small.
_SUREST = 0.02


@dataclass(frozen=True)
class LaidOn:
    """The answer of a graph with N' ≥ N nodes; those newer than the last solve are placed along odometry.

    Attributes:
        graph: the calibrated graph.
        body_from_world: ``(N', 4)``.
        position: ``(N', 3)`` metres; None by rotations alone.
        variance: ``(2, N')`` rad² and m² per component, of orientations and positions.
    """

    graph: ViewGraph
    body_from_world: torch.Tensor
    position: np.ndarray | None
    variance: np.ndarray


@dataclass(frozen=True)
class Conditioned:
    """The answer with n new closures.

    Attributes:
        laid: the answer after the good ones among them have moved it.
        score, rotation_score: ``(n,)`` probability that each closure is false, and that its rotation is.
        precision: ``(n, 2)`` rad⁻² and m⁻² per component of each closure that is good; 0 for unknown translations.
        columns: columns of the closures that are included.
    """

    laid: LaidOn
    score: np.ndarray
    rotation_score: np.ndarray
    precision: np.ndarray
    columns: Columns


def conditioned(
    linear: Linear, laid: LaidOn, growth: Growth, edge: np.ndarray, columns: Columns, most: int
) -> Conditioned:
    """Judges new closures and includes the good ones.

    Args:
        linear: the last solve.
        laid: the answer, with new nodes placed along odometry from that solve.
        growth: how the new nodes are attached to those of the last solve.
        edge: ``(n,)`` the new closures, in the order of their arrival.
        columns: columns of the first of them, as computed so far.
        most: maximum number of closures whose columns are computed now; the rest are scored independently of each other
            and move nothing.
    """
    system = _System.of(linear, laid, growth, edge)
    known = len(columns.edge)
    for first in range(known, min(known + most, len(edge)), _AT_ONCE):
        some = slice(first, min(first + _AT_ONCE, known + most))
        spend(linear.column_work * linear.size * len(edge[some]))
        columns = columns.and_of(linear, edge[some], system.columns(some))
    columns = columns.with_anchors(linear, system.anchors)
    count = len(columns.edge)
    walked = system.walked_to_new(count)
    covariance, residual = system.covariance(columns.covariance, walked), system.residual[:count]
    rows = system.of_new_nodes(columns, walked)
    odds, rotation_odds = system.log_odds(*Given.none(count, linear.size).left_out(covariance, residual), slice(count))
    given, changes = columns.given.changed_to(covariance, odds > 0)
    surer = _surer(columns.surer, rows, given, changes)
    columns = replace(columns, given=given, surer=surer)
    for _ in range(_ROUNDS - 1):
        odds, rotation_odds = system.log_odds(*given.left_out(covariance, residual), slice(count))
        if ((odds > 0) == given.is_given).all():
            break
        given, changes = given.changed_to(covariance, odds > 0)
        surer = _surer(surer, rows, given, changes)
    apart = system.log_odds(system.residual[count:], system.independent(slice(count, None)), slice(count, None))
    score = expit(-np.append(odds, apart[0]))
    rotation_score = expit(-np.append(rotation_odds, apart[1]))
    precision = np.stack((1 / system.own[0], system.is_known / system.own[1]), axis=1)
    moved = system.moved(columns, given, walked)
    if given.is_given.any():
        moved = replace(moved, variance=system.lowered(surer))
    return Conditioned(moved, score, np.minimum(score, rotation_score), precision, columns)


@dataclass(frozen=True)
class _System:
    """The rows of n new closures (N' nodes, d components in q columns).

    Attributes:
        linear: the last solve.
        laid: the answer, with new nodes placed along odometry.
        source, target: ``(n,)`` their ends.
        older: ``(n,)`` the end in whose axes each translation is stated.
        anchor: ``(N',)`` node of the last solve that each node moves with; for nodes of that solve, the node itself.
        way: ``(N', 3)`` metres from the anchor.
        walk: odometry since the last solve.
        residual: ``(n, d, q)``: q = 1; or by rotations alone, d = 1 and q = 3.
        displacement: ``(n, 3)`` metres, measured translations in the world; 0 where unknown.
        own: ``(2, n)`` rad² and m², variances of good closures of typical stated variance.
        is_known: ``(n,)`` bool, whether their translations are known.
    """

    linear: Linear
    laid: LaidOn
    source: np.ndarray
    target: np.ndarray
    older: np.ndarray
    anchor: np.ndarray
    way: np.ndarray
    walk: Walk
    residual: np.ndarray
    displacement: np.ndarray
    own: np.ndarray
    is_known: np.ndarray

    @classmethod
    def of(cls, linear: Linear, laid: LaidOn, growth: Growth, edge: np.ndarray) -> _System:
        graph, noise = laid.graph, linear.noise
        position = np.zeros((graph.num_nodes, 3)) if laid.position is None else laid.position
        steps = graph.steps.numpy()[growth.edge]
        passed = np.stack((noise.turn * steps, np.zeros(len(steps))))
        if laid.position is not None and graph.translation is not None:
            step = graph.translation[torch.from_numpy(growth.edge)]
            metres = torch.linalg.vector_norm(step, dim=1).nan_to_num().numpy()
            passed[1] = noise.of_odometry(np.stack((metres, steps), axis=1))
        walk = Walk.begin(linear.num_nodes).along(growth, passed, position)
        anchor = np.append(np.arange(linear.num_nodes), walk.anchor)
        way = np.concatenate((np.zeros((linear.num_nodes, 3)), walk.way))
        source, target = graph.source[edge], graph.target[edge]
        body_from_world = laid.body_from_world
        expected = rotations.multiply(graph.target_from_source[edge].double(), body_from_world[source])
        turn = rotations.log(rotations.multiply(rotations.inverse(body_from_world[target]), expected)).numpy()
        older = torch.minimum(source, target).numpy()
        displacement, square = np.zeros((len(edge), 3)), np.zeros(len(edge))
        is_known = np.zeros(len(edge), dtype=bool)
        if linear.turns is None or linear.shifts is None or graph.translation is None:
            residual = turn[:, None, :]
        else:
            translation = graph.translation[edge].double().numpy()
            is_known = np.isfinite(translation).all(axis=1)
            translation = np.nan_to_num(translation)
            displacement = turned_back(body_from_world.numpy(), older, ways_by(graph, edge, translation, older))
            shift = displacement - (position[target.numpy()] - position[source.numpy()])
            shift *= is_known[:, None]
            square = (translation**2).sum(axis=1)
            residual = np.concatenate((turn @ linear.turns, shift @ linear.shifts), axis=1)[:, :, None]
        own_shift = np.where(is_known, noise.of_closures(square), linear.extent / _NOTHING)
        own = np.stack((np.full(len(edge), noise.closure_turn), own_shift))
        return cls(
            linear,
            laid,
            source.numpy(),
            target.numpy(),
            older,
            anchor,
            way,
            walk,
            residual,
            displacement,
            own,
            is_known,
        )

    @property
    def _widths(self) -> tuple[int, int]:
        """Number of components of turns, and of shifts, in a row."""
        turns, shifts = self.linear.turns, self.linear.shifts
        return (1, 0) if turns is None or shifts is None else (turns.shape[1], shifts.shape[1])

    @property
    def anchors(self) -> np.ndarray:
        """``(2, n)`` blocks between which the anchors of the new nodes lie."""
        anchor = self.anchor[self.linear.num_nodes :]
        return np.stack((self.linear.above[anchor], self.linear.below[anchor]))

    def columns(self, which: slice) -> np.ndarray:
        """``(K + R, d, n d)`` Aᵀ of some closures."""
        linear, d = self.linear, self.linear.size
        rows = self._rows(which)
        return np.asarray(rows.toarray().T.reshape(linear.num_blocks, d, -1))

    def _rows(self, which: slice) -> csr_array:
        """``(n d, (K + R) d)`` A of some closures."""
        linear, (k, m), d = self.linear, self._widths, self.linear.size
        source, target = self.source[which], self.target[which]
        count = len(source)
        blocks, values = [], []
        for node, sign in ((target, 1.0), (source, -1.0)):
            lever = np.where((node == self.older[which])[:, None], self.displacement[which], 0.0)
            anchor = self.anchor[node]
            value = np.zeros((count, d, d))
            value[:, :k, :k] = sign * np.eye(k)
            if m:
                value[:, k:, k:] = sign * np.eye(m)
                value[:, k:, :k] = self._crossed(sign * self.way[node] - lever)
            share = np.repeat(linear.share[:, anchor], (k, m), axis=0).T[:, None, :]
            for block, part in ((linear.above, 1 - share), (linear.below, share)):
                blocks.append(block[anchor])
                values.append(value * part)
        row = (np.arange(count)[:, None] * d + np.arange(d))[None, :, :, None]
        column = (np.stack(blocks)[:, :, None] * d + np.arange(d))[:, :, None, :]
        row, column = np.broadcast_arrays(row, column)
        shape = count * d, linear.num_blocks * d
        return csr_array((np.stack(values).ravel(), (row.ravel(), column.ravel())), shape=shape)

    def _crossed(self, vector: np.ndarray) -> np.ndarray:
        """``(n, m, k)`` matrices of v × in the axes of shifts and turns."""
        return np.asarray(np.tensordot(vector, self._crossing, 1))

    def covariance(self, by_columns: np.ndarray, walked: np.ndarray) -> np.ndarray:
        """``(n, d, n, d)`` S of the first n closures, given A H⁻¹ Aᵀ ``(n d, n d)`` and :meth:`walked_to_new`."""
        count, d, (k, m) = walked.shape[2], self.linear.size, self._widths
        between: np.ndarray = by_columns.reshape(count, d, count, d).copy()
        ends = self._ends(count)
        # What walks with the new nodes at closures' ends walks with closures.
        for node, sign, lever in zip(ends.node, ends.sign, ends.lever, strict=True):
            has = np.flatnonzero(node >= self.linear.num_nodes)
            own = walked[node[has] - self.linear.num_nodes]
            between[has] += sign * own
            if m:
                turned = np.matmul(self._crossed(lever[has]), own[:, :k].reshape(len(has), k, count * d))
                between[has, k:] += turned.reshape(len(has), m, count, d)
        inside = np.arange(count)
        for axis, kind in enumerate(np.repeat([0, 1], (k, m))):
            between[inside, axis, inside, axis] += self._besides(slice(count))[kind]
        return between

    def _ends(self, count: int) -> Dependence:
        """How the residuals of the first n closures depend on their ends."""
        node = np.stack((self.target[:count], self.source[:count]))
        is_older = node == self.older[:count]
        return Dependence(node, np.array([1.0, -1.0]), np.where(is_older[:, :, None], -self.displacement[:count], 0.0))

    def walked_to_new(self, count: int) -> np.ndarray:
        """``(N' - N, d, n, d)`` rad² and m²: covariance of new nodes and n closures' residuals, by odometry alone."""
        new = Dependence.on(np.arange(self.linear.num_nodes, len(self.anchor)))
        return common_walk(self.walk, self._crossing, new, self._ends(count))

    @cached_property
    def _crossing(self) -> np.ndarray:
        """``(3, m, k)`` v × in the axes of shifts and turns."""
        turns, shifts = self.linear.turns, self.linear.shifts
        if turns is None or shifts is None:
            return np.zeros((3, 0, 1))
        return crossing(turns, shifts).reshape(3, shifts.shape[1], turns.shape[1])

    def _besides(self, which: slice) -> np.ndarray:
        """``(2, n)`` rad² and m²: closures' own noise, plus the errors of their ends relative to the key nodes."""
        ends = self.anchor[self.source[which]], self.anchor[self.target[which]]
        return np.asarray(self.own[:, which] + self.linear.bridge[:, ends[0]] + self.linear.bridge[:, ends[1]])

    def independent(self, which: slice) -> np.ndarray:
        """``(n, d, d)`` covariance of residuals, as if the errors of closures' ends were independent."""
        variance = self.own[:, which] + sum(self.laid.variance[:, end[which]] for end in (self.source, self.target))
        of_row = np.repeat(variance, self._widths, axis=0).T
        return np.asarray(of_row[:, :, None] * np.eye(self.linear.size))

    def log_odds(self, mean: np.ndarray, covariance: np.ndarray, which: slice) -> tuple[np.ndarray, np.ndarray]:
        """``(n,)`` log-odds that closures are good, and that their rotations are.

        Args:
            mean: ``(n, d, q)`` residuals relative to the prediction by all else.
            covariance: ``(n, d, d)`` of these, including the closures' own noise.
            which: the closures.
        """
        linear, priors, (k, m) = self.linear, SlamPriors(), self._widths
        share, count = priors.outlier_share, priors.outlier_count
        told = np.log((linear.good + (1 - share) * count) / (linear.false + share * count))
        turn = covariance[:, :k, :k]
        times = linear.components if m == 0 else 1
        square = (mean[:, :k] ** 2).sum(axis=(1, 2))
        predicted = np.trace(turn, axis1=1, axis2=2) / k - self.own[0, which]
        false_turn = log_false(square, linear.components, priors, predicted=np.maximum(predicted, 0.0))
        good_turn = _log_normal(mean[:, :k], turn, times)
        rotation = told + good_turn - false_turn
        if m == 0:
            return rotation, rotation
        extent = np.maximum(linear.extent, (self.displacement[which] ** 2).sum(axis=1) / m)
        anywhere = covariance[:, k:, k:] + extent[:, None, None] * np.eye(m)
        false_place = _log_normal(mean[:, k:], anywhere, 1)
        both = told + _log_normal(mean, covariance, 1) - false_turn - false_place
        return np.where(self.is_known[which], both, rotation), rotation

    def moved(self, columns: Columns, by: Given, walked: np.ndarray) -> LaidOn:
        """The answer after the given closures have moved all nodes."""
        if not by.is_given.any():
            return self.laid
        linear, d, k, count = self.linear, self.linear.size, self._widths[0], len(by.is_given)
        q = self.residual.shape[2]
        pull = product(by.precision, self.residual[:count].reshape(-1, q)).reshape(count, d, q)
        step = columns.moves(linear, pull.reshape(-1, q))
        along = product(walked.reshape(-1, count * d), pull.reshape(-1, q)).reshape(-1, d, q)
        # Vectors of the world frame: for each block, and for new nodes in addition.
        turn, walked_turn = (
            each[:, 0] if linear.turns is None else each[:, :k, 0] @ linear.turns.T for each in (step, along)
        )
        before = self.laid.body_from_world.numpy()
        hangs = Hangs(self.anchor, linear.above, linear.below, linear.share)
        orientation = torch.from_numpy(turned(hangs, turn, walked_turn, before))
        if linear.shifts is None or self.laid.position is None:
            return replace(self.laid, body_from_world=orientation)
        shift = step[:, k:, 0] @ linear.shifts.T
        walked_shift = along[:, k:, 0] @ linear.shifts.T
        position = shifted(hangs, turn, (shift, walked_shift), self.way, self.laid.position)
        return replace(self.laid, body_from_world=orientation, position=position)

    def of_new_nodes(self, columns: Columns, walked: np.ndarray) -> np.ndarray:
        """``(N' - N, d, n d)`` rad² and m², covariance of new nodes with the residuals of n closures."""
        linear, d, (k, m), count = self.linear, self.linear.size, self._widths, len(columns.edge)
        new = np.arange(linear.num_nodes, len(self.anchor))
        if len(new) == 0 or count == 0:
            return np.zeros((len(new), d, count * d))
        above, below = columns.at(self.anchors)
        share = linear.share[:, self.anchor[new]][:, :, None, None]
        told = [(1 - share[kind]) * above + share[kind] * below for kind in (0, 1)]
        both = np.concatenate((told[0][:, :k], told[1][:, k:]), axis=1).reshape(len(new), d, count, d)
        if m:
            lever = self._crossed(self.way[new])
            both[:, k:] += np.einsum("nmk,nkcd->nmcd", lever, both[:, :k])
        both += walked
        return both.reshape(len(new), d, -1)

    def lowered(self, surer: np.ndarray) -> np.ndarray:
        """``(2, N')`` rad² and m², variances of nodes, those of new ones lowered by ``(N' - N, d)``."""
        variance: np.ndarray = self.laid.variance.copy()
        new, k = slice(self.linear.num_nodes, None), self._widths[0]
        for kind, part in enumerate((surer[:, :k], surer[:, k:])):
            if part.shape[1]:
                before = variance[kind, new]
                variance[kind, new] = np.maximum(before - part.mean(axis=1), _SUREST * before)
        return variance


def _surer(before: np.ndarray, rows: np.ndarray, given: Given, changes: list[Change] | None) -> np.ndarray:
    """``(n, d)`` rad² or m², by how much given closures lower the variances of new nodes.

    Args:
        before: ``(n', d)`` the same for the first n' ≤ n nodes, before the changes.
        rows: ``(n, d, c d)`` covariances of the nodes with all closures.
        given: the given ones.
        changes: how these have changed; None: in another way.
    """
    count, d, width = rows.shape
    known = 0 if changes is None else len(before)
    surer = np.empty((count, d))
    surer[known:] = given.told(rows[known:].reshape(-1, width)).reshape(-1, d)
    surer[:known] = before[:known].reshape(-1, d)
    for change in changes or ():
        surer[:known] += change.told(rows[:known].reshape(-1, width)).reshape(-1, d)
    return surer


def _log_normal(mean: np.ndarray, covariance: np.ndarray, times: int) -> np.ndarray:
    """``(n,)`` log N(0, covariance) of ``(n, d, q)``; the determinant counts ``times`` times."""
    size = mean.shape[1]
    square = (mean * np.linalg.solve(covariance, mean)).sum(axis=(1, 2))
    log_det = np.linalg.slogdet(covariance)[1] + size * np.log(2 * np.pi)
    return np.asarray(-(square + times * log_det) / 2)
