"""F against integrals computed independently and densely, and against its own leave-one-out odds."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import fields, replace
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logsumexp
from scipy.stats import multivariate_normal

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.running.work import metered
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.noise.repeats import Repeats
from rotavg_ros.solver.slam.posterior.bias import Bias
from rotavg_ros.solver.slam.posterior.densities import Sites, log_false, log_good, log_normal
from rotavg_ros.solver.slam.posterior.em import polish, step
from rotavg_ros.solver.slam.posterior.labels import (
    FalseDensity,
    false_density,
    label_log_odds,
    log_false_set,
    log_label_prior,
    log_slip_prior,
    repeat_rates,
)
from rotavg_ros.solver.slam.posterior.left_out import leave_one_out
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.moves.flips import flipped
from rotavg_ros.solver.slam.posterior.moves.noise import tuned
from rotavg_ros.solver.slam.posterior.objective import evaluate
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import with_noise
from rotavg_ros.solver.slam.posterior.state import RUN_STEPS, Noise, Others, State
from rotavg_ros.solver.slam.preparation import prepare_as_it_is
from rotavg_ros.view_graph import ViewGraph

# Gaussian where a mixture would be integrated approximately only.
_PRIORS = replace(SlamPriors(), near_miss_share=1e-12)
_NOISE = Noise(np.radians(1.0) ** 2, np.radians(1.5) ** 2, 0.0, 0.4, RUN_STEPS[-1], step_tails=0.0, closure_tails=0.0)


def _yaw(angle: np.ndarray) -> np.ndarray:
    return np.stack((np.zeros_like(angle), np.zeros_like(angle), np.sin(angle / 2), np.cos(angle / 2)), axis=1)


def _planar(seed: int, num_closures: int, false_share: float, length: int = 60) -> tuple[ViewGraph, np.ndarray]:
    """A planar chain with closures, some of them wrong by up to 40°; returns the graph and what closures are off by."""
    rng = np.random.default_rng(seed)
    older = rng.integers(0, length // 2, num_closures)
    newer = older + rng.integers(length // 4, length // 2, num_closures)
    # Two closures of a run, so that common errors count.
    older[1], newer[1] = older[0] + 1, newer[0] + 2
    off = np.where(rng.random(num_closures) < false_share, rng.uniform(-0.7, 0.7, num_closures), 0.0)
    noise = off + rng.normal(size=num_closures) * np.radians(1.5)
    odometry = rng.normal(size=length - 1) * np.radians(1.0)
    graph = ViewGraph.create(
        np.concatenate((np.arange(length - 1), older)),
        np.concatenate((np.arange(1, length), newer)),
        _yaw(np.concatenate((odometry, noise))),
        num_nodes=length,
        kind=[0] * (length - 1) + [1] * num_closures,
    )
    return graph, off


def _problem(
    graph: ViewGraph, priors: SlamPriors = _PRIORS, without: Collection[str] = (), rate: float | None = None
) -> Problem:
    """A problem whose network has no opinion, after a bias of ``rate`` about z, rad per step, was taken out."""
    vector = np.array([0.0, 0.0, rate or 0.0])
    corrected = without_bias(graph, vector)
    prepared = prepare_as_it_is(corrected)
    bias = None if rate is None else Bias.of(corrected, prepared, vector)
    turned = np.arange(graph.num_nodes) ** 2.0
    no_opinion = np.zeros(len(prepared.closure_graph.source))
    return Problem.of(prepared, no_opinion, priors=priors, without=without, bias=bias, turned=turned)


def _tuned(problem: Problem) -> set[str]:
    """Names of what other values are looked at of."""
    state, evaluation = polish(problem, _state(problem, np.zeros(len(problem.closure), dtype=bool)))
    mode = Mode(problem, state, evaluation, "test")
    names = [field.name for field in fields(Noise)]
    return {
        name
        for other in tuned(mode)
        for name in names
        if getattr(other.state.noise, name) != getattr(state.noise, name)
    }


def _state(problem: Problem, is_false: np.ndarray) -> State:
    trusted = np.ones(len(problem.graph.source))
    trusted[problem.closure[is_false]] = 0.0
    correction = np.zeros((4, problem.graph.num_nodes))
    correction[3] = 1.0
    return State(
        correction, np.zeros((problem.system(_NOISE).num_runs, 3)), trusted, _NOISE, Others.before_any(len(trusted))
    )


def _log_evidence(problem: Problem, is_false: np.ndarray, bias_deg: float = 0.0) -> float:
    """Of the data given labels: the good closures' residuals are jointly normal, by what they pass and share."""
    measured = problem.measured[:, problem.closure]
    discrepancy = 2 * np.arctan2(measured[2], measured[3]) * problem.sign
    older, newer = problem.ends.T
    passed = np.maximum(np.minimum(newer[:, None], newer) - np.maximum(older[:, None], older), 0.0)
    shared = problem.system(_NOISE).shared[problem.closure]
    common = (problem.run[:, None] == problem.run) & shared[:, None] & shared
    own = np.where(shared, 1 - _NOISE.common_share, 1.0) * _NOISE.closure_variance
    covariance = passed * _NOISE.step_variance + common * _NOISE.common_share * _NOISE.closure_variance + np.diag(own)
    covariance += np.radians(bias_deg) ** 2 * (newer - older)[:, None] * (newer - older)
    good = ~is_false
    if not good.any():
        return 0.0
    normal = multivariate_normal(np.zeros(int(good.sum())), covariance[np.ix_(good, good)], allow_singular=True)
    return float(normal.logpdf(discrepancy[good]))


