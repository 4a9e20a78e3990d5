"""Times of ticks, compared with iSAM2 on the same poses: a robot drives through a city, two keyframes a tick."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.dead_reckoning import chain_poses
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, simulate_slam_graph
from rotavg_ros.datasets.worlds import World
from rotavg_ros.evaluation.common.answers import Clock
from rotavg_ros.evaluation.common.peers.gtsam_pose_peers import Isam2
from rotavg_ros.evaluation.common.tables import Column, Table
from rotavg_ros.evaluation.live.feed import Feed
from rotavg_ros.metrics import body_from_world, orientation_errors
from rotavg_ros.online import EstimatorOptions, OnlineEstimator
from rotavg_ros.view_graph import ViewGraph

KEYFRAMES_PER_TICK = 2
Watch = Callable[[Iterable[int]], Iterable[int]]


@dataclass(frozen=True)
class Drive:
    """The drive.

    Attributes:
        keyframes: number before ticks are timed, with as many closures.
        ticks: number of timed ticks.
        busy: number of parallel loops that only keep a core each busy.
        seed: of the city.
    """

    keyframes: int
    ticks: int
    busy: int = 0
    seed: int = 0

    def simulated(self) -> SimulatedRun:
        """A tenth of the closures is false."""
        config = SlamSimulationConfig(
            world=World.CITY,
            num_keyframes=self.keyframes + KEYFRAMES_PER_TICK * self.ticks,
            laps=8,
            keyframe_distance_m=2.0,
            closure_radius_m=6.0,
            closures_per_keyframe=1.0,
            false_share=0.1,
        )
        return simulate_slam_graph(config, np.random.default_rng(self.seed))

    def ends(self) -> list[int]:
        """Keyframes at each tick."""
        return [self.keyframes + KEYFRAMES_PER_TICK * (tick + 1) for tick in range(self.ticks)]


@dataclass(frozen=True)
class TicksRow:
    """The times of one contender.

    Attributes:
        name: of the contender.
        answer_ms: ``(T,)`` time until all poses, or orientations, are available.
        after_ms: ``(T,)`` time of the work after that; 0 if there is none.
        begin_s: seconds before the first tick.
        error_deg: mean over all keyframes of the last answer, against the truth after one robust rotation.
    """

    name: str
    answer_ms: np.ndarray
    after_ms: np.ndarray
    begin_s: float
    error_deg: float


def table(rows: list[TicksRow]) -> Table:
    """Quantiles of the times."""
    columns = (
        Column("contender"),
        Column("ticks"),
        Column("before them s", ".1f"),
        *(Column(f"answer {name} ms", ".1f") for name in ("p50", "p95", "p99.9", "max")),
        *(Column(f"after it {name} ms", ".0f") for name in ("p50", "p95", "max")),
        Column("last answer's error °", ".2f"),
    )
    note = "Error: mean angle between estimated and true orientations after one robust global rotation."
    told = [
        (
            row.name,
            len(row.answer_ms),
            row.begin_s,
            *np.quantile(row.answer_ms, (0.5, 0.95, 0.999, 1.0)).tolist(),
            *np.quantile(row.after_ms, (0.5, 0.95, 1.0)).tolist(),
            row.error_deg,
        )
        for row in rows
    ]
    return Table("Ticks", columns, tuple(told), (note,))


def run(drive: Drive, watch: Watch = lambda ticks: ticks) -> list[TicksRow]:
    """Ours with rotations alone and with translations, then iSAM2 on poses (Cauchy's loss).

    Args:
        drive: the drive.
        watch: passes ticks through and may show the progress.

    Raises:
        MissingPeerError: GTSAM is not installed.
    """
    simulated = drive.simulated()
    with _busy(drive.busy):
        return [
            _ours("rotations alone", simulated, simulated.graph, drive, watch),
            _ours("with translations", simulated, _with_translations(simulated), drive, watch),
            _isam2(simulated, drive, watch),
        ]


def _with_translations(run: SimulatedRun) -> ViewGraph:
    return replace(run.graph, translation=torch.from_numpy(run.edge_translation))


def _ours(name: str, run: SimulatedRun, graph: ViewGraph, drive: Drive, watch: Watch) -> TicksRow:
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges", gauge="identity"))
    feed = Feed(graph, estimator)
    feed.until(drive.keyframes)
    begun = time.perf_counter()
    answer = estimator.tick()
    begin_s = time.perf_counter() - begun
    seconds = []
    for end in watch(drive.ends()):
        feed.until(end)
        started = time.perf_counter()
        answer = estimator.tick() or answer
        answered = time.perf_counter()
        estimator.go_on()
        seconds.append((answered - started, time.perf_counter() - answered))
    assert answer is not None
    known = np.empty((graph.num_nodes, 4))
    known[answer.keyframe_id.astype(np.int64)] = answer.world_from_body
    answer_ms, after_ms = 1e3 * np.array(seconds).T
    return TicksRow(f"**ours**, {name}", answer_ms, after_ms, begin_s, _error_deg(known, run))


def _isam2(run: SimulatedRun, drive: Drive, watch: Watch) -> TicksRow:
    graph = _with_translations(run)
    # True deviations: iSAM2 is given what it would have to know.
    sigma = np.empty((graph.num_edges, 2))
    closure = ~graph.is_odometry.numpy()
    precision = graph.precision.double().numpy()
    sigma[:, 0] = 1 / np.sqrt(precision)
    length = np.linalg.norm(run.edge_translation, axis=1)
    noise = SlamSimulationConfig()
    sigma[:, 1] = np.where(closure, noise.closure_translation_noise_m, noise.odometry_translation_noise * length)
    isam, before = Isam2(graph, np.maximum(sigma, 1e-4), chain_poses(graph, run.edge_translation)), Clock()
    for _ in range(drive.keyframes):
        isam.add_node(before)
    seconds = []
    for _ in watch(drive.ends()):
        clock = Clock()
        for _ in range(KEYFRAMES_PER_TICK):
            isam.add_node(clock)
        started = time.perf_counter()
        isam.estimate()
        seconds.append(clock.seconds + time.perf_counter() - started)
    found = isam.answer(Clock())
    known = rotations.inverse(found.body_from_world).numpy()
    ticks = 1e3 * np.array(seconds)
    return TicksRow("iSAM2 on poses", ticks, np.zeros(len(ticks)), before.seconds, _error_deg(known, run))


def _error_deg(world_from_body: np.ndarray, run: SimulatedRun) -> float:
    """Mean over the keyframes."""
    errors = orientation_errors(body_from_world(world_from_body), body_from_world(run.world_from_body))
    return float(torch.rad2deg(errors).mean())


@contextmanager
def _busy(count: int) -> Iterator[None]:
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
