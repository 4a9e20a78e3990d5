"""Groups of closures that agree with each other, judged as one.

Closures that take one place for another (perceptual aliasing) confirm each other: each is what the others predict, the
odometry under them bends, and that it bends passes for drift. How many they are is no evidence, since one mistake makes
all of them. So a group of neighbouring closures that agree is judged as if it were one: by the rotation by which all of
it is off from what the rest of the graph predicts without it, if odometry drifts as it then does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components
from scipy.special import gammainccinv

from rotavg_ros.solver.slam.graph.agreement import AgreementPairs
from rotavg_ros.solver.slam.noise.judging import judge, tail_ratio
from rotavg_ros.solver.slam.passes.alternation import Passes
from rotavg_ros.solver.slam.passes.system import WholeSystem, leverage

# Closures belong to one group if they agree as well as all but so few good ones do, and if their ends are at most so
# many odometry steps apart, both ends summed. Groups can lie close to each other or be spread out, so all are tried.
_MAX_DISAGREEMENT = 0.003
_GAPS_STEPS = (10.0, 30.0, np.inf)
# Groups whose log-odds of being good are estimated to be below this are looked at, the worst of them.
_SUSPECT_LOG_ODDS = 1.0
_MAX_SUSPECTS = 32
# Without a group that is false the odometry must become likelier by so many nats, and by so many for each closure in
# it, since mistakes come to an end.
_MIN_GAIN = 10.0
_MIN_GAIN_PER_CLOSURE = 0.5
# Others are told in the same look only if they gain as much as such a part of the first; else they may only be bent.
_SHARE_OF_FIRST = 0.5


@dataclass(frozen=True)
class _Groups:
    """G groups of C closures.

    Attributes:
        member: ``(C, G)`` ±1 by the direction in which a member runs along the odometry, else 0.
        pull: ``(G, 3)`` how the residuals pull at a turn that all members have in common.
        information: ``(G,)`` rad⁻², what the members know of that turn.
    """

    member: csc_array
    pull: np.ndarray
    information: np.ndarray


def false_groups(state: Passes, system: WholeSystem, pairs: AgreementPairs) -> np.ndarray:
    """Believed closures ``(C,)`` bool that are false if each group of those that agree is judged as one.

    Args:
        state: after its passes have settled.
        pairs: neighbouring closures.
    """
    closure = np.flatnonzero(state.graph.is_closure)
    member = _members(state, pairs, closure)
    if member.shape[1] > 0:
        weight = system.factorised.weight[closure]
        pull = member.T @ (weight[:, None] * state.residual[closure])
        groups = _Groups(member, pull, abs(member).T @ weight)
        suspects = _suspects(state, system, groups, closure)
        if len(suspects):
            groups = _Groups(csc_array(member[:, suspects]), pull[suspects], groups.information[suspects])
            false = _false_ones(state, system, groups, closure)
            return np.asarray(abs(groups.member[:, false]).sum(axis=1) > 0)
    return np.zeros(len(closure), dtype=bool)


def _members(state: Passes, pairs: AgreementPairs, closure: np.ndarray) -> csc_array:
    """``(C, G)`` of :class:`_Groups`; groups of two closures and more."""
    graph, noise = state.graph, state.noise
    believed = (state.inlier_probability[closure] > 0.5) & np.isfinite(state.network_log_odds[closure])
    # A χ² quantile, of the squared angle over its variance.
    limit = 2 * gammainccinv(noise.components / 2, _MAX_DISAGREEMENT)
    variance = np.maximum(pairs.steps, 0.5) * noise.step_variance + 2 * noise.closure_variance
    agree = pairs.squared_angle < limit * variance
    agree &= believed[pairs.first] & believed[pairs.second]
    first, second, steps = pairs.first[agree], pairs.second[agree], pairs.steps[agree]
    direction = np.where(graph.position[graph.source] < graph.position[graph.target], 1.0, -1.0)[closure]
    count = len(closure)
    rows, columns, known = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)], np.zeros(count, dtype=np.int64)
    num_groups = 0
    for gap in _GAPS_STEPS:
        is_near = steps <= gap
        links = coo_array((np.ones(int(is_near.sum())), (first[is_near], second[is_near])), shape=(count, count))
        label = connected_components(links, directed=False)[1]
        size = np.bincount(label)[label]
        # A group that has not grown since the last gap is known.
        is_new = (size > 1) & (size > known)
        known = size
        new, number = np.unique(label[is_new], return_inverse=True)
        rows.append(np.flatnonzero(is_new))
        columns.append(num_groups + number)
        num_groups += len(new)
    row = np.concatenate(rows)
    return csc_array((direction[row], (row, np.concatenate(columns))), shape=(count, num_groups))


def _suspects(state: Passes, system: WholeSystem, groups: _Groups, closure: np.ndarray) -> np.ndarray:
    """Those that may be false, as far as samples tell: of what the members together do not know by themselves."""
    # Drawing the samples is what tells under which weights they are.
    samples, graph = system.samples, state.graph
    root = np.sqrt(system.sampled_weight[closure, None])
    difference = samples[graph.target[closure]] - samples[graph.source[closure]]
    unexplained = root * (root * difference - system.probes[closure])
    curvature = ((groups.member.T @ unexplained) ** 2).mean(axis=1)
    log_odds = _log_odds(state, groups.pull / curvature[:, None], curvature, groups.information, 1.0)
    order = np.argsort(log_odds, kind="stable")[:_MAX_SUSPECTS]
    return np.asarray(order[log_odds[order] < _SUSPECT_LOG_ODDS])


def _log_odds(
    state: Passes, turn: np.ndarray, curvature: np.ndarray, information: np.ndarray, drift: float
) -> np.ndarray:
    """Of groups ``(G,)`` to be good, judged like one closure each.

    Args:
        turn: ``(G, 3)`` rad, by how much each is off.
        curvature: ``(G,)`` rad⁻², how well that is known.
        drift: how much the odometry drifts (in variance), as a share of what was estimated.
    """
    square = np.minimum((turn**2).sum(axis=1), np.pi**2)
    prediction_variance = drift * np.maximum(1 / curvature - 1 / information, 0.0)
    own_variance = np.full(len(square), state.noise.closure_variance)
    return judge(state.noise, square, own_variance, prediction_variance, tail_ratio(own_variance)).log_odds


def if_turned(state: Passes, system: WholeSystem, member: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the edges give way ``(E, G)`` if groups ``(E, G)`` are turned by one, and the information on all turns.

    The information ``(G, G)``, rad⁻², is what is left of it when everything else has given way.
    """
    gives_way = state.difference(system.factorised.fit(member))
    return gives_way, (system.factorised.weight[:, None] * member).T @ (member - gives_way)


