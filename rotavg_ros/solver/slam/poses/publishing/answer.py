"""The published answer where translations are known: poses of all keyframes, and probabilities of false closures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.noise.exceedance import OUTLIER_ANGLE, exceedance
from rotavg_ros.solver.slam.poses.closures import GOOD, Predictions
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.publishing.inner_nodes import poses_of_nodes
from rotavg_ros.solver.slam.poses.publishing.uncertainty import variances
from rotavg_ros.solver.slam.poses.row_errors import closure_turns, mean_over_axes, mean_turn
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.publishing.modes import FAR_TURN, LIKELY, warning_of_rivals
from rotavg_ros.solver.slam.stages import outlier_scores
from rotavg_ros.view_graph import FALSE_CLOSURE_M

# A warning is given for rivals that move a node by more than this many standard deviations, and than a false closure is
# off.
_FAR_SHIFT = 5.0
_FALSE = 0.5


@dataclass(frozen=True)
class Poses:
    """Poses of N nodes, and verdicts on M edges.

    Attributes:
        body_from_world: ``(N, 4)`` xyzw.
        position: ``(N, 3)`` metres, in the frame of the odometry's orientations; roots at the origin.
        variance: ``(N,)`` rad² per component, of orientations relative to the component's first node.
        position_variance: ``(N,)`` m² per component, in that node's frame.
        outlier_probability: ``(M,)`` that a closure is false, in rotation or place; that odometry's position jumped.
        rotation_probability: ``(M,)`` that a closure's rotation is false; that odometry slipped.
        precision: ``(M, 2)`` rad⁻² and m⁻² per component, with which edges count; 0 for unknown translations.
        warnings: of other labellings that are nearly as likely, in which a part of the map is turned or moved.
    """

    body_from_world: np.ndarray
    position: np.ndarray
    variance: np.ndarray
    position_variance: np.ndarray
    outlier_probability: np.ndarray
    rotation_probability: np.ndarray
    precision: np.ndarray
    warnings: tuple[str, ...] = ()


def answer(rivals: list[PoseMode], share: np.ndarray) -> tuple[Poses, int]:
    """Scores averaged over rival labellings, the poses of their median, and the median's index.

    Args:
        rivals: poses of the rival labellings.
        share: their probabilities.
    """
    single = [_of_mode(pose) for pose in rivals]
    seen = [_seen_from(rivals[0].problem.drawn.first, each) for each in single]
    orientations = [np.ascontiguousarray(other.body_from_world.T) for other in seen]
    middle = _median(seen, share)
    chosen, base = single[middle], quaternion_rows.inverse(orientations[middle])
    turns = np.array([quaternion_rows.log(quaternion_rows.multiply(base, other)) for other in orientations])
    shifts = np.array([other.position - seen[middle].position for other in seen])
    k, m = rivals[0].problem.turns, rivals[0].problem.shifts

    def mixed(name: str) -> np.ndarray:
        return np.tensordot(share, np.array([getattr(other, name) for other in single]), 1)

    poses = Poses(
        chosen.body_from_world,
        chosen.position,
        mixed("variance") + np.tensordot(share, (turns**2).sum(axis=1), 1) / k,
        mixed("position_variance") + np.tensordot(share, (shifts**2).sum(axis=2), 1) / m,
        np.clip(mixed("outlier_probability"), 0.0, 1.0),
        np.clip(mixed("rotation_probability"), 0.0, 1.0),
        mixed("precision"),
        _warnings(rivals[middle].problem.graph.is_odometry.numpy(), seen, seen[middle], share, turns),
    )
    return poses, middle


def _median(seen: list[Poses], share: np.ndarray) -> int:
    """Index of the answer with the least mean distance to all, weighted by their shares.

    The distance is the mean over nodes of the length of a difference of poses. A turn counts in standard deviations of
    orientations, a shift in those of positions: a pose errs by both together, and neither radians nor metres say how
    much of a difference is one. The units are medians over all nodes and answers, one for the map: next to the first
    node deviations vanish, and where nothing holds a robot they are as large as the map.
    """
    units = [np.sqrt(np.median([getattr(each, name) for each in seen])) for name in ("variance", "position_variance")]
    of_turns, of_shifts = np.maximum(units, np.finfo(np.float64).tiny).tolist()

    def distance(one: Poses, other: Poses) -> float:
        cosine = np.abs((one.body_from_world * other.body_from_world).sum(axis=1))
        shift = np.linalg.norm(one.position - other.position, axis=1)
        return float(np.hypot(2 * np.arccos(np.minimum(cosine, 1.0)) / of_turns, shift / of_shifts).mean())

    return int(np.argmin(np.array([[distance(one, other) for other in seen] for one in seen]) @ share))


def _seen_from(first: np.ndarray, poses: Poses) -> Poses:
    """Poses in the frame of each node's first one ``(N,)``, as they are stated in the end."""
    frame = torch.from_numpy(poses.body_from_world[first])
    orientation = rotations.multiply(torch.from_numpy(poses.body_from_world), rotations.inverse(frame))
    position = rotations.rotate(frame, torch.from_numpy(poses.position - poses.position[first]))
    return replace(poses, body_from_world=rotations.normalize(orientation).numpy(), position=position.numpy())