@pytest.mark.parametrize("seed", range(4))
def test_marginals_are_those_of_dense_integrals(seed: int) -> None:
    graph, _ = _planar(seed, 7, 0.4)
    problem = _problem(graph)
    labels = [np.array(bits) for bits in product([False, True], repeat=len(problem.closure))]
    by_f, densely = [], []
    for is_false in labels:
        _, evaluation = polish(problem, _state(problem, is_false), hold_noise=True)
        by_f.append(-evaluation.total)
        # What false closures contribute is a density by itself; the integral over orientations is what is checked.
        densely.append(
            _log_evidence(problem, is_false) - evaluation.terms["false closures"] - evaluation.terms["labels"]
        )
    is_false = np.stack(labels)
    marginals = [(np.exp(np.array(log) - logsumexp(log))[:, None] * is_false).sum(axis=0) for log in (by_f, densely)]
    np.testing.assert_allclose(marginals[0], marginals[1], atol=0.01)
    assert marginals[0].max() > 0.02 and marginals[0].min() < 0.98


def _log_evidence_of_tails(problem: Problem, noise: Noise) -> float:
    """The same of good closures by themselves, summed over which segments and which closures are in the tails."""
    graph, closure = problem.graph, problem.closure
    discrepancy = (2 * np.arctan2(problem.measured[2], problem.measured[3]))[closure] * problem.sign
    segment = np.flatnonzero(graph.is_odometry)
    ends = np.sort(np.stack((graph.position[graph.source[segment]], graph.position[graph.target[segment]])), axis=0)
    older, newer = problem.ends.T
    across = ((ends[0] >= older[:, None] - 1e-9) & (ends[1] <= newer[:, None] + 1e-9)).astype(np.float64)
    segment, across = segment[across.any(axis=0)], across[:, across.any(axis=0)]
    variance = np.append(graph.own_steps[segment] * noise.step_variance, np.full(len(closure), noise.closure_variance))
    share = np.append(np.full(len(segment), noise.step_tails), np.full(len(closure), noise.closure_tails))
    design = np.hstack((across, np.eye(len(closure))))
    logs = []
    for tail in map(np.array, product([False, True], repeat=len(variance))):
        inflated = variance * np.where(tail, problem.priors.tail_ratio, 1.0)
        normal = multivariate_normal(np.zeros(len(closure)), (design * inflated) @ design.T)
        with np.errstate(divide="ignore"):
            logs.append(normal.logpdf(discrepancy) + np.log(np.where(tail, share, 1 - share)).sum())
    return float(logsumexp(logs))


