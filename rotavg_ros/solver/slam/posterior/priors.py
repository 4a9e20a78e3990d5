"""Prior parameters of the posterior, and bounds of its search, in two frozen classes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SlamPriors:
    """Prior parameters for a robot's graph. Angles are in degrees, per component of a rotation.

    Not here are grids: of rates that are integrated (the share of repeated turns, the stickiness of labels,
    :mod:`rotavg_ros.solver.slam.posterior.labels`), and of noise that F chooses
    (:mod:`rotavg_ros.solver.slam.posterior.state`). What bounds a density (the length of a stretch of bad odometry, the
    share of turns about the vertical) stands beside it.

    Attributes:
        step_deg: median of the standard deviation of one step of odometry.
        closure_deg: the same for a good closure; also the standard deviation of the error in the stated mounting of the
            closures' sensor.
        noise_spread: standard deviation of the logarithm of both standard deviations, and of that between false
            closures that repeat each other, where they agree better than good ones.
        tails: probability that odometry has heavy tails (some sound segments err by far more than others), and likewise
            for good closures; all values of the grid of shares are equally likely
            (:mod:`rotavg_ros.solver.slam.posterior.state`).
        tail_ratio: factor of the variance in the tails of closures (Huber's contaminated normal).
        outlier_share: mean of the Beta prior of the share of false closures.
        outlier_count: number of closures for which this prior counts.
        near_miss_share: mean of the Beta(1, ·) prior of the share of false closures that are wrong by a normally
            distributed turn, or by half a turn plus such a turn.
        near_miss_deg: standard deviation of that turn; the other false closures are wrong by any turn.
        elsewhere_count: the share of false closures that repeat the wrong turn of others elsewhere on the path has the
            prior Beta(1, elsewhere_count); the share of repeats nearby has a uniform prior.
        slip_count: the share of slipping steps has the prior Beta(slip_count, slip_steps).
        slip_steps: see ``slip_count``; the first slip costs much and later ones less.
        slip_deg: standard deviation of the error of a step that slipped.
        bias_deg: standard deviation of a component of a gyroscope's bias, per step.
        run_gap_steps: closures follow each other in a run if the distances between their two ends sum to at most this
            many steps of odometry.
        common_errors: probability that closures of a run share an error; all values of the grids of its length and size
            are equally likely (:mod:`rotavg_ros.solver.slam.posterior.state`).
        turn_errors: probability that odometry errs more where it turns; all shares of the grid are equally likely.
        stated_share: probability that stated variances are informative.
        least_stated_ratio: lower bound of a closure's believed variance, as a share of the typical variance.
        largest_stated_ratio: a stated variance that differs from the typical one by more than this factor is ignored.
    """

    step_deg: float = 0.3
    closure_deg: float = 2.0
    noise_spread: float = 0.7
    tails: float = 0.5
    tail_ratio: float = 16.0
    outlier_share: float = 0.25
    outlier_count: float = 4.0
    near_miss_share: float = 0.5
    near_miss_deg: float = 20.0
    elsewhere_count: float = 10.0
    slip_count: float = 1.0
    slip_steps: float = 20000.0
    slip_deg: float = 45.0
    bias_deg: float = 1.0
    run_gap_steps: float = 30.0
    common_errors: float = 0.5
    turn_errors: float = 0.5
    stated_share: float = 0.5
    least_stated_ratio: float = 0.25
    largest_stated_ratio: float = 100.0


@dataclass(frozen=True)
class SearchLimits:
    """How far the search goes; none of these limits changes F itself.

    Attributes:
        polish_solves: maximum number of sparse solves to bring a labelling to its optimum.
        trial_solves: the same while other noise, or flips of single labels, are tried.
        settling_solves: the same while labels are probabilities.
        converged: nats; a step or change of noise that lowers F by less counts as converged.
        flip_rounds: maximum number of batches of single flips.
        annealing_factor: factor by which the loss of graduated non-convexity is sharpened from solve to solve.
        robust_solves: number of solves of the ℓ½ start.
        alike: further starts are tried until this many end in the mode of least F.
        tried: maximum number of moves that are tried.
        slack: nats; a move is tried if F is predicted to rise by no more than this.
        rival: nats; moves are also tried from modes whose F is within this of the best.
        candidates: number of slips, runs, parts or joins that a move proposes at most, the most promising first; and of
            slips that are taken back one after the other.
        averaged: maximum number of labellings that are averaged.
    """

    polish_solves: int = 20
    trial_solves: int = 5
    settling_solves: int = 8
    converged: float = 0.03
    flip_rounds: int = 8
    annealing_factor: float = 1.6
    robust_solves: int = 12
    alike: int = 3
    tried: int = 60
    slack: float = 1.0
    rival: float = 6.0
    candidates: int = 12
    averaged: int = 8
