"""The last answer, kept in the numbering of a graph that grows and is compacted meanwhile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rotavg_ros.online.answer.closure_queue import ClosureQueue
from rotavg_ros.online.answer.screening import Known
from rotavg_ros.online.compaction.renumbering import Renumbering
from rotavg_ros.online.compaction.thinning import Verdict


class LastAnswer:
    """What the last answer says of the graph's first n nodes and first m edges.

    Attributes:
        body_from_world: ``(n, 4)``; None before the first answer.
        component: ``(n,)``; None where it is not known.
        outlier: ``(m,)`` flags.
        waited: ``(m',)`` closures that it did not solve; their flags come from their residuals alone.
        known: what else it knows of these nodes; None before the first answer.
        queue: closures of the graph that wait to be solved.
    """

    def __init__(
        self,
        body_from_world: Tensor | None = None,
        component: Tensor | None = None,
        outlier: NDArray[np.bool_] | None = None,
        queued: NDArray[np.bool_] | None = None,
        known: Known | None = None,
    ) -> None:
        """Begin with what is known.

        Args:
            body_from_world, component, outlier, known: see above.
            queued: ``(M,)`` closures of the graph that wait; the other edges have entered.
        """
        self.body_from_world = body_from_world
        self.component = component
        self.outlier: NDArray[np.bool_] = np.zeros(0, dtype=bool) if outlier is None else outlier
        self.known = known
        self.queue = ClosureQueue() if queued is None else ClosureQueue(queued)
        self.waited = self.queue.waits
        self._since_problem: Renumbering | None = None

    @property
    def verdict(self) -> NDArray[np.int8]:
        """``(m,)`` :class:`Verdict` on each edge: what a compaction goes by."""
        verdict = np.where(self.outlier, Verdict.FALSE, Verdict.BELIEVED).astype(np.int8)
        # After a slip of odometry it is the good closures that contradict the answer and wait.
        waited = np.flatnonzero(self.waited[: len(verdict)])
        verdict[waited] = np.minimum(verdict[waited], Verdict.UNSOLVED)
        return verdict

    def begin_problem(self) -> None:
        """The next answer will be in the graph's present numbering."""
        self._since_problem = None

    def replace(self, body_from_world: Tensor, component: Tensor, outlier: NDArray[np.bool_], known: Known) -> None:
        """Take the answer to the last problem, of N nodes and M edges in the numbering of that time."""
        self.body_from_world, self.component, self.outlier, self.known = body_from_world, component, outlier, known
        if self._since_problem is not None:
            self._apply(self._since_problem)
        # The queue has been as the problem left it since then, and has followed compactions.
        self.waited = self.queue.waits

    def renumber(self, renumbering: Renumbering) -> None:
        """Follow a compaction of the graph."""
        earlier = self._since_problem
        self._since_problem = renumbering if earlier is None else earlier.then(renumbering)
        self.queue.renumber(renumbering)
        self.waited = renumbering.flags(self.waited)
        self._apply(renumbering)

    def _apply(self, renumbering: Renumbering) -> None:
        if self.body_from_world is not None:
            self.body_from_world = renumbering.nodes(self.body_from_world)
        if self.component is not None:
            self.component = renumbering.nodes(self.component)
        if self.known is not None:
            self.known = self.known.of_keyframes(renumbering.nodes)
        self.outlier = renumbering.flags(self.outlier)
