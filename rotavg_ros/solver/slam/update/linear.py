"""The normal approximation at a solve's answer, with which later closures are compared and which they update.

The unknowns of the last solve (K key nodes and R runs, d components each) are N(0, H⁻¹) about their estimates, H as it
was factorised. Nodes between key nodes follow those by their shares; nodes that odometry has appended since move with
the node that they hang on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.slam.poses.row_errors import mean_closure_shift, mean_closure_turn, mean_turn
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.poses.state import PoseNoise
from rotavg_ros.solver.slam.posterior.mode import Mode

# Entries of a factor that a column passes per unit of work. Half a column passes only what is eliminated after a
# closure's ends, a tenth of it, and takes four times as long per entry because few columns are solved at once.
_ENTRIES, _PASSED = 1.2e6, 0.4


@dataclass(frozen=True)
class Linear:
    """The approximation for N nodes and M edges, with k components of turns and m of shifts; d = k + m.

    By rotations alone all components of a turn share one system: then d is 1, and ``components`` tells k.

    Attributes:
        num_edges: M.
        above, below: ``(N,)`` key nodes between which each node lies.
        share: ``(2, N)`` how far from the one to the other, for turns and for shifts.
        bridge: ``(2, N)`` rad² and m², variance of each node relative to the interpolation.
        num_blocks: K + R.
        components: k.
        turns, shifts: ``(3, k)`` and ``(3, m)`` axes; None by rotations alone, whose axes are x, y and z.
        noise: variances of odometry and closures; those of translations are 0 by rotations alone.
        good, false: number of good closures, and of false ones.
        extent: m² per component, variance of the distance between two places of the map.
        left: function from columns ``(K + R, d, n)`` to ``((K + R) d, n)`` and …
        half: … from its result to ``((K + R) d, n)``, such that leftᵀ half are the products of the columns with H⁻¹
            between them.
        ended: function from half columns to H⁻¹ of the columns ``(K + R, d, n)``.
        column_work: units of work per column.
    """

    num_edges: int
    above: np.ndarray
    below: np.ndarray
    share: np.ndarray
    bridge: np.ndarray
    num_blocks: int
    components: int
    turns: np.ndarray | None
    shifts: np.ndarray | None
    noise: PoseNoise
    good: int
    false: int
    extent: float
    left: Callable[[np.ndarray], np.ndarray]
    half: Callable[[np.ndarray], np.ndarray]
    ended: Callable[[np.ndarray], np.ndarray]
    column_work: float

    @property
    def num_nodes(self) -> int:
        """Nodes, N."""
        return len(self.above)

    @property
    def size(self) -> int:
        """Number of components of a node, d."""
        return 1 if self.turns is None or self.shifts is None else self.turns.shape[1] + self.shifts.shape[1]

    @classmethod
    def of_rotations(cls, mode: Mode) -> Linear:
        """From a labelling at its optimum."""
        problem, noise, factorised = mode.problem, mode.state.noise, mode.evaluation.factorised
        drawn = problem.drawn(noise)
        between = drawn.fraction * (1 - drawn.fraction) * drawn.length * noise.step_variance

        def left(columns: np.ndarray) -> np.ndarray:
            return columns[:, 0]

        def ended(solved: np.ndarray) -> np.ndarray:
            return solved[:, None]

        is_good = mode.state.is_good[problem.closure]
        return cls(
            len(drawn.segment_of_edge),
            drawn.above,
            drawn.below,
            np.stack((drawn.fraction, np.zeros(len(drawn.fraction)))),
            np.stack((between, np.zeros(len(between)))),
            factorised.system.size,
            problem.components,
            None,
            None,
            PoseNoise(noise.step_variance, noise.closure_variance, 0.0, 0.0, 0.0, 0.0, 0.0, noise.step_variance),
            int(is_good.sum()),
            int((~is_good).sum()),
            1.0,
            left,
            factorised.solve,
            ended,
            factorised.num_entries / _ENTRIES,
        )

    @classmethod
    def of_poses(cls, pose: PoseMode) -> Linear:
        """From a joint solve."""
        problem, solved, drawn = pose.problem, pose.solved, pose.problem.drawn
        # A single mean variance for all axes.
        turn = mean_turn(problem, pose.state.noise)
        closure = mean_closure_turn(problem, pose.state.noise)
        noise = replace(pose.state.noise, turn=turn, tilt=turn, closure_turn=closure).of_constant_times(
            mean_closure_shift(problem, pose.state.shape)
        )
        turns, shifts = problem.bases
        segment = problem.segment_of_node
        inside = segment >= 0
        whole = np.where(inside, noise.of_odometry(solved.way.travelled[np.maximum(segment, 0)]), 0.0)
        up_to = noise.of_odometry(solved.way.passed)
        passed = np.where(inside, up_to / np.maximum(whole, np.finfo(np.float64).tiny), 0.0)
        between = drawn.fraction * (1 - drawn.fraction) * drawn.length * noise.turn
        good = float(solved.places.right.sum())

        def half(begun: np.ndarray) -> np.ndarray:
            return begun

        return cls(
            len(drawn.segment_of_edge),
            drawn.above,
            drawn.below,
            np.stack((drawn.fraction, passed)),
            np.stack((between, passed * (1 - passed) * whole)),
            problem.equations.num_blocks,
            turns.shape[1],
            turns,
            shifts,
            noise,
            round(good),
            solved.places.chance.shape[1] - round(good),
            solved.scale.extent,
            solved.factor.begun,
            half,
            solved.factor.ended,
            _PASSED * solved.factor.num_entries / _ENTRIES,
        )
