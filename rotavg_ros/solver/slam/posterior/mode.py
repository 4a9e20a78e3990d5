"""A labelling at its optimum, and a proposal for another one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.slam.posterior.left_out import LeftOut, leave_one_out
from rotavg_ros.solver.slam.posterior.objective import Evaluation
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.state import State

# Noises count as different if the log ratio of a step's to a closure's variance differs by this.
OTHER_NOISE = 1.0
# Orientations count as the same within this many standard deviations of a closure.
_SAME = 3.0
# Covariances of up to this many closures are computed all at once.
_MAX_DENSE = 500


@dataclass(frozen=True)
class Mode:
    """A labelling at its optimum.

    Attributes:
        problem: the graph.
        state: labels, corrections, noise.
        evaluation: F and the factor there.
        origin: the start or move that found it.
    """

    problem: Problem
    state: State
    evaluation: Evaluation
    origin: str

    @property
    def cost(self) -> float:
        """F, nats."""
        return float(self.evaluation.total)

    @cached_property
    def labels(self) -> bytes:
        """A key that is equal for equal labels."""
        return np.packbits(self.state.is_good).tobytes()

    @property
    def key(self) -> tuple[bytes, tuple[float, ...], int]:
        """A key that is equal for equal labels with equal grid values and about the same ratio of variances."""
        noise = self.state.noise
        return self.labels, noise.chosen, round(noise.log_ratio / OTHER_NOISE)

    def is_like(self, other: State) -> bool:
        """Whether the labels of single closures alone differ, and orientations agree to within a closure's error.

        No slip may differ, nor two closures of one run.
        """
        odometry = self.problem.graph.is_odometry
        slips_alike = np.array_equal(self.state.is_good[odometry], other.is_good[odometry])
        return slips_alike and self.holds_like(other) and self.is_turned_like(other)

    def holds_like(self, other: State) -> bool:
        """Whether no run has two closures whose labels differ."""
        closure = self.problem.closure
        differs = self.state.is_good[closure] != other.is_good[closure]
        return bool(np.bincount(self.problem.run[differs]).max(initial=0) < 2)

    def is_turned_like(self, other: State) -> bool:
        """Whether orientations agree to within a closure's error."""
        cosine = np.abs((self.state.correction * other.correction).sum(axis=0)).min()
        return not self.is_turned_by(2 * np.arccos(min(float(cosine), 1.0)))

    def is_turned_by(self, angle: float) -> bool:
        """Whether a part that turns by ``angle``, rad, makes another answer: by more than a closure's error."""
        return bool(angle >= _SAME * np.sqrt(self.state.noise.closure_variance))

    @cached_property
    def is_false(self) -> np.ndarray:
        """``(C,)`` bool, closures labelled false."""
        return np.asarray(~self.state.is_good[self.problem.closure])

    @cached_property
    def left_out(self) -> LeftOut:
        """The prediction of every edge by the rest of the graph."""
        return leave_one_out(self.problem, self.state, self.evaluation.factorised)

    @cached_property
    def _covariance(self) -> np.ndarray:
        return self.evaluation.factorised.covariance(self.problem.closure)

    @property
    def covariance_is_cheap(self) -> bool:
        """Whether the closures are few enough for the covariance of all of them at once."""
        return len(self.problem.closure) <= _MAX_DENSE

    def covariance_of(self, members: np.ndarray) -> np.ndarray:
        """``(n, n)`` rad², covariance of the fitted values of some closures."""
        if self.covariance_is_cheap:
            return np.asarray(self._covariance[np.ix_(members, members)])
        return self.evaluation.factorised.covariance(self.problem.closure[members])

    @cached_property
    def slipped(self) -> np.ndarray:
        """Edges of odometry that slipped, along the path."""
        graph = self.problem.graph
        edges = np.flatnonzero(graph.is_odometry & ~self.state.is_good)
        return np.asarray(edges[np.argsort(graph.span[0, edges], kind="stable")])


@dataclass(frozen=True)
class Proposal:
    """A move that the search might try.

    Attributes:
        name: name of the move.
        predicted: predicted change of F, nats.
        slack: nats; the move is tried if F is predicted to rise by no more than this.
        make: function that makes the state to polish.
    """

    name: str
    predicted: float
    make: Callable[[], State]
    slack: float
