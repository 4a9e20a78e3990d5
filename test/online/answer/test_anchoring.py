"""Where the odometry's frame lies: by the newest keyframe that odometry covers, found without looking at all others."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference
from rotavg_ros.online.answer.anchoring import corrections
from rotavg_ros.online.answer.last_answer import LastAnswer
from rotavg_ros.online.graph.builder import GraphBuilder
from rotavg_ros.online.graph.growth import Growth
from rotavg_ros.online.measurements import OdometryMessage, RejectedInputError
from rotavg_ros.online.odometry.samples import OdometrySamples

SECOND = 1_000_000_000
UNIX = 1_700_000_000 * SECOND


def builder_of(odometry_ns: list[int], keyframes_ns: list[int], seed: int = 0) -> GraphBuilder:
    """Odometry that jumps now and then, and a front end's keyframes."""
    random = np.random.default_rng(seed)
    builder = GraphBuilder(Growth.begin(EstimatorOptions(keyframe_source="edges", time_jump_s=0.5), LastAnswer()))
    heading = 0.0
    for stamp_ns in odometry_ns:
        heading += 0.01 if random.random() < 0.9 else 2.0
        _, since_jump = builder.add_odometry(OdometryMessage("r", stamp_ns, rotation(heading), None))
        if since_jump:
            builder.begin_time_line("r", len(since_jump))
            for message in since_jump:
                builder.add_odometry(message)
    ends = [KeyframeReference("r", number, stamp_ns) for number, stamp_ns in enumerate(keyframes_ns)]
    for number, (source, target) in enumerate(pairwise(ends)):
        builder.add_edge(EdgeMeasurement(number, source, target, (0.0, 0.0, 0.0, 1.0), 0))
    return builder


def rotation(heading: float) -> list[float]:
    return Rotation.from_euler("z", heading).as_quat().tolist()


def by_all_keyframes(builder: GraphBuilder, body_from_world: torch.Tensor) -> np.ndarray | None:
    """The correction by the newest keyframe on the present chain that odometry tells of."""
    track, graph = builder.tracks["r"], builder.graph
    found = []
    for node in range(min(graph.num_keyframes, len(body_from_world))):
        stamp_ns, line = graph.moment_of(node)
        try:
            odometry = track.samples.world_from_body_at(stamp_ns, line)
        except RejectedInputError:
            continue
        if (track.samples.chain_at(stamp_ns, line), line) == (track.chain, track.time_line):
            found.append((stamp_ns, node, odometry))
    if not found:
        return None
    _, node, odometry = max(found)
    return (Rotation.from_quat(odometry) * Rotation.from_quat(body_from_world[node])).inv().as_quat(canonical=True)


@pytest.mark.parametrize("seed", range(60))
def test_it_is_by_the_newest_keyframe_that_the_present_odometry_covers(seed: int) -> None:
    """Odometry with gaps, jumps and a clock that goes back; keyframes before, among and after its messages."""
    random = np.random.default_rng(seed)
    odometry_s = np.cumsum(random.choice([0.1, 0.3, 7.0], p=[0.6, 0.3, 0.1], size=random.integers(1, 40)))
    if seed % 3 == 0:
        odometry_s = np.append(odometry_s, odometry_s[: random.integers(1, len(odometry_s) + 1)])
    keyframes_s = np.sort(random.uniform(-1, max(0, odometry_s.max() + random.choice([-2, 0.1, 3])), size=20))
    builder = builder_of(*((UNIX + (1e9 * stamps).astype(int)).tolist() for stamps in (odometry_s, keyframes_s)), seed)
    answered = int(random.integers(0, builder.graph.num_keyframes + 1))
    body_from_world = torch.from_numpy(Rotation.random(20, random_state=seed).as_quat())[:answered]
    found, expected = corrections(builder, body_from_world).get("r"), by_all_keyframes(builder, body_from_world)
    assert (found is None) == (expected is None)
    if found is not None:
        assert abs(np.dot(found, expected)) == pytest.approx(1, abs=1e-9)


def test_keyframes_of_another_clock_are_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """A front end whose stamps count from boot, beside odometry since 1970: it is all done under the lock."""
    looked_at = []
    known = OdometrySamples.world_from_body_at
    builder = builder_of([UNIX + index * SECOND for index in range(10)], [SECOND * index for index in range(1, 500)])
    monkeypatch.setattr(OdometrySamples, "world_from_body_at", lambda *args: looked_at.append(args) or known(*args))
    body_from_world = torch.tensor([[0.0, 0.0, 0.0, 1.0]] * builder.graph.num_keyframes)
    assert builder.graph.num_keyframes == 499
    assert corrections(builder, body_from_world) == {} and looked_at == []
