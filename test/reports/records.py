"""Records of replays, made from simulated runs."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.online import Answer
from rotavg_ros.online.answer.trajectory import dead_reckoning
from rotavg_ros.replay.record import Reference, RobotRecord, RunRecord, TickRecord, TopicUse
from rotavg_ros.view_graph import EdgeKind


def simulated_run(keyframes: int, *, dimensions: int = 2, seed: int = 0) -> SimulatedRun:
    config = SlamSimulationConfig(
        world=World.CITY,
        dimensions=dimensions,
        num_keyframes=keyframes,
        min_closure_gap=min(50, keyframes // 3),
        keyframe_period_s=0.5,
        laps=3,
        terrain_tilt_deg=5.0 if dimensions == 3 else 0.0,
        odometry_noise_deg=0.4,
    )
    return simulate_slam_graph(config, np.random.default_rng(seed))


def answer_of(run: SimulatedRun) -> Answer:
    """A good answer: the truth, half a degree off, and scores that are right but not sure of themselves."""
    count = run.graph.num_nodes
    rng = np.random.default_rng(2)
    noise = Rotation.from_rotvec(rng.normal(scale=np.radians(0.3), size=(count, 3)))
    world_from_body = (Rotation.from_quat(run.world_from_body) * noise).as_quat(canonical=True)
    doubt = rng.beta(0.5, 8, size=run.graph.num_edges)
    score = np.where(run.closure_is_false, 1 - doubt, doubt)
    return Answer(
        version=7,
        robots=("robot",),
        keyframe_robot=np.zeros(count, dtype=np.int32),
        keyframe_id=np.arange(count, dtype=np.uint64),
        stamp_ns=run.stamps_ns,
        time_line=np.zeros(len(run.stamps_ns), dtype=np.int64),
        world_from_body=world_from_body,
        component=np.zeros(count, dtype=np.int64),
        uncertainty=np.radians(0.2 + 0.1 * rng.random(count)),
        edge_id=np.arange(run.graph.num_edges, dtype=np.uint64),
        source=run.graph.source.numpy(),
        target=run.graph.target.numpy(),
        kind=run.graph.kind.numpy(),
        target_from_source=run.graph.target_from_source.numpy(),
        precision=run.graph.precision.numpy(),
        translation=np.full((run.graph.num_edges, 3), np.nan),
        steps=run.graph.steps.numpy(),
        outlier_score=score,
        outlier=score > 0.5,
        waits=np.zeros(len(score), dtype=bool),
        was_cold=True,
        seconds=0.02,
        stage_seconds={"clean": 0.004, "bootstrap": 0.002, "refine": 0.014},
        method="neurora",
        profile="slam",
        device="cpu",
    )


def record_of(run: SimulatedRun) -> RunRecord:
    """A record with everything in it: positions, a reference, ticks, topics, refusals."""
    answer = answer_of(run)
    position = dead_reckoning(answer.world_from_body, run.odometry_world_from_body, run.odometry_position)
    world = Rotation.from_rotvec([0.0, 0.0, 0.7])  # the reference has a world of its own
    robot = RobotRecord(
        robot="robot",
        nodes=np.arange(len(run.stamps_ns)),
        stamp_ns=run.stamps_ns,
        time_line=np.zeros(len(run.stamps_ns), dtype=np.int64),
        keyframe_id=answer.keyframe_id,
        odometry_world_from_body=run.odometry_world_from_body,
        odometry_position=run.odometry_position,
        world_from_body=answer.world_from_body,
        position_dead_reckoned=position,
        position=position,
        uncertainty=answer.uncertainty,
        reference=Reference(
            name="ground_truth.tum",
            stamp_ns=run.stamps_ns,
            world_from_body=(world * Rotation.from_quat(run.world_from_body)).as_quat(),
            position=world.apply(run.position) + np.array([10.0, -5.0, 1.0]),
        ),
    )
    duration_s = float(run.stamps_ns[-1] - run.stamps_ns[0]) / 1e9
    return RunRecord(
        name="simulated_run",
        duration_s=duration_s,
        answer=answer,
        robots=(robot,),
        ticks=ticks_of(run, answer),
        topics=(
            TopicUse("/odom", "nav_msgs/msg/Odometry", len(run.stamps_ns), "odometry of robot"),
            TopicUse("/relative_rotations", "rotavg_msgs/msg/RelativeRotation", 200, "loop closures"),
            TopicUse("/camera", "sensor_msgs/msg/Image", 4000, "", "no orientation or relative rotation in it"),
        ),
        rejected={"duplicate_edge": 3, "stamp_out_of_range": 12, "nan_rotation": 0},
        options={"keyframe_angle_deg": 5.0, "odometry_topics": ["/odom"], "state_file": "", "warm_start": True},
        wall_seconds=3.2,
        interrupted=False,
    )


def ticks_of(run: SimulatedRun, answer: Answer, count: int = 40) -> tuple[TickRecord, ...]:
    rng = np.random.default_rng(1)
    ends = np.linspace(1, len(run.stamps_ns), min(count, len(run.stamps_ns)), dtype=int)
    newest = np.maximum(answer.source, answer.target)
    return tuple(
        TickRecord(
            stamp_ns=int(run.stamps_ns[end - 1]),
            seconds=0.002 + 2e-6 * end + 0.004 * rng.random() + (0.01 if number == len(ends) - 1 else 0.0),
            was_cold=number in (0, len(ends) - 1),
            keyframes=int(end),
            edges=int((newest < end).sum()),
            outliers=int(answer.outlier[newest < end].sum()),
            flips=int(rng.poisson(0.3)),
        )
        for number, end in enumerate(ends)
    )


def without_reference(record: RunRecord) -> RunRecord:
    return replace(record, robots=tuple(replace(robot, reference=None) for robot in record.robots))


def without_positions(record: RunRecord) -> RunRecord:
    nothing = {"odometry_position": None, "position_dead_reckoned": None, "position": None}
    return replace(record, robots=tuple(replace(robot, **nothing) for robot in record.robots))


def without_closures(record: RunRecord) -> RunRecord:
    answer = record.answer
    odometry = answer.kind == EdgeKind.ODOMETRY
    edges = ("edge_id", "source", "target", "kind", "outlier_score", "outlier")
    return replace(record, answer=replace(answer, **{name: getattr(answer, name)[odometry] for name in edges}))


def two_robots(record: RunRecord) -> RunRecord:
    """The run's two halves, as if two robots had driven them."""
    answer, (robot,) = record.answer, record.robots
    half = len(robot.nodes) // 2
    arrays = {field.name for field in fields(robot) if isinstance(getattr(robot, field.name), np.ndarray)}
    robots = tuple(
        replace(robot, robot=name, **{array: getattr(robot, array)[part] for array in arrays})
        for name, part in (("alpha", slice(None, half)), ("beta", slice(half, None)))
    )
    keyframe_robot = (np.arange(len(robot.nodes)) >= half).astype(np.int32)
    return replace(
        record, robots=robots, answer=replace(answer, robots=("alpha", "beta"), keyframe_robot=keyframe_robot)
    )