@pytest.mark.parametrize("seed", range(6))
def test_tails_have_the_evidence_of_the_sum_over_what_is_in_them(seed: int) -> None:
    graph, _ = _planar(seed, 4, 0.0, length=40)
    problem = _problem(graph)
    state = _state(problem, np.zeros(4, dtype=bool))
    by_f, exactly = [], []
    for share in (0.0, 0.1):
        noise = replace(_NOISE, run_steps=0.0, step_tails=share, closure_tails=share)
        _, evaluation = polish(problem, with_noise(problem, state, noise), hold_noise=True)
        terms = evaluation.terms
        by_f.append(terms["odometry"] + terms["good closures"] + terms["orientations"])
        exactly.append(-_log_evidence_of_tails(problem, noise))
    assert by_f[1] - by_f[0] == pytest.approx(exactly[1] - exactly[0], abs=0.1)
    # Laplace's method is off by 0.3 to 1.2 nats here.
    assert abs(exactly[1] - exactly[0]) > 0.15


@pytest.mark.parametrize(("predicted", "told"), [(1e-9, "all"), (1e9, "nothing")])
def test_a_site_is_the_mean_precision_where_all_is_told_and_the_mean_variance_where_nothing_is(
    predicted: float, told: str
) -> None:
    variance, ratio, share = np.array([0.5, 2.0]), 16.0, 0.1
    site = Sites.of(np.zeros(2), variance, np.full(2, predicted), 3, np.full(2, share), ratio)
    exact = log_good(np.zeros(2), variance, np.full(2, predicted), 3, np.full(2, share), ratio)[1]
    mean_precision = (exact + (1 - exact) / ratio) / variance
    mean_variance = (exact + (1 - exact) * ratio) * variance
    np.testing.assert_allclose(site.weight, mean_precision if told == "all" else 1 / mean_variance, rtol=1e-6)


@given(st.floats(0.0, 9.0), st.floats(1e-6, 1.0), st.floats(0.0, 10.0), st.sampled_from([1, 3]), st.floats(0.0, 0.99))
def test_a_site_gives_a_residual_the_mean_that_its_mixture_has(
    square: float, variance: float, predicted: float, components: int, share: float
) -> None:
    """Against Bayes' rule for each variance by itself."""
    one = np.ones(1)
    site = Sites.of(square * one, variance * one, predicted * one, components, share * one, 16.0)
    variances = np.array([variance, 16.0 * variance])
    with np.errstate(divide="ignore"):
        log_chance = np.log([1 - share, share]) + log_normal(square, variances + predicted, components)
    chance = np.exp(log_chance - logsumexp(log_chance))
    expected = (chance * variances / (variances + predicted)).sum()
    assert 1 / (1 + site.weight[0] * predicted) == pytest.approx(expected, rel=1e-6)
    assert 1 / (16 * variance) * (1 - 1e-9) <= site.weight[0] <= 1 / variance * (1 + 1e-9)


@pytest.mark.parametrize("chance", [0.0, 0.1, 0.4, 0.9, 1.0])
def test_an_undecided_closure_turns_by_its_chance_what_it_would_turn_as_a_good_one(chance: float) -> None:
    """One closure on a long chain: with a weight that is its chance alone one in ten would turn nearly as much."""
    count = 40
    source, target = np.append(np.arange(count), 0), np.arange(1, count + 2)
    target[-1] = count
    angle = np.append(np.zeros(count), 0.3)
    graph = ViewGraph.create(source, target, _yaw(angle), num_nodes=count + 1, kind=[0] * count + [1])
    problem = _problem(graph)
    state = _state(problem, np.array([False]))

    def turned(trust: float) -> float:
        trusted = state.trusted.copy()
        trusted[problem.closure] = trust
        # What others say is known after the first step.
        once = step(problem, replace(state, trusted=trusted))[0]
        return float(quaternion_rows.log(step(problem, once)[0].correction)[2, -1])

    assert abs(turned(1.0)) > 0.2
    # 48 samples tell the variance of what the chain predicts to about a fifth.
    assert turned(chance) == pytest.approx(chance * turned(1.0), rel=0.25, abs=1e-9)


