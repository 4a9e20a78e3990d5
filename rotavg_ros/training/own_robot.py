"""Fine-tuning on a user's own robot: its errors, simulated runs with such errors, and whether the network improves."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.special import ndtr, stdtrit

from rotavg_ros.datasets.simulation.stress.family import RobotFamily
from rotavg_ros.datasets.simulation.trajectories import PLANAR_WORLDS
from rotavg_ros.datasets.worlds import World
from rotavg_ros.solver.learning.fine_tuning import SlamFineNet, SolvedRun
from rotavg_ros.solver.learning.robot_runs import RobotNoise, RobotRun
from rotavg_ros.solver.networks import load_network, read_network
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.slam_fine_tasks import SlamFineTask, draw_runs
from rotavg_ros.training.trainer import Trainer, fingerprint

# Uncertainty of what is measured on few runs: a factor, and a difference for shares.
_FACTOR, _SHARE = 1.5, 0.1
# Probability of a cause of unevenness where runs show it, and where they do not.
_SEEN, _UNSEEN = 0.8, 0.1
# Levels with a smaller spread, in the logarithm of σ, count as even.
_EVEN = 0.15
# Share of the time for simulating and solving runs; one in this many of them is for validation.
_DRAWING, _EVERY = 0.45, 8
_LEAST_RUNS, _MOST_KEYFRAMES, _MOST_EPOCHS = 16, 800, 60
_STANDARD_ERRORS = 2.0
# Errors of a step and of a closure, degrees: none that is larger is simulated.
LARGEST_STEP_DEG, LARGEST_CLOSURE_DEG = 20.0, 30.0
# Least number of closures of a robot's run, and of a simulated one: these are shorter than a robot's long runs, so that
# rare closures are denser in them.
LEAST_CLOSURES = 12


@dataclass(frozen=True)
class Verdict:
    """Whether a network explains held-back stretches better than another.

    Attributes:
        gain: nats per closure, mean over stretches.
        standard_error: of the gain.
        stretches: number of stretches.
        without: by how much the other network is better than no FineNet, nats per closure.
    """

    gain: float
    standard_error: float
    stretches: int
    without: float

    @property
    def is_better(self) -> bool:
        """Whether chance alone gives such a gain with a probability below that of two standard errors, 2.3 %.

        The standard error is estimated from the same stretches, so that it takes 14 of two, 4.5 of three, 2.2 of 16
        (Student's t).
        """
        if self.stretches < 2:
            return False
        needed = float(stdtrit(self.stretches - 1, ndtr(_STANDARD_ERRORS)))
        return self.gain > needed * self.standard_error


def family_of(noises: Sequence[RobotNoise]) -> RobotFamily:
    """A family of runs with errors like these, widened by the uncertainty of few runs."""

    def around(values: Sequence[float], least: float, most: float) -> tuple[float, float]:
        low, high = min(values) / _FACTOR, max(values) * _FACTOR
        return float(np.clip(low, least, most)), float(np.clip(high, least, most))

    def seen(values: Sequence[bool]) -> float:
        return _SEEN if any(values) else _UNSEEN

    false = [noise.false_share for noise in noises]
    steps, closures = [noise.step_spread for noise in noises], [noise.closure_spread for noise in noises]
    turning = [noise.per_turn for noise in noises if noise.per_turn > 0]
    common = [noise.common_share for noise in noises if noise.common_share > 0]
    planar = float(np.mean([noise.planar for noise in noises]))
    worlds = PLANAR_WORLDS if planar > 0 else tuple(World)
    usual = RobotFamily()
    return RobotFamily(
        worlds=tuple(world.value for world in worlds),
        planar_share=planar,
        odometry_deg=around([noise.odometry_deg for noise in noises], 1e-3, LARGEST_STEP_DEG),
        closure_deg=around([noise.closure_deg for noise in noises], 1e-2, LARGEST_CLOSURE_DEG),
        closures_per_keyframe=around(
            [noise.closures_per_keyframe for noise in noises], LEAST_CLOSURES / _lengths(noises)[0], 3.0
        ),
        false_share=(max(min(false) - _SHARE, 0.0), min(max(false) + _SHARE, 0.9)),
        grouped_share=float(np.mean([noise.grouped_share for noise in noises])),
        even=0.0,
        uneven=seen([spread > _EVEN for spread in steps]),
        level=seen([spread > _EVEN for spread in steps]),
        level_spread=around([max(*steps, *closures, _EVEN)], 0.0, 3.0),
        single=seen([noise.closure_spread > _EVEN for noise in noises]) / 2,
        turns=seen([bool(turning)]),
        per_turn=around(turning, 0.0, 1.0) if turning else usual.per_turn,
        qualities=seen([spread > _EVEN for spread in closures]) / 2,
        heavy=seen([spread > _EVEN for spread in closures]),
        common=seen([bool(common)]),
        common_share=around(common, 0.0, 0.95) if common else usual.common_share,
        stated=seen([noise.states_precision for noise in noises]),
    )


def _lengths(noises: Sequence[RobotNoise]) -> tuple[int, int]:
    """Least and largest number of keyframes of simulated runs."""
    lengths = sorted(min(max(noise.keyframes, 60), _MOST_KEYFRAMES) for noise in noises)
    return max(lengths[0] // 2, 50), lengths[-1]


def configuration(noises: Sequence[RobotNoise]) -> TrainingConfig:
    """Training on runs with the errors and the lengths of these; ``fine_tune`` decides on how many, and how often."""
    nodes = _lengths(noises)
    return TrainingConfig(
        family="slam", recipe="robots", nodes=nodes, validation_nodes=nodes, batch_graphs=8, learning_rate=5e-4,
        weight_decay=0.0, edge_dropout=0.0, passes=2, robots=family_of(noises),
    )  # fmt: skip


def fine_tune(config: TrainingConfig, folder: Path, minutes: float, told: Callable[[str], None]) -> SlamFineNet:
    """The package's network after training on runs of a family.

    Args:
        config: with the robot's errors and lengths, from :func:`configuration`.
        folder: for the weights, their card and log.
        minutes: time for everything.
        told: gets a line on the progress.

    Raises:
        DrawingError: next to no run of the family can be learned from.
    """
    begun = time.monotonic()
    family, nodes = config.robots or RobotFamily(), config.nodes
    runs: list[SolvedRun] = []
    rng = np.random.default_rng(0)
    while len(runs) < _LEAST_RUNS or time.monotonic() - begun < _DRAWING * 60 * minutes:
        runs += draw_runs(family, 1, nodes, rng)
    told(f"{len(runs)} simulated runs of {nodes[0]}–{nodes[1]} keyframes")
    training, validation = [run for number, run in enumerate(runs) if number % _EVERY], runs[::_EVERY]
    config = replace(config, graphs=len(training), validation_graphs=len(validation))
    task = SlamFineTask.on(config, training, validation)
    start = load_network(SlamFineNet)
    task.network.load_state_dict(start.state_dict())
    clocked = time.monotonic()
    for terms in task.batches(np.random.default_rng(0)):
        terms["loss"].backward()  # type: ignore[no-untyped-call]
    with torch.no_grad():
        task.validate()
    an_epoch = time.monotonic() - clocked
    left = 60 * minutes - (time.monotonic() - begun)
    config = replace(config, epochs=int(np.clip(left / an_epoch, 2, _MOST_EPOCHS)))
    task.config = config
    told(f"{config.epochs} epochs of {an_epoch:.0f} s")
    inputs = {"start_fingerprint": fingerprint(start)}
    trainer = Trainer(task, config, folder, SlamFineNet.NAME, inputs, "rotavg train slam --from …")
    trainer.run()
    return read_network(SlamFineNet, trainer.weights_path)


def compare(runs: Sequence[RobotRun], network: SlamFineNet) -> Verdict:
    """Compare the network with the package's on held-back stretches of runs."""
    rows = np.concatenate([run.explained([network, load_network(SlamFineNet), None]) for run in runs])
    if len(rows) < 2:
        return Verdict(0.0, 0.0, len(rows), 0.0)
    gain = rows[:, 0] - rows[:, 1]
    error = float(gain.std(ddof=1) / np.sqrt(len(gain)))
    return Verdict(float(gain.mean()), error, len(gain), float((rows[:, 1] - rows[:, 2]).mean()))
