"""The constants of the SfM refinement, each with its unit, its source, and how much the answer depends on it.

Half and twice each value (except the numerical floors of 10⁻⁶ and less) were tried on tuning graphs of seven kinds:
``docs/diary/sfm-refinement.md``. Unless stated otherwise below, the mean and the median error of each kind change by
less than 1 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NoiseShapePriors:
    """How the noise's covariance in the cameras' frames is estimated (``noise_shape.py``).

    Attributes:
        iterations, further_iterations: number of fixed-point iterations of the scatter, from scratch and from the last
            step's scatter.
        least_ratio: smallest ratio of an axis's standard deviation to that of the least exact axis. Twice: 1–7 % worse
            means, 6–16 % worse medians, where noise has an exact axis. Half: 2 % better only on the paper's recipe,
            which has an axis without noise; real cameras have no such axis.
        least_deviation: radians, added to every axis, numerical: lets the covariance of exact measurements be inverted.
        lower_share, typical_lengths: the shape is estimated from residuals up to ``typical_lengths`` times their
            quantile ``lower_share``. A quarter of normal noise is below 1.1 standard deviations of an axis, nearly all
            of it below 5; with 60 % of false edges, those longer than 10 are left out. With 8 times, medians where a
            third of the edges is turned about the vertical are 1 to 2 % worse.
        round_residuals: number of edges beyond a spanning tree that weigh as much as the prior that noise is round.
    """

    iterations: int = 10
    further_iterations: int = 3
    least_ratio: float = 0.1
    least_deviation: float = float(np.radians(1e-4))
    lower_share: float = 0.25
    typical_lengths: float = 5.5
    round_residuals: float = 20.0


@dataclass(frozen=True)
class PrecisionPriors:
    """How far stated precisions are believed (``stated/precision.py``).

    The values follow those for robots' graphs and were chosen before any graph with precisions was solved; none was
    tuned.

    Attributes:
        worthless: prior probability that stated precisions say nothing.
        num_exponents: number of grid values of α from 0 to 1.
        least_exponent: a posterior mean below this is hardly above the prior's, and counts as 0.
        least_spread: least standard deviation of the logarithms of stated variances; with less, weights could reduce
            the variance by 4 % at most.
        max_log_ratio: largest logarithm of the factor by which an edge is believed to be better or worse than typical.
        max_sample: maximum number of edges from which α is estimated.
        least_residual: share of the typical residual; shorter residuals belong to edges that the answer fits exactly.
            Normal noise in three dimensions is that short once in a million edges.
        least_angle: rad, floor of the residuals, numerical.
    """

    worthless: float = 0.95
    num_exponents: int = 9
    least_exponent: float = 0.1
    least_spread: float = 0.2
    max_log_ratio: float = float(np.log(100.0))
    max_sample: int = 8_000
    least_residual: float = 0.01
    least_angle: float = float(np.radians(1e-4))


@dataclass(frozen=True)
class CyclePriors:
    """What triangles say of edges (``cycles/evidence.py``).

    Attributes:
        few_paths, run: number of two-edge paths per component, and of consecutive paths in a run, that are searched for
            a third edge to tell whether CleanNet's scores fit these cameras.
        paths_per_edge, least_paths, most_paths: if they do not fit, number of paths searched per edge, and the bounds
            of their total.
        freedom: degrees of freedom of Student's t, the density of closing angles of triangles of good edges.
        first_scale, scale_triangles: prior scale of that density, rad, and the number of triangles it counts for.
        least_scale: rad; without it, edges that repeat each other would make the scale vanish.
        base_spread, slope_spread: prior standard deviations of b and k, about 0.
        rounds: number of rounds of messages. With 3 and 12, means of the default were 5 and 8 % worse (measured when
            the slope was always fitted).
        full_trust: CleanNet counts in full where it explains this share of what triangles explain of other triangles.
            On recipes that it was trained on, the share is 0.4 to 1.1; on arbitrarily turned cameras, 0.00 to 0.03.
        by_chance: nats that may be explained by chance.
        shells: rad; densities of closing angles are constant between these.
        density_rounds: number of rounds in which these densities are estimated.
    """

    few_paths: int = 40_000
    run: int = 500
    paths_per_edge: int = 2
    least_paths: int = 100_000
    most_paths: int = 400_000
    freedom: float = 3.0
    first_scale: float = float(np.radians(8.0))
    scale_triangles: float = 1.0
    least_scale: float = float(np.radians(0.3))
    base_spread: float = 3.0
    slope_spread: float = 0.5
    rounds: int = 8
    full_trust: float = 0.25
    by_chance: float = 10.0
    shells: tuple[float, ...] = tuple(
        float(np.radians(degrees)) for degrees in (0, 5, 10, 15, 20, 30, 45, 60, 90, 120, 150, 180)
    )
    density_rounds: int = 6


@dataclass(frozen=True)
class ConsensusPriors:
    """When another answer is looked for, and by which density the two are compared (``consensus/``).

    Chosen on every third scene of the four sets of scans (``docs/diary/sfm-scans.md``).

    Attributes:
        contradicting: another answer is looked for where the number of closing triangles with a rejected edge exceeds
            the number expected by chance by this many standard deviations.
        closing: rad; widths of the closing angle with which triangles vote; each gives the start of one other answer.
        glance: maximum number of triangles that are examined to tell whether there may be another answer.
        max_nodes, max_edges: largest component that is examined; larger ones would take half a minute and more.
        max_triangles: maximum number per component, evenly spread over all that it has; enough for every triangle of
            every edge of a complete graph of a hundred nodes.
        freedom: degrees of freedom of Student's t, the density of good edges: a tenth of them err four times as much as
            typical ones.
        least_scale: rad, floor of that density's scale. Registrations are hardly more exact, and without the floor a
            few edges that repeat each other would be explained ever more exactly.
        shells: rad; the density of the angle that false edges state is free, but constant in each shell between these.
            Failed registrations lie near where they began, some exactly there, hence the narrow first shell.
        shell_edges: prior number of edges in a shell with the volume of the whole sphere.
        curvature: prior precision of the two coefficients by which the probability that an edge is good depends on how
            far its ends are turned.
        max_rounds: maximum number of rounds of expectation and maximisation.
        settled: nats; a round that improves the likelihood by less is the last.
        ahead: nats by which another answer has to be likelier; covers the rounding of two runs that find the same one.
        contradicted: nats that an answer loses for an accepted edge that is more than 20° off: more than other edges of
            a pair of views have to say.
    """

    contradicting: float = 5.0
    closing: tuple[float, ...] = (float(np.radians(1.0)), float(np.radians(3.0)))
    glance: int = 60_000
    max_nodes: int = 1_000
    max_edges: int = 100_000
    max_triangles: int = 200_000
    freedom: float = 3.0
    least_scale: float = float(np.radians(0.3))
    shells: tuple[float, ...] = tuple(
        float(np.radians(degrees)) for degrees in (0.0, 0.001, 5, 10, 15, 20, 30, 45, 60, 90, 120, 150, 180)
    )
    shell_edges: float = 2.0
    curvature: float = 0.1
    max_rounds: int = 100
    settled: float = 0.01
    ahead: float = 1.0
    contradicted: float = 1000.0


@dataclass(frozen=True)
class DensityPriors:
    """Which density of noise the last steps use (``noise_density.py``).

    The exponents are those that an experiment on graphs of normal noise, recipes, Lund and scans compared
    (``docs/diary/sfm-refinement.md``). None of the numbers was tuned, and the answer's dependence on them was not
    measured.

    Attributes:
        exponents: values of β; the first is that of the steps before.
        ahead: nats by which another exponent has to be likelier.
        least_length: rad; where good edges err less, the exponent stays. The steps before end once they turn no camera
            by more than this (``RefinementPriors.converged_angle``).
        good_share: initial share of good edges.
        most_certain: one over the least share of false edges, numerical.
        rounds: number of rounds of expectation and maximisation.
        least_prior: edges of less prior weight are not used in the fit.
        max_steps: maximum number of steps with the density, within the steps that are left.
    """

    exponents: tuple[float, ...] = (0.5, 0.75, 1.0, 1.5, 2.0)
    ahead: float = 10.0
    least_length: float = float(np.radians(0.001))
    good_share: float = 0.8
    most_certain: float = 1e3
    rounds: int = 20
    least_prior: float = 1e-3
    max_steps: int = 10


@dataclass(frozen=True)
class StartPriors:
    """Where the refinement begins besides CleanNet, tree and FineNet (``starts/``).

    On a tuning graph of each of 24 kinds, half the value made means worse by 2 % (``sparse_degree``, ``tree_degree``)
    or 5 % (``part_edges``, ``turned_rounds``), each on one or two of the kinds, and twice the value changed them by
    .4 % at most; ``rounds`` changed nothing.

    Attributes:
        sparse_degree: with fewer edges per node, all starts are tried on all edges; with more, one start is, on
            this many edges per node.
        part_edges: branches that more edges join to the rest are not turned: a few false edges do not hold them in a
            wrong place.
        tree_degree: maximum number of edges per source along which the tree of branches is built, where they suffice
            to connect the graph.
        turned_rounds: maximum number of rounds in which branches are turned, each after the turns of those before.
        rounds: maximum number of times that the best solution's parts are turned and refined.
        most_searched: in graphs with more edges parts are not searched; it would take seconds.
    """

    sparse_degree: int = 40
    part_edges: int = 32
    tree_degree: int = 20
    turned_rounds: int = 5
    rounds: int = 3
    most_searched: int = 1_000_000


@dataclass(frozen=True)
class AttachmentPriors:
    """How surely parts are attached (``certainty/attachment.py``). None of the numbers was tuned but ``ahead``.

    Attributes:
        ahead: nats by which another turn has to be likelier for a part to be turned. Of 141 cases on tuning graphs that
            were ahead by 3 and more, badly matched cameras apart, 118 came nearer to the truth; by 1 to 3, half.
        rounds: maximum number of times that parts are turned and the answer refined.
        freedom: degrees of freedom of Student's t, the density of good edges.
        least_false, most_false: bounds of the share of false edges, numerical.
        least_scale: rad, floor of that density's scale. Edges are hardly more exact.
        shells: rad; the density of the angle of false edges' errors is free, but constant in each shell between these.
            Smaller errors, which are not seen, have the first one's.
        shell_edges: prior number of edges in a shell with the volume of the whole sphere.
        contradicted: nats that a turn loses for an accepted edge that is more than 20° off, or false: more than all
            edges that join a part have to say, which is at most some 20 nats each.
    """

    ahead: float = 3.0
    rounds: int = 3
    freedom: float = 3.0
    least_false: float = 1e-3
    most_false: float = 0.9
    least_scale: float = float(np.radians(0.1))
    shells: tuple[float, ...] = tuple(float(np.radians(degrees)) for degrees in (20, 30, 45, 60, 90, 120, 150, 180))
    shell_edges: float = 2.0
    contradicted: float = 1000.0


@dataclass(frozen=True)
class UncertaintyPriors:
    """How the deviations of orientations are estimated (``certainty/uncertainty.py``). No orientation depends on them.

    Attributes:
        samples: number of random samples; what is sampled of a standard deviation errs by 9 %.
        first_samples: their number in well-knit components where these suffice.
        sample_error: relative error of standard deviations by sampling at which they do.
        most_edges: with more edges in well-knit components, samples would take seconds, and none is stated.
        least_weight: weight of edges that are surely wrong, which keeps the graph connected.
        flagged: edges of lower scores are believed: the noise's variance is from their residuals.
        least_noise: rad², floor of the noise's variance, numerical, for graphs without any.
    """

    samples: int = 64
    first_samples: int = 8
    sample_error: float = 0.01
    most_edges: int = 1_000_000
    least_weight: float = 1e-3
    flagged: float = 0.5
    least_noise: float = 1e-12


@dataclass(frozen=True)
class RefinementPriors:
    """How the refinement weighs edges and when it ends (``refinement.py``).

    Standard errors are those of the answer, the unit of a step's length λ (``refinement.py``). Values without another
    source were chosen on the tuning graphs.

    Attributes:
        max_steps: maximum number of all steps; the tuning graphs take 5–20, some scans more.
        max_coarse_steps: maximum number of coarse steps; 1–4 are usual.
        telling_steps: number of shaped steps after which starts are compared. With none, the coarse steps decide, a
            quarter faster and 1 % worse; with twice as many, 1 % better and a fifth slower
            (``docs/diary/sfm-refinement.md``).
        same_valley: relative difference of costs below which two solutions in which nearly all cameras agree may differ
            only in where the steps stopped.
        hopeless: a start is given up whose cost exceeds the least by this share: after its coarse steps, or before
            any if it was found from a subset of the edges.
        rival_cost: largest relative excess of the cost of a solution that is refined beside the best one.
        rival_share: a solution in which more than this share of a component's cameras is turned by more than 20° is a
            different one; it is refined too if a few steps do not decide. Solutions may differ by no more than a
            cluster that few edges join.
        rival_nats: an answer is doubtful if the edges are not likelier by this much than under a rival. Errors of edges
            are not independent, so likelihoods claim too much: of 39 tuning graphs with a rival it was nearer to the
            truth, by more than a tenth, on 3 of 14 below this value and on 4 of 25 above.
        least_shaped_steps: minimum number of shaped steps where the user allows only a few steps.
        coarse_smoothing: radians: shorter residuals weigh as this one in coarse steps (Chatterjee & Govindu 2013).
        coarse_settled: coarse steps end once they turn cameras by less than this share of the typical residual.
        relaxation: factor by which a shaped step is lengthened. Any factor below 2 lowers the cost; 1 takes a third
            more steps, 1.7 and more alternate.
        stretched: standard errors: only shorter steps are lengthened; longer ones are not yet in the final basin.
        held: standard errors: the noise is not estimated again after a shorter shaped step. Twice: up to 1.5 %.
        converged: standard errors: a shorter shaped step is the last. The remaining distance is then about a tenth of a
            standard error, half a per cent of the error. Twice: up to 2 %.
        converged_angle: radians: a step that turns no camera by more is also the last; far below the accuracy of the
            orientations.
        step_tolerance: share of a step that conjugate gradients may leave to the next step.
        least_angle: radians: the same as an absolute value; the limit of single precision.
        least_square: floor of a residual's expected square, in variances of the noise, numerical.
        least_prior: floor of an edge's weight, numerical: keeps nodes attached all of whose edges seem false.
        coarse_noise: radians: where residuals are typically larger, single precision is used; its error of 10⁻⁷ rad
            then shows in no answer.
        least_residual: radians: floor of the typical residual, numerical.
        well_knit_degree: number of edges per node above which conjugate gradients are tried without a factorisation.
            Half: up to 1.5 % on small graphs.
        max_sample: maximum number of edges of a component from which its noise is estimated; half and twice: up to
            1.4 %.
        half_trusted: number of edges beyond a cycle at which CleanNet's log-odds count by half in telling edges in
            series apart: it was trained on graphs in which many edges check each other. Orientations of the synthetic
            recipes, which have thousands of edges, do not depend on it.
        accepted_square: accepted edges weigh no less than edges whose squared residual is this many times the typical
            one, which the smallest residuals dominate: the mean is three to four times it. With 1, accepting good edges
            makes answers a fifth worse, with 10 it does not (``docs/diary/sfm-refinement.md``).
        shape: how the noise's shape is estimated.
        density: which density the last steps use.
        starts: where the refinement begins.
    """

    max_steps: int = 50
    max_coarse_steps: int = 20
    telling_steps: int = 3
    same_valley: float = 5e-3
    hopeless: float = 0.03
    rival_cost: float = 5e-3
    rival_share: float = 0.02
    rival_nats: float = 20.0
    least_shaped_steps: int = 3
    coarse_smoothing: float = float(np.radians(1.0))
    coarse_settled: float = 0.03
    relaxation: float = 1.5
    stretched: float = 1.0
    held: float = 0.3
    converged: float = 0.05
    converged_angle: float = float(np.radians(0.001))
    step_tolerance: float = 0.03
    least_angle: float = 1e-6
    least_square: float = 1e-6
    least_prior: float = 1e-6
    coarse_noise: float = 1e-3
    least_residual: float = float(np.radians(0.001))
    well_knit_degree: float = 12.0
    max_sample: int = 8_000
    half_trusted: float = 20.0
    accepted_square: float = 10.0
    shape: NoiseShapePriors = NoiseShapePriors()
    density: DensityPriors = DensityPriors()
    starts: StartPriors = StartPriors()