@pytest.mark.parametrize(("seed", "planted_deg"), [(0, 0.0), (1, 0.05), (2, -0.3), (3, 1.0)])
def test_a_bias_has_the_evidence_of_a_dense_integral(seed: int, planted_deg: float) -> None:
    graph, _ = _planar(seed, 8, 0.0, length=40)
    graph = without_bias(graph, np.radians([0.0, 0.0, -planted_deg]))
    good = np.zeros(8, dtype=bool)
    plain = _problem(graph)
    _, before = polish(plain, _state(plain, good), hold_noise=True)
    rate, totals = 0.0, []
    for _ in range(3):
        problem = _problem(graph, rate=rate)
        state, after = polish(problem, _state(problem, good), hold_noise=True)
        assert problem.bias is not None
        information, change = problem.bias.information(
            problem.graph.source, state, after.residual, after.factorised, _PRIORS
        )
        # What F falls by until the likeliest bias is known from wherever it is looked for.
        totals.append(after.total - float(change @ information @ change) / 2)
        rate += float((change @ problem.bias.axes)[2])
    densely = _log_evidence(plain, good, _PRIORS.bias_deg) - _log_evidence(plain, good)
    assert before.total - totals[-1] == pytest.approx(densely, abs=0.02)
    np.testing.assert_allclose(totals, totals[-1], atol=0.02)
    # Forty steps of 1° tell it to 0.16°.
    assert abs(np.degrees(rate) - planted_deg) < 0.5


@pytest.mark.parametrize("seed", range(6))
def test_a_flip_changes_f_by_the_leave_one_out_log_odds(seed: int) -> None:
    graph, _ = _planar(seed, 10, 0.0)
    problem = _problem(graph)
    good = np.zeros(len(problem.closure), dtype=bool)
    state, before = polish(problem, _state(problem, good), hold_noise=True)
    exact = np.diag(before.factorised.covariance(problem.closure))
    before.factorised.resistance[problem.closure] = exact
    log_odds = leave_one_out(problem, state, before.factorised).log_odds[problem.closure]
    for number in range(len(problem.closure)):
        flipped = good.copy()
        flipped[number] = True
        _, after = polish(problem, _state(problem, flipped), hold_noise=True)
        assert after.total - before.total == pytest.approx(log_odds[number], abs=0.02)


@pytest.mark.parametrize("seed", range(5))
def test_prior_log_odds_of_labels_are_differences_of_their_prior(seed: int) -> None:
    graph, _ = _planar(seed, 10, 0.0)
    problem = _problem(graph)
    is_false = np.random.default_rng(seed).random(len(problem.closure)) < 0.5
    log_odds = label_log_odds(problem, is_false)
    for number in range(len(is_false)):
        with_label = []
        for value in (False, True):
            changed = is_false.copy()
            changed[number] = value
            with_label.append(log_label_prior(problem, changed))
        assert log_odds[number] == pytest.approx(with_label[0] - with_label[1], abs=1e-9)


def test_closures_that_only_each_other_make_false_are_believed_together() -> None:
    """Three good ones 3.5° off: as false ones they repeat each other's turn, so that each by itself stays false."""
    rng = np.random.default_rng(0)
    count, older = 240, np.arange(0, 100, 4)
    off = np.radians(rng.normal(0, 1.5, len(older)))
    doubted = np.arange(1, 13, 4)
    off[doubted] = np.radians(3.5) + np.radians(rng.normal(0, 0.2, len(doubted)))
    graph = ViewGraph.create(
        np.concatenate((np.arange(count), older)),
        np.concatenate((np.arange(1, count + 1), older + 120)),
        _yaw(np.concatenate((np.radians(rng.normal(0, 0.05, count)), off))),
        num_nodes=count + 1,
        kind=[0] * count + [1] * len(older),
    )
    problem = _problem(graph)
    is_false = np.isin(np.arange(len(older)), doubted)
    mode = Mode(problem, *polish(problem, _state(problem, is_false)), "test")
    assert (mode.left_out.log_odds[problem.closure[doubted]] < 0).all()
    believed = flipped(mode)
    assert not believed.is_false.any()
    assert believed.cost < mode.cost - 5


def test_closures_that_alone_join_two_parts_are_believed_together() -> None:
    """Each by itself tells nothing: its log-odds are those of the labels of the others, all false."""
    rng = np.random.default_rng(1)
    length, joins = 30, 12
    chain = np.concatenate((np.arange(length - 1), length + np.arange(length - 1)))
    ends = rng.permutation(length)[:joins], length + rng.permutation(length)[:joins]
    angle = np.concatenate((rng.normal(0, np.radians(0.1), len(chain)), rng.normal(0, np.radians(1.5), joins)))
    graph = ViewGraph.create(
        np.concatenate((chain, ends[0])),
        np.concatenate((chain + 1, ends[1])),
        _yaw(angle),
        num_nodes=2 * length,
        kind=[0] * len(chain) + [1] * joins,
    )
    problem = _problem(graph)
    mode = Mode(problem, *polish(problem, _state(problem, np.ones(joins, dtype=bool))), "test")
    assert (mode.left_out.log_odds[problem.closure] < 0).all()
    believed = flipped(mode)
    assert not believed.is_false.any()
    assert believed.cost < mode.cost - 5


