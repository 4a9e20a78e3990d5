"""Where a robot's odometry frame lies in the world, and so where the robot is now, also between two answers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online import quaternion
from rotavg_ros.online.answer.answer import Answer
from rotavg_ros.online.answer.trajectory import Trajectory
from rotavg_ros.online.graph.builder import GraphBuilder
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.odometry.continuity import OdometrySample
from rotavg_ros.online.odometry.steps import OdometrySteps, StepSize
from rotavg_ros.online.odometry.track import OdometryTrack
from rotavg_ros.online.quaternion import Quaternion, Vector
from rotavg_ros.view_graph import EdgeKind

# Largest x and y of a quaternion that counts as a rotation about z, and largest way along z that counts as none, as a
# share of the longest step.
_PLANAR = 1e-6


@dataclass(frozen=True)
class Drift:
    """Variances per component of a pose that no answer has corrected yet.

    Attributes:
        orientation, position: of the keyframe that the pose is derived from, rad² and m², relative to the first
            keyframe of its component.
        step_orientation, step_position: of a step of odometry, rad² and m². NaN where the answer does not say.
    """

    orientation: float
    position: float
    step_orientation: float
    step_position: float

    def after(self, steps: int, way: float, square_lever: float | None = None) -> tuple[float, float]:
        """Variances of orientation and position, rad² and m², beyond the keyframe.

        Args:
            steps: steps of odometry since the keyframe.
            way: distance from the keyframe, metres; over it the keyframe's error of orientation moves the position.
            square_lever: mean square distance from where the steps were made, m²; default: that of steps straight on.
        """
        grown, lever = steps * self.step_orientation, way**2 / 3 if square_lever is None else square_lever
        position = self.position + steps * self.step_position + self.orientation * way**2 + grown * lever
        return self.orientation + grown, position


UNKNOWN_DRIFT = Drift(math.nan, math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class OdometryFrame:
    """The pose of a robot's odometry frame in the world, from the robot's newest keyframe that an answer has placed.

    Attributes:
        chain: number of the odometry chain.
        orientation: world_from_odometry, xyzw.
        origin: position of the odometry frame's origin in the world, metres.
        keyframe_position: position of that keyframe in the odometry frame, metres.
        keyframes_before: number of keyframes that the robot's odometry had made up to that one.
        steps: of odometry since that keyframe; None where odometry chooses the keyframes, and so counts them.
        drift: variances of poses derived from the frame.
        axis: of the world, about which alone the robot has turned, a unit vector; None if it has turned otherwise, too.
        is_planar: whether there is such an axis, and the robot has moved across it only.
    """

    chain: int
    orientation: Quaternion
    origin: Vector
    keyframe_position: Vector
    keyframes_before: int = 0
    steps: OdometrySteps | None = None
    drift: Drift = UNKNOWN_DRIFT
    axis: Vector | None = None
    is_planar: bool = False

    @classmethod
    def through(
        cls,
        chain: int,
        world_from_odometry: Quaternion,
        position: Vector,
        odometry_position: Vector,
    ) -> OdometryFrame:
        """The frame so turned, with a body at ``odometry_position`` in it at ``position`` in the world, metres."""
        turned = quaternion.rotate(world_from_odometry, odometry_position)
        return cls(chain, world_from_odometry, quaternion.difference(position, turned), odometry_position)

    def variances_at(self, odometry_position: Vector, steps: int) -> tuple[float, float]:
        """Variances of orientation and position, rad² and m², at a position so many steps after the keyframe."""
        lever = None if self.steps is None else self.steps.square_lever(odometry_position)
        return self.drift.after(steps, math.dist(odometry_position, self.keyframe_position), lever)

    def place(self, odometry_position: Vector) -> Vector:
        """A point of the odometry's frame in the world, metres."""
        x, y, z = quaternion.rotate(self.orientation, odometry_position)
        return (x + self.origin[0], y + self.origin[1], z + self.origin[2])


def first_frame(track: OdometryTrack, world_from_odometry: Quaternion) -> OdometryFrame | None:
    """The frame before the first answer: odometry's positions are taken as they are; None where it has none."""
    if track.latest is None or track.latest.position is None:
        return None
    at = track.latest.position
    return OdometryFrame.through(track.chain, world_from_odometry, at, at)


def next_frame(before: OdometryFrame, track: OdometryTrack, world_from_odometry: Quaternion) -> OdometryFrame | None:
    """The frame of the chain that has just begun; as a best guess, it begins where the robot was last."""
    last, first = track.samples.seam(track.chain)
    if last.position is None or first.position is None:
        return None
    return OdometryFrame.through(track.chain, world_from_odometry, before.place(last.position), first.position)