def _warnings(
    is_odometry: np.ndarray, rivals: list[Poses], chosen: Poses, share: np.ndarray, turns: np.ndarray
) -> tuple[str, ...]:
    """Warnings about the differences between rivals, if a likely one turns or moves a part of the map by far.

    Args:
        is_odometry: ``(M,)`` bool.
        rivals, chosen: each one's answer, and that which is published, seen from the first nodes.
        share: their probabilities.
        turns: ``(R, 3, N)`` rad, by which each rival's orientations differ from the published ones.
    """
    turned = np.sqrt((turns**2).sum(axis=1)).max(axis=1)
    moved = np.array([np.linalg.norm(other.position - chosen.position, axis=1) for other in rivals])
    beyond = moved * (moved > _FAR_SHIFT * np.sqrt(chosen.position_variance))
    shifted = beyond.max(axis=1, initial=0.0)
    is_turned, is_shifted = turned > FAR_TURN, shifted > FALSE_CLOSURE_M
    others = np.flatnonzero((share >= LIKELY) & (is_turned | is_shifted))
    if len(others) == 0:
        return ()
    false = np.array([other.outlier_probability > _FALSE for other in rivals])
    differs = (false[others] != (chosen.outlier_probability > _FALSE)).any(axis=0)
    changes = [f"turn parts of the map by up to {np.degrees(turned[others].max()):.0f}°"] * bool(
        is_turned[others].any()
    )
    changes += [f"move parts of the map by up to {shifted[others].max():.1f} m"] * bool(is_shifted[others].any())
    closures, steps = int(differs[~is_odometry].sum()), int(differs[is_odometry].sum())
    return (warning_of_rivals(float(share[others].sum()), closures, steps, " and ".join(changes)),)


def _of_mode(pose: PoseMode) -> Poses:
    """One labelling's answer."""
    problem, drawn = pose.problem, pose.problem.drawn
    nodes = poses_of_nodes(pose)
    of_restated = _scores_of_restated(pose, nodes.body_from_world, nodes.position)
    score, rotation = (outlier_scores(drawn, *each) for each in zip(_scores(pose), of_restated, strict=True))
    if problem.jump is not None:
        score = np.maximum(score, problem.jump > 0)
    told = *variances(pose, nodes), score, rotation, _precision(pose)
    return Poses(nodes.body_from_world, nodes.position, *told)