def _false_ones(state: Passes, system: WholeSystem, groups: _Groups, closure: np.ndarray) -> list[int]:
    """Groups that are false, those first without which the odometry becomes the likeliest (matching pursuit)."""
    odometry, weight = state.graph.is_odometry, system.factorised.weight
    member = np.zeros((len(weight), len(groups.information)))
    member[closure] = groups.member.toarray()
    gives_way, curvature = if_turned(state, system, member)
    overlaps = abs(member).T @ abs(member) > 0
    size = abs(member).sum(axis=0)
    root = np.sqrt(weight[odometry])[:, None]
    gives_way, residual = root * gives_way[odometry], root * state.residual[odometry]
    redundancy = float((1 - leverage(weight, system.prediction_variance))[odometry].sum())
    freedom = redundancy * state.noise.components
    before = square = float((residual**2).sum())
    false: list[int] = []
    first_gain = 0.0
    while True:
        best: tuple[float, int, float] | None = None
        for group in np.flatnonzero(~overlaps[false].any(axis=0)).tolist():
            freed = [*false, group]
            inverse = np.linalg.pinv(curvature[np.ix_(freed, freed)], hermitian=True)
            turn = inverse @ groups.pull[freed]
            after = float(((residual + gives_way[:, freed] @ turn) ** 2).sum())
            gain = freedom / 2 * np.log(square / after) - _MIN_GAIN_PER_CLOSURE * size[group]
            if gain < max(_MIN_GAIN, _SHARE_OF_FIRST * first_gain) or (best is not None and gain <= best[0]):
                continue
            known = np.array([1 / inverse[-1, -1]])
            log_odds = _log_odds(state, turn[-1:], known, groups.information[[group]], min(after / before, 1.0))
            if log_odds[0] < 0:
                best = gain, group, after
        if best is None:
            return false
        gain, group, square = best
        first_gain = max(first_gain, gain)
        false.append(group)