def test_f_of_corrections_that_still_move_is_no_gain() -> None:
    graph, _ = _planar(0, 8, 0.3)
    problem = _problem(graph)
    state = _state(problem, np.zeros(8, dtype=bool))
    at_rest, moving = evaluate(problem, polish(problem, state)[0]), evaluate(problem, state, is_moving=True)
    assert moving.total > at_rest.total + 1e6
    assert not polish(problem, state, 1)[1].is_moving  # it goes on until nothing does
    given_up = replace(problem, limits=replace(problem.limits, polish_solves=1))
    assert polish(given_up, state)[1].is_moving


@pytest.mark.parametrize("seed", range(3))
def test_f_does_not_depend_on_order_and_direction_of_edges(seed: int) -> None:
    graph, _ = _planar(seed, 9, 0.3)
    rng = np.random.default_rng(seed)
    order = torch.from_numpy(rng.permutation(graph.num_edges))
    shuffled = graph.select_edges(order)
    turned = torch.from_numpy(rng.random(graph.num_edges) < 0.5)
    inverse = shuffled.target_from_source * torch.tensor([-1.0, -1.0, -1.0, 1.0])
    changed = replace(
        shuffled,
        source=torch.where(turned, shuffled.target, shuffled.source),
        target=torch.where(turned, shuffled.source, shuffled.target),
        target_from_source=torch.where(turned[:, None], inverse, shuffled.target_from_source),
    )
    totals = []
    for drawn in (graph, changed):
        problem = _problem(drawn)
        is_false = expit(np.abs(2 * np.arctan2(problem.measured[2], problem.measured[3]))[problem.closure]) > 0.55
        totals.append(polish(problem, _state(problem, is_false), hold_noise=True)[1].total)
    assert totals[0] == pytest.approx(totals[1], abs=1e-6)


def test_a_part_that_nothing_holds_weighs_as_one_that_may_be_turned_by_anything() -> None:
    """Two chains joined by one closure: whether it is good or false, F stays finite and comparable."""
    graph = ViewGraph.create(
        [0, 1, 3, 4, 1], [1, 2, 4, 5, 4], _yaw(np.array([0.0, 0.0, 0.0, 0.0, 0.5])), num_nodes=6, kind=[0, 0, 0, 0, 1]
    )
    problem = _problem(graph)
    good, false = (
        evaluate(problem, polish(problem, _state(problem, np.array([label])), hold_noise=True)[0]).terms
        for label in (False, True)
    )
    # Nothing contradicts the closure, so its residual tells nothing: only the labels' prior does.
    evidence = [sum(terms.values()) - terms["labels"] for terms in (good, false)]
    assert evidence[0] == pytest.approx(evidence[1], abs=0.05)