def _precision(pose: PoseMode) -> np.ndarray:
    """``(M, 2)`` rad⁻² and m⁻², with which the view-graph's edges count in the answer.

    A segment's weight, in the tails or not, is divided among its steps in proportion to their variances.
    """
    problem, noise, drawn = pose.problem, pose.state.noise, pose.problem.drawn
    closure, edges = problem.mode.problem.closure, problem.closures
    mean_square = problem.even_turns.mean_square
    turn = drawn.edge_values(mean_over_axes(problem, 1 / pose.solved.rotation_weight) * mean_square, np.inf)
    turn *= problem.drawn_steps.share
    slipped = drawn.edge_values((drawn.is_odometry & ~problem.mode.state.is_good).astype(np.float64), 0.0)
    slip = (problem.priors.slip * problem.typical) ** 2
    shift = noise.of_odometry(problem.travelled) + slipped * drawn.share_of_segment * slip
    if problem.jump is not None:
        shift += problem.jump
    # As the rows have it: beside the chain, what is rejected or slipped does not pull.
    beside = np.flatnonzero(drawn.is_beside)
    used = np.trace(pose.solved.covariance[beside], axis1=1, axis2=2) / problem.shifts
    shift[drawn.view_graph_edge[beside - drawn.num_segments]] = used
    turn[edges] = mean_square[closure] / pose.solved.rotation_weight[closure, 0]
    shift[drawn.restated.edge] = np.inf
    back = pose.solved.closure_back
    shift[edges] = np.einsum("cij,cij->c", back, back) / problem.shifts
    known = np.isfinite(problem.translation).all(axis=1)
    return np.asarray(np.stack((1 / turn, known / shift), axis=1))


def _scores(pose: PoseMode) -> tuple[np.ndarray, np.ndarray]:
    """``(E,)`` each: probability that a closure is false, in rotation or place; that an edge's rotation is false."""
    problem, places, mode = pose.problem, pose.solved.places, pose.problem.mode
    closure = mode.problem.closure
    own = closure_turns(problem, pose.state.noise) * problem.even_turns.mean_square[closure]
    alike = own + np.radians(problem.priors.turned_deg) ** 2
    right, wrong = pose.solved.predictions, pose.solved.predictions.wrong
    exceeds = [_turns_too_far(problem, *each) for each in ((right, own), (wrong, alike), (right, np.inf))]
    # Classes: right places, wrong ones that are seen nearly alike, and false rotations.
    turned = np.stack(exceeds).repeat((GOOD, len(places.chance) - GOOD - 1, 1), axis=0)
    rotation = 1 - mode.state.trusted
    rotation[closure] = (places.chance * turned).sum(axis=0)
    # A closure is an outlier if its error in rotation or place is too large, whatever its class.
    elsewhere = places.beyond(FALSE_CLOSURE_M) * problem.told.is_known
    score = np.zeros(len(rotation))
    score[closure] = (places.chance * (1 - (1 - turned) * (1 - elsewhere))).sum(axis=0)
    return score, rotation


def _turns_too_far(problem: PoseProblem, predictions: Predictions, variance: np.ndarray | float) -> np.ndarray:
    """``(C,)`` probability that a closure's turn errs by more than 10°.

    Args:
        problem: the graph.
        predictions: of its residual, by all else.
        variance: ``(C,)`` rad² per component, of its own error; infinite where nothing is known of it.
    """
    k, uneven = problem.turns, problem.told.uneven
    turn = np.sqrt((predictions.turn(uneven) ** 2).sum(axis=1))
    predicted = np.trace(uneven @ predictions.covariance[:, :k, :k] @ uneven, axis1=1, axis2=2) / k
    part = 1 / (1 + predicted / variance)
    return exceedance(part * turn, part * predicted, OUTLIER_ANGLE, k)


def _scores_of_restated(pose: PoseMode, body_from_world: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, ...]:
    """``(n,)`` each, as :func:`_scores`, of closures that are made of odometry, at given poses of all nodes."""
    problem, drawn, noise = pose.problem, pose.problem.drawn, pose.state.noise
    restated = drawn.restated
    if len(restated.edge) == 0:
        return np.zeros(0), np.zeros(0)
    turned, turn = drawn.off_odometry(body_from_world), restated.steps * mean_turn(problem, noise)
    rotation = exceedance(turned, turn, OUTLIER_ANGLE, problem.turns)
    source, target = restated.ends
    world_from_body = rotations.inverse(torch.from_numpy(body_from_world[source]))
    stated = rotations.rotate(world_from_body, torch.from_numpy(problem.translation[restated.edge])).numpy()
    off = np.linalg.norm(position[target] - position[source] - stated, axis=1)
    way = np.linalg.norm(stated, axis=1)
    shift = noise.of_odometry(np.stack((way, restated.steps), axis=1)) + turn * way**2
    place = np.where(np.isnan(off), 0.0, exceedance(off, shift, FALSE_CLOSURE_M, 3 if problem.shifts == 3 else 1))
    return 1 - (1 - rotation) * (1 - place), rotation
