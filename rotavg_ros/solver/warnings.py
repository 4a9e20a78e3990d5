"""Reasons not to trust an answer, such as signs in measurements and answer that a convention was mistaken.

All functions are pure. They compare loop closures with the odometry between their ends, as stated and under a
hypothesis: rotations inverted, quaternions in another order. Only closures that the hypothesis turns by 30° or more
count: an identity is its own inverse and supports neither.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.residuals import angles_after_alignment, edge_residual
from rotavg_ros.solver.algebra.spanning_forest import (
    SpanningForest,
    accumulate_to_root,
    compose_orientations,
    shortest_path_forest,
)
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# The probability above which an edge counts as flagged.
_FLAGGED = 0.5
# Minimum number of closures for a warning that more than half of them are flagged.
_MIN_CLOSURES = 4
# Tolerances in degrees within which a closure agrees with a prediction: the noise that makes an edge of a robot's graph
# an outlier, and twice as much for odometry that drifts; and the minimum number of closures for each. Of fewer, more
# than half agree by chance with a probability above 3e-5 (in the plane, where random rotations agree with probability
# 1/18 or 1/9).
_TOLERANCES = ((10.0, 8), (20.0, 16))
_MIN_COMPARED = _TOLERANCES[0][1]
# False closures of one pair of places agree with each other, and so may all agree with a prediction by chance. So
# agreeing closures must join at least this many pairs of stretches, of this many odometry edges each.
_MIN_PLACES, _STRETCH = 3, 30
# A closure tells two readings apart if they differ by this many tolerances.
_TELLS = 3.0
# Maximum number of closures that are compared, those with the shortest ways along odometry.
_MAX_COMPARED = 200
# A hypothesis is reported if less than the first share agrees without it and more than the second with it. Random
# closures never reach the second; closures as stated fall below the first only if 70 % of them are wrong.
_SHARE_AS_STATED, _SHARE_OTHERWISE = 0.3, 0.6
# Among hypotheses whose shares differ by at most this factor, the first is reported.
_NEARLY = 0.9
# The median odometry edge turns by less than the first angle, rad, and by more than the second if the quaternion's
# order is mistaken: w = cos(θ/2) in x's place makes a turn by θ one by 180° - θ or more. With fewer edges than compared
# closures this is not decisive: one random rotation in seventeen looks like that.
_SMALL_STEP, _LARGE_STEP = math.radians(60.0), math.radians(120.0)
# Half angles in rad: below the first, an edge states no rotation, up to rounding; if the others' median is above the
# second, no real measurement would. The last is the share of such edges that is reported.
_NO_ROTATION, _SOME_ROTATION, _SHARE_OF_NOTHING = 1e-9, 0.01, 0.05
# Number of believed closures up to which all may be false together, and the angle from odometry's answer, rad, that
# counts as far.
_FEW_BELIEVED, _FAR = 10, math.radians(30.0)


def mostly_flagged(
    graph: ViewGraph, outlier_score: Tensor, rotation_score: Tensor | None = None, restated: Tensor | None = None
) -> tuple[str, ...]:
    """Warns if more than half of the loop closures (without odometry: of the edges) are flagged, labelled ones aside.

    Args:
        graph: on the CPU, M edges.
        outlier_score: ``(M,)``.
        rotation_score: ``(M,)`` likewise, for the rotations alone; None: places are not judged.
        restated: ``(n,)`` edges that were not judged, since they are made of others.
    """
    judged = ~graph.is_odometry & (graph.label == EdgeLabel.AUTOMATIC)
    if restated is not None:
        judged[restated] = False
    is_flagged = judged & (outlier_score > _FLAGGED)
    closures, flagged = int(judged.sum()), int(is_flagged.sum())
    if closures < _MIN_CLOSURES or 2 * flagged <= closures:
        return ()
    by_place = 0 if rotation_score is None else int((is_flagged & (rotation_score <= _FLAGGED)).sum())
    if 2 * by_place > flagged:
        return (
            f"{flagged} of {closures} loop closures are flagged as false, {by_place} of them only because they join "
            "wrong places; if translations are not in metres, or not in the frame of their edge's source, correct them "
            "or set translation_scale to none; if the odometry's position jumped somewhere, leave that edge out; "
            "otherwise the front end may match wrong places",
        )
    if not bool(graph.is_odometry.any()):
        return (
            f"{flagged} of {closures} edges are flagged as false; different places may look alike, or some rotations "
            "may be stated from target to source: compare some of these edges with the pictures by hand",
        )
    return (
        f"{flagged} of {closures} loop closures are flagged as false; the front end may match wrong places, or the "
        "direction, the sensor's mounting or the clock may be wrong for all of them: check that each edge's rotation "
        "is the target's orientation in the source's frame, and compare some closures with the odometry by hand",
    )


def accepted_far_off(graph: ViewGraph, body_from_world: Tensor, outlier_angle: float) -> tuple[str, ...]:
    """Warns of edges that the user has accepted, and that are more than ``outlier_angle`` rad off in the answer.

    Args:
        graph: on the CPU, N nodes.
        body_from_world: ``(N, 4)`` the answer.
    """
    accepted = graph.select_edges(graph.label == EdgeLabel.ACCEPTED)
    if accepted.num_edges == 0:
        return ()
    residual = edge_residual(body_from_world, accepted.target_from_source, accepted.source, accepted.target)
    angle = rotations.angle(residual)
    far = int((angle > outlier_angle).sum())
    if far == 0:
        return ()
    return (
        f"{far} of {accepted.num_edges} accepted edges are more than {math.degrees(outlier_angle):.0f}° off in the "
        f"answer, up to {math.degrees(float(angle.max())):.0f}°; they contradict each other, or the method does "
        "not keep to labels: check which of them are right",
    )


def stating_nothing(graph: ViewGraph) -> tuple[str, ...]:
    """Warns if many edges of a graph without odometry state exactly no rotation, as some front ends do on failure.

    Rigs of parallel cameras state this, too, but each only between a few cameras of its own.

    Args:
        graph: on the CPU, N nodes, M edges.
    """
    sine = graph.target_from_source[:, :3].norm(dim=1)
    is_identity = sine < _NO_ROTATION
    count = int(is_identity.sum())
    if bool(graph.is_odometry.any()) or count < _SHARE_OF_NOTHING * graph.num_edges or bool(is_identity.all()):
        return ()
    touched = torch.unique(torch.cat((graph.source[is_identity], graph.target[is_identity])))
    if count <= len(touched) or float(sine[~is_identity].median()) < _SOME_ROTATION:
        return ()
    return (
        f"{count} of {graph.num_edges} edges state exactly no rotation; they agree with each other, and so make "
        "orientations alike: if the front end writes such edges where it found no match, leave them out",
    )


def of_whole_solve(graph: ViewGraph, body_from_world: Tensor, outlier_score: Tensor) -> tuple[str, ...]:
    """Further checks of a solve of a robot's graph from scratch.

    Args:
        graph: on the CPU, N nodes, M edges.
        body_from_world: ``(N, 4)`` the answer, in any gauge.
        outlier_score: ``(M,)``.
    """
    closures = ~graph.is_odometry & (graph.label != EdgeLabel.REJECTED)
    if not bool(graph.is_odometry.any()):
        return ()
    odometry = _Odometry.of(graph)
    found = [_mistaken_convention(odometry, graph.select_edges(closures.nonzero()[:, 0])), _gaps_of_places(graph)]
    believed = int((closures & (outlier_score <= _FLAGGED)).sum())
    if 0 < believed < _FEW_BELIEVED and bool((graph.components() == odometry.component).all()):
        found.append(_far_from_odometry(odometry, body_from_world, believed))
    return tuple(text for text in found if text is not None)


def _gaps_of_places(graph: ViewGraph) -> str | None:
    """Warns if translations of some odometry are unknown, so that none can be used."""
    if graph.translation is None:
        return None
    known, odometry = graph.translation.isfinite().all(dim=1), graph.is_odometry
    num_known, num_odometry = int((known & odometry).sum()), int(odometry.sum())
    if not 0 < num_known < num_odometry or not bool((known & ~odometry).any()):
        return None
    return (
        f"{num_odometry - num_known} of {num_odometry} odometry edges have no translation, so closures are judged by "
        "their rotations alone, and one that joins wrong places may be believed; the odometry of every robot must "
        "state its position throughout"
    )


def _far_from_odometry(odometry: _Odometry, body_from_world: Tensor, believed: int) -> str | None:
    component = odometry.component
    apart = angles_after_alignment(odometry.orientation, body_from_world, component, int(component.max()) + 1)
    angle = float(apart.mean())
    if angle <= _FAR:
        return None
    count = "1 believed loop closure turns" if believed == 1 else f"{believed} believed loop closures turn"
    return (
        f"{count} the orientations away from odometry's by {math.degrees(angle):.0f}° on average; so few closures may "
        "all be false: look at them, label those that are wrong, or compare with odometry alone"
    )


# Maps quaternions as stored, target_from_source ``(n, 4)``, to their reading under a hypothesis.
_Reading = Callable[[Tensor], Tensor]


def _as_stated(quaternions: Tensor) -> Tensor:
    return quaternions


def _reordered(quaternions: Tensor) -> Tensor:
    """Corrects (w, x, y, z) that was taken for (x, y, z, w)."""
    return quaternions[:, [1, 2, 3, 0]]


def _inversely_reordered(quaternions: Tensor) -> Tensor:
    """The same if the file or message holds the inverse of what is stored."""
    return rotations.inverse(_reordered(rotations.inverse(quaternions)))


class _Hypothesis(NamedTuple):
    """A reading of rotations, and the edges to which it applies."""

    odometry: _Reading
    closures: _Reading
    whose: str
    is_order: bool


_INVERTED = _Hypothesis(_as_stated, rotations.inverse, "the closures'", False)
_OR_THOSE = "they (or the odometry's instead, if all turn about one axis)"
_CLOSURES_REORDERED = (
    _Hypothesis(_as_stated, _inversely_reordered, "the closures'", True),
    _Hypothesis(_as_stated, _reordered, "the closures'", True),
)
# If all are reordered, it makes no difference whether the inverse was written, up to half a turn of the world about z.
_ODOMETRY_REORDERED = (
    _Hypothesis(_inversely_reordered, _inversely_reordered, "all", True),
    _Hypothesis(_inversely_reordered, _as_stated, "the odometry's", True),
)
# In the plane, inverting all changes no agreement, and inverting odometry is equivalent to inverting closures.
_ODOMETRY_INVERTED = (
    _Hypothesis(rotations.inverse, _as_stated, "the odometry's", False),
    _Hypothesis(rotations.inverse, rotations.inverse, "all", False),
)


class _Agreement(NamedTuple):
    """Numbers of closures compared, agreeing within ``degrees`` as stated, and agreeing under a hypothesis.

    The last join ``places`` pairs of stretches.
    """

    hypothesis: _Hypothesis
    degrees: float
    compared: int
    as_stated: int
    otherwise: int
    places: int

    @property
    def is_striking(self) -> bool:
        return (
            self.compared >= dict(_TOLERANCES)[self.degrees]
            and self.as_stated < _SHARE_AS_STATED * self.compared
            and self.otherwise > _SHARE_OTHERWISE * self.compared
            and self.places >= _MIN_PLACES
        )

    @property
    def share(self) -> float:
        """Share of the compared closures that agree under the hypothesis."""
        return self.otherwise / self.compared

    def __str__(self) -> str:
        whose = self.hypothesis.whose
        changed = "in the order w, x, y, z" if self.hypothesis.is_order else "inverted"
        return (
            f"{self.as_stated} of {self.compared} loop closures agree with the odometry between their ends within "
            f"{self.degrees:.0f}°, and {self.otherwise} would with {whose} rotations {changed}"
        )


@dataclass(frozen=True)
class _Odometry:
    """The odometry edges of a graph that are not labelled as rejected.

    Attributes:
        graph: all nodes, and these edges only.
        forest: spanning forest with the fewest edges to each root.
    """

    graph: ViewGraph
    forest: SpanningForest

    @classmethod
    def of(cls, graph: ViewGraph) -> _Odometry:
        usable = graph.is_odometry & (graph.label != EdgeLabel.REJECTED)
        alone = graph.select_edges(usable.nonzero()[:, 0])
        return cls(alone, shortest_path_forest(alone, root="first"))

    @property
    def component(self) -> Tensor:
        """``(N,)`` components that odometry alone connects, numbered by first node."""
        return torch.from_numpy(self.forest.component)

    def level(self) -> Tensor:
        """``(N,)`` number of edges from the root: path lengths along a chain are differences of these."""
        return torch.from_numpy(accumulate_to_root(self.forest, (self.forest.parent_edge >= 0) * 1.0))

    def median_angle(self, reading: _Reading) -> float:
        """Median angle of its edges, in radians."""
        cosine = reading(self.graph.target_from_source)[:, 3].abs()
        return 2 * math.acos(min(float(cosine.median()), 1.0)) if len(cosine) else 0.0

    @cached_property
    def orientation(self) -> Tensor:
        """``(N, 4)`` body_from_world composed along it."""
        return compose_orientations(self.forest, self.graph)

    def read_as(self, reading: _Reading) -> Tensor:
        """The same under another reading."""
        if reading is _as_stated:
            return self.orientation
        read = reading(self.graph.target_from_source)
        return compose_orientations(self.forest, replace(self.graph, target_from_source=read))


def _mistaken_convention(odometry: _Odometry, closures: ViewGraph) -> str | None:
    """Warns of inverted rotations or another order of quaternions, in the closures, the odometry or both."""
    tells = odometry.component[closures.source] == odometry.component[closures.target]
    closures = closures.select_edges(tells.nonzero()[:, 0])
    stated, reordered = (odometry.median_angle(reading) for reading in (_as_stated, _reordered))
    is_enough = odometry.graph.num_edges >= _MIN_COMPARED
    is_reordered = is_enough and stated > _LARGE_STEP and reordered < _SMALL_STEP
    agreements = []
    if closures.num_edges >= _MIN_COMPARED:
        agreements = list(_agreements(odometry, closures, is_reordered))
    most = max((agreement.share for agreement in agreements), default=0.0)
    best = next((agreement for agreement in agreements if agreement.share >= _NEARLY * most), None)
    order = "w, x, y, z may have been written where x, y, z, w is read: write x, y, z, w"
    if is_reordered:
        whose = "their" if best is None else best.hypothesis.whose
        return (
            f"the median odometry edge turns by {math.degrees(stated):.0f}°, and would turn by "
            f"{math.degrees(reordered):.0f}° with {whose} quaternions in the order w, x, y, z; {order}"
        )
    if best is None:
        return None
    if best.hypothesis.is_order:
        return f"{best}; {order}"
    return (
        f"{best}; {_OR_THOSE if best.hypothesis == _INVERTED else 'they'} may state the source's orientation in the "
        "target's frame, but the target's in the source's frame is read: invert them; or, if their translations "
        "say the same, swap source and target of these edges"
    )


def _agreements(odometry: _Odometry, closures: ViewGraph, is_reordered: bool) -> Iterator[_Agreement]:
    """Striking agreements. Inversion turns only some closures; readings that turn all are tried only if few agree."""
    level = odometry.level()
    nearest = (level[closures.source] - level[closures.target]).abs().argsort(stable=True)
    closures = closures.select_edges(nearest)
    ends = torch.stack((level[closures.source], level[closures.target])).sort(dim=0)[0] // _STRETCH
    stated = _errors(odometry.orientation, closures, _as_stated)
    angle_as_stated = torch.rad2deg(rotations.angle(stated))
    if not is_reordered and int((angle_as_stated > _TOLERANCES[0][0]).sum()) <= _SHARE_OTHERWISE * _MIN_COMPARED:
        return
    hypotheses: tuple[_Hypothesis, ...] = (_INVERTED,)
    if is_reordered:
        hypotheses = _ODOMETRY_REORDERED
    elif bool((angle_as_stated[:_MAX_COMPARED] < _TOLERANCES[0][0]).double().mean() < _SHARE_AS_STATED):
        hypotheses = (_INVERTED, *_CLOSURES_REORDERED, *_ODOMETRY_INVERTED)
        # In another order, odometry that turns little would turn by half a turn at every edge.
        if odometry.median_angle(_reordered) < _LARGE_STEP:
            hypotheses = (*hypotheses, *_ODOMETRY_REORDERED)
    composed = {reading: odometry.read_as(reading) for reading in {hypothesis.odometry for hypothesis in hypotheses}}
    for hypothesis in hypotheses:
        errors = _errors(composed[hypothesis.odometry], closures, hypothesis.closures)
        angle, apart = (
            torch.rad2deg(value) for value in (rotations.angle(errors), rotations.angle_between(stated, errors))
        )
        for degrees, _ in _TOLERANCES:
            tells = (apart > _TELLS * degrees).nonzero()[:_MAX_COMPARED, 0]
            as_stated = int((angle_as_stated[tells] < degrees).sum())
            agree = tells[angle[tells] < degrees]
            places = np.unique(ends[:, agree].numpy(), axis=1).shape[1]
            agreement = _Agreement(hypothesis, degrees, len(tells), as_stated, len(agree), places)
            if agreement.is_striking:
                yield agreement


def _errors(orientation: Tensor, closures: ViewGraph, reading: _Reading) -> Tensor:
    """``(n, 4)`` closures' residuals under orientations ``(N, 4)``."""
    measured = reading(closures.target_from_source)
    return edge_residual(orientation, measured, closures.source, closures.target)
