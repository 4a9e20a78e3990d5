"""A lone slip seen by closures between one pair of places cannot be told from closures that are false together.

Whoever is asked cannot know which it was. So over an even mixture of both a score should be one half, and a stated
uncertainty should cover both truths.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch

from rotavg_ros.datasets.simulation.stress.kinds import ONE_PAIR
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import Case
from rotavg_ros.evaluation.common.tables import Cell, Column, Table
from rotavg_ros.evaluation.slam.stress_calibration import UNSURE, Statements, Watcher, statements
from rotavg_ros.metrics import CalibrationBins
from rotavg_ros.rotations import inverse, multiply


def if_false(case: Case) -> Case:
    """The same measurements of a lone slip, made by sound odometry and by closures that are false.

    What follows the slip is turned by it, so that the step is exact. Closures across it, its witnesses, are off by as
    much then, all others as they were.

    Args:
        case: one step of its odometry slipped.
    """
    graph, truth = case.graph, case.truth
    (edge,) = torch.nonzero(graph.is_odometry & (case.noise > case.family.undecided[1]))
    ends = torch.cat((graph.source[edge], graph.target[edge]))
    measured = graph.target_from_source[edge]
    if ends[0] > ends[1]:
        ends, measured = ends.flip(0), inverse(measured)
    before, after = truth[ends[:1]], truth[ends[1:]]
    turn = multiply(inverse(after), multiply(measured, before))
    follows = (torch.arange(graph.num_nodes) > ends[0])[:, None]
    return replace(case, truth=torch.where(follows, multiply(truth, turn), truth), intact=None, true_precision=None)


@dataclass
class Mixture:
    """What answers state of graphs that may be either, each counted once as either.

    Attributes:
        num_graphs: how many.
        num_witnesses: closures across the slips.
        num_sure: of them, of scores outside of :data:`UNSURE`.
        score_sum: of their scores.
        scores: of them, and whether they are false.
        if_slipped, if_false: what all of the graph is stated to be, against either truth.
    """

    num_graphs: int = 0
    num_witnesses: int = 0
    num_sure: int = 0
    score_sum: float = 0.0
    scores: CalibrationBins = field(default_factory=CalibrationBins)
    if_slipped: Statements = field(default_factory=Statements)
    if_false: Statements = field(default_factory=Statements)

    def add(self, case: Case, answer: Answer) -> None:
        """Count a graph."""
        other = if_false(case)
        witnesses = case.is_closure & other.is_false
        assert answer.outlier_score is not None
        score = answer.outlier_score[witnesses]
        self.num_graphs += 1
        self.num_witnesses += len(score)
        self.num_sure += int(((score < UNSURE[0]) | (score > UNSURE[1])).sum())
        self.score_sum += float(score.sum())
        self.scores.add(score.repeat(2), torch.arange(2).repeat_interleave(len(score)) == 1)
        self.if_slipped.extend(statements(case, answer))
        self.if_false.extend(statements(other, answer))

    def extend(self, other: Mixture) -> None:
        """Add the counts of another."""
        self.num_graphs += other.num_graphs
        self.num_witnesses += other.num_witnesses
        self.num_sure += other.num_sure
        self.score_sum += other.score_sum
        self.scores.extend(other.scores)
        self.if_slipped.extend(other.if_slipped)
        self.if_false.extend(other.if_false)


class SameData(Watcher[Mixture]):
    """Counts what is stated of lone slips that one pair of places tells of."""

    def __init__(self) -> None:
        super().__init__(Mixture, _mixture)


def _mixture(case: Case, answer: Answer) -> Mixture | None:
    if ONE_PAIR not in case.key.kind or answer.outlier_score is None:
        return None
    mixture = Mixture()
    mixture.add(case, answer)
    return mixture


def table(title: str, of_kinds: dict[str, Mixture]) -> Table:
    """All kinds together, and each."""
    total = Mixture()
    for found in of_kinds.values():
        total.extend(found)
    columns = (
        Column("kind"),
        Column("graphs", "d"),
        Column("mean score of witnesses", ".3f"),
        Column("of these sure", ".3f"),
        Column("ECE, each once false and once good", ".3f"),
        Column("within 2σ if odometry slipped", ".3f"),
        Column("within 2σ if they are false", ".3f"),
    )
    low, high = UNSURE
    note = (
        "One slip that closures of one pair of places tell of is the same data as sound odometry and closures that are "
        f"false together: nobody can know. Sure: scores outside of {low:g}–{high:g}. One half would be right, and an "
        "uncertainty that covers either truth."
    )
    rows = [_row("all", total), *(_row(kind, found) for kind, found in of_kinds.items())]
    return Table(title, columns, tuple(rows), (note,))


def _row(name: str, found: Mixture) -> tuple[Cell, ...]:
    within = (each.within_two / max(each.num_errors, 1) for each in (found.if_slipped, found.if_false))
    count = max(found.num_witnesses, 1)
    return (name, found.num_graphs, found.score_sum / count, found.num_sure / count, found.scores.error, *within)