def test_priors_are_normalised() -> None:
    """Of labels over all labellings, of false closures over all turns, of slips over all sets of steps."""
    graph, _ = _planar(0, 8, 0.0)
    problem = _problem(graph)
    labels = [np.array(bits) for bits in product([False, True], repeat=len(problem.closure))]
    assert logsumexp([log_label_prior(problem, is_false) for is_false in labels]) == pytest.approx(0.0, abs=1e-9)
    angle = np.linspace(-np.pi, np.pi, 20_001)
    assert np.trapezoid(np.exp(log_false(angle**2, 1, SlamPriors())), angle) == pytest.approx(1.0, abs=1e-3)
    length = np.linspace(1e-6, np.pi, 20_001)
    shells = 4 * np.pi * length**2 * np.exp(log_false(length**2, 3, SlamPriors()))
    assert np.trapezoid(shells, length) == pytest.approx(1.0, abs=1e-3)
    # A second false closure, new or repeating the first by any turn.
    is_false = np.arange(len(problem.closure)) == problem.detection[0]
    second = problem.detection[1:2]
    densities, exact = [], np.zeros(len(problem.closure))
    turns = np.union1d(angle[::20], np.linspace(-0.02, 0.02, 401))
    for turn in turns:
        residual = np.zeros((len(problem.closure), 3))
        residual[second, 2] = turn
        densities.append(np.exp(false_density(problem, is_false, residual, exact, second).log_sums()))
    np.testing.assert_allclose(np.trapezoid(densities, turns, axis=0), 1.0, atol=0.02)
    chain = _problem(ViewGraph.create(np.arange(6), np.arange(1, 7), _yaw(np.zeros(6)), kind=[0] * 6))
    # Every node an end of closures would make six segments of one step; here their prior is asked for as if.
    steps = replace(chain, graph=replace(chain.graph, own_steps=np.ones(6), is_odometry=np.ones(6, dtype=bool)))
    sets = [np.flatnonzero(bits) for bits in product([False, True], repeat=6)]
    assert logsumexp([log_slip_prior(steps, slipped) for slipped in sets]) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "is_off"),
    [
        ("tails", lambda problem: not {"step_tails", "closure_tails"} & _tuned(problem)),
        ("near-misses", lambda problem: problem.priors.near_miss_share < 1e-9),
        ("common-errors", lambda problem: problem.system(_NOISE).num_runs == 0),
        ("turns", lambda problem: not problem.turns_vary),
        ("slips", lambda problem: bool(np.isposinf(problem.log_odds[problem.graph.is_odometry]).all())),
        ("own-repeats", lambda problem: not np.isfinite(repeat_rates(problem, _repeated(problem))).all()),
        ("repeats", lambda problem: not _repeated(problem).repeats.density.any()),
        ("label-runs", lambda problem: _stickiness(problem) == pytest.approx(0.0, abs=1e-9)),
    ],
)
def test_a_term_is_there_until_it_is_switched_off(name: str, is_off: Callable[[Problem], bool]) -> None:
    graph, _ = _planar(0, 8, 0.0)
    assert not is_off(_problem(graph, SlamPriors()))
    assert is_off(_problem(graph, SlamPriors(), without={name}))