def placed_frames(
    answer: Answer, trajectories: Mapping[str, Trajectory], builder: GraphBuilder
) -> dict[str, OdometryFrame]:
    """The frames of robots whose present odometry covers their newest keyframe in the answer and has positions there.

    Args:
        answer: the last answer.
        trajectories: of its keyframes.
        builder: its graph may have grown since.
    """
    turns_about_z = bool((np.abs(answer.target_from_source[:, :2]) < _PLANAR).all())
    is_planar = turns_about_z and _moves_across_z(answer)
    step_variances = _step_variances(answer)
    chosen_by_front_end = builder.options.keyframe_source == "edges"
    found = {}
    for robot, trajectory in trajectories.items():
        track = builder.tracks.get(robot)
        if track is None or track.latest is None:
            continue
        newest = len(trajectory.node) - 1
        moment = int(trajectory.stamp_ns[newest]), int(trajectory.time_line[newest])
        position = tuple(trajectory.position[newest].tolist())
        odometry_position = track.samples.position_at(*moment)
        if track.samples.chain_at(*moment) != track.chain or not all(map(math.isfinite, position + odometry_position)):
            continue
        try:
            odometry = track.samples.world_from_body_at(*moment)
        except RejectedInputError:
            continue
        x, y, z, w = trajectory.world_from_body[newest].tolist()
        world_from_odometry = quaternion.normalize(quaternion.multiply((x, y, z, w), quaternion.inverse(odometry)))
        frame = OdometryFrame.through(track.chain, world_from_odometry, position, odometry_position)
        node = int(trajectory.node[newest])
        deviation = float(answer.uncertainty[node])
        steps = None
        if chosen_by_front_end:
            keyframe = OdometrySample(moment[0], odometry, odometry_position)
            steps = OdometrySteps(_step_size(answer, robot), moment[1], keyframe, track.latest)
        place = math.nan if answer.position_uncertainty is None else float(answer.position_uncertainty[node])
        found[robot] = replace(
            frame,
            keyframes_before=track.num_keyframes - _keyframes_since(builder, robot, moment),
            steps=steps,
            drift=Drift(deviation**2, place**2, *step_variances),
            axis=_z_axis((x, y, z, w)) if turns_about_z else None,
            is_planar=is_planar,
        )
    return found


def _moves_across_z(answer: Answer) -> bool:
    """Whether no edge leads along the z axis of the bodies."""
    lengths = np.abs(np.nan_to_num(answer.translation))
    return bool(lengths[:, 2].max(initial=0.0) <= _PLANAR * lengths.max(initial=0.0))


def _z_axis(world_from_body: Quaternion) -> Vector:
    """The body's z axis in the world; components that are too small to be told from 0 are 0."""
    x, y, z = (0.0 if abs(part) < _PLANAR else part for part in quaternion.rotate(world_from_body, (0.0, 0.0, 1.0)))
    return (x, y, z)


def _step_size(answer: Answer, robot: str) -> StepSize:
    """The step between a robot's keyframes, by those odometry edges that stand for one step."""
    of_robot = answer.keyframe_robot[answer.source] == answer.robots.index(robot)
    steps = of_robot & (answer.kind == EdgeKind.ODOMETRY) & (answer.steps == 1)
    angle = 2 * np.arccos(np.abs(answer.target_from_source[steps, 3]).clip(max=1.0))
    distance = np.linalg.norm(answer.translation[steps], axis=1)
    return StepSize(*(_root_mean_square(values[np.isfinite(values)]) for values in (angle, distance)))


def _root_mean_square(values: NDArray[np.float64]) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0


def _keyframes_since(builder: GraphBuilder, robot: str, moment: tuple[int, int]) -> int:
    stamps, lines = builder.graph.moments(robot)
    stamp_ns, line = moment
    return int(((lines > line) | ((lines == line) & (stamps > stamp_ns))).sum())


def _step_variances(answer: Answer) -> tuple[float, float]:
    """Variances of a step of odometry per component, rad² and m²."""
    if answer.edge_precision is None:
        return answer.step_deviation**2, math.nan
    odometry = answer.kind == EdgeKind.ODOMETRY
    told = odometry & (answer.edge_precision[:, 1] > 0)
    if not told.any():
        return answer.step_deviation**2, math.nan
    return answer.step_deviation**2, float(np.median(1 / (answer.edge_precision[told, 1] * answer.steps[told])))