def _drawn_density(count: int) -> tuple[FalseDensity, np.ndarray]:
    """A density, and what it makes of each closure ``(9, P, n)``, for each c and d, at the points of other rates."""
    rng = np.random.default_rng(0)
    has_any = rng.random((3, count)) < 0.5
    alone, of_others = rng.random((3, count)), rng.random((3, 10, count)) * has_any[:, None] * 1e-3
    c, d = (np.array([0.05, 0.5, 0.95])[:, None] * has for has in has_any[:2])
    g = np.array([0.01, 0.05, 0.2, 0.5])[:, None] * has_any[2]
    run, before, far = c[:, None, None, None, None], d[:, None, None, None], g[:, None, None]
    any_one = (1 - far) * alone[:, None] + far * of_others[2]
    mixed = (1 - run) * ((1 - before) * any_one + before * of_others[1]) + run * of_others[0]
    number = rng.integers(0, count // 5, count)
    return FalseDensity(alone, Repeats(of_others, has_any), number), mixed.reshape(9, -1, count)


def test_the_mean_over_rates_is_that_of_the_mixture() -> None:
    density, mixed = _drawn_density(40)
    rng, (ways, points, count) = np.random.default_rng(1), mixed.shape
    rates = rng.normal(size=(ways + 1) * points)
    rates -= logsumexp(rates)
    own = rng.dirichlet(np.ones(ways), count).T
    shared, of_own = np.split(np.exp(rates), [ways * points])
    expected = np.einsum("wp,wpn->n", shared.reshape(ways, points), mixed)
    expected += np.einsum("p,wn,wpn->n", of_own, own, mixed)
    np.testing.assert_allclose(density.mean(rates, own), expected, rtol=1e-12)


@pytest.mark.parametrize("count", [30, 3000])
def test_all_false_closures_together_are_the_product_of_all(count: int) -> None:
    """However many there are: the product of 3000 densities is below the least number, and that of 400 of a run is."""
    density, mixed = _drawn_density(count)
    run = np.where(np.arange(count) % 7 == 0, 0, density.run)
    of_each = np.log(mixed)
    of_run = np.stack([of_each[..., run == number].sum(axis=-1) for number in np.unique(run)])
    own = (logsumexp(of_run, axis=1) - np.log(len(mixed))).sum(axis=0)
    expected = np.concatenate((of_each.sum(axis=-1).ravel(), own))
    np.testing.assert_allclose(replace(density, run=run).log_sums(), expected, rtol=1e-9)


def test_runs_that_repeat_one_turn_are_cheap_though_others_repeat_none() -> None:
    """Twenty false closures of one run by any turn, six of another one by one turn."""
    ends = np.concatenate((np.arange(20), 60 + np.arange(6))), np.concatenate((40 + np.arange(20), 130 + np.arange(6)))
    steps = np.arange(140)
    graph = ViewGraph.create(
        np.concatenate((steps, ends[1])),
        np.concatenate((steps + 1, ends[0])),
        _yaw(np.zeros(140 + 26)),
        kind=[0] * 140 + [1] * 26,
    )
    cost = {}
    for without in ((), ("own-repeats",)):
        problem = _problem(graph, SlamPriors(), without=without)
        is_scattered = problem.ends[:, 1] < 100
        turn = np.where(is_scattered, np.random.default_rng(0).uniform(-np.pi, np.pi, 26), 3.0)
        residual = np.stack((np.zeros(26), np.zeros(26), turn), axis=1)
        for name, is_false in (("both", np.ones(26, dtype=bool)), ("scattered", is_scattered)):
            rows = np.flatnonzero(is_false)
            density = false_density(problem, is_false, residual, np.zeros(26), rows)
            cost[name, without] = -log_false_set(problem, density)
    repeating = [cost["both", without] - cost["scattered", without] for without in ((), ("own-repeats",))]
    assert repeating[0] < repeating[1] - 2.0


def _repeated(problem: Problem) -> FalseDensity:
    """The density of a closure that repeats the turn of the one before it."""
    first, second = problem.detection[:2]
    is_false = np.arange(len(problem.closure)) == first
    count = len(problem.closure)
    return false_density(problem, is_false, np.zeros((count, 3)), np.zeros(count), np.array([second]))


def _stickiness(problem: Problem) -> float:
    """How far the odds of good closures differ, of which one follows a false one."""
    is_false = np.arange(len(problem.closure)) == problem.follows.max()
    return float(np.ptp(label_log_odds(problem, is_false)[~is_false]))


def test_turn_steps_are_as_many_as_steps_and_lie_where_odometry_turns() -> None:
    graph, _ = _planar(0, 8, 0.0)
    problem = _problem(graph, SlamPriors())
    segments = slice(problem.graph.num_segments)
    assert problem.turn_steps[segments].sum() == pytest.approx(problem.graph.own_steps[segments].sum())
    # Turns grow along this path, node n has turned by n² in all.
    nodes = problem.graph.nodes
    passed = nodes[problem.graph.target[segments]] ** 2.0 - nodes[problem.graph.source[segments]] ** 2.0
    ratio = problem.turn_steps[segments] / passed
    np.testing.assert_allclose(ratio, ratio[0])
    assert problem.drawn(_NOISE) is problem.graph
    half = problem.drawn(replace(_NOISE, turn_share=0.5))
    inside = (problem.graph.fraction > 0) & (problem.graph.fraction < 1)
    assert (half.fraction[inside] < problem.graph.fraction[inside]).all()
    np.testing.assert_array_equal(half.fraction[~inside], problem.graph.fraction[~inside])


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_set_to_where_its_sequence_leads(seed: int) -> None:
    """From variances far from what residuals tell; solve by solve it takes up to twelve."""
    graph, _ = _planar(seed, 30, 0.0, length=200)
    problem = _problem(graph)
    noise = replace(_NOISE, step_variance=25 * _NOISE.step_variance, closure_variance=_NOISE.closure_variance / 9)
    begun = replace(_state(problem, np.zeros(30, dtype=bool)), noise=noise)
    with metered() as meter:
        state, evaluation = polish(problem, begun)
    with metered() as one:
        problem.system(noise).factorise(evaluation.weight)
    # The last one tells F.
    assert meter.spent <= 8.5 * one.spent
    assert evaluation.total == pytest.approx(polish(problem, state)[1].total, abs=0.1)
