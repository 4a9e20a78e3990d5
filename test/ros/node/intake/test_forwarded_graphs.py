"""Graphs on their way to a back end, without DDS: a newer graph stands for the older, parts wait until all was sent."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace as Fields

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rotavg_msgs.msg import RelativeRotation, RelativeRotationArray
from std_msgs.msg import Header

from rotavg_ros.inputs import EdgeRecord, Source
from rotavg_ros.online import EdgeMeasurement, KeyframeReference, OnlineEstimator
from rotavg_ros.ros.node.intake import adapters
from rotavg_ros.ros.node.intake.forwarding import ArrayForward, Forwarding, WholeGraphForward
from rotavg_ros.settings.parameters import NodeParameters


@dataclass
class Graph:
    """With edges by number; odd ones are closures."""

    edges: list[int] = field(default_factory=list)
    frame: str = ""

    def get_fields_and_field_types(self) -> dict[str, str]:
        return {"edges": "sequence<int>", "frame": "string"}


@dataclass
class Converter:
    sends_parts: bool
    edges_field: str = "edges"

    def closure_name(self, edge: int) -> tuple[str, int] | None:
        return ("r", edge) if edge % 2 else None


class Run:
    """A forward whose believed closures are set by hand."""

    def __init__(self, *, sends_parts: bool = False) -> None:
        self.sent: list[Graph] = []
        self.believed: set[int] = set()
        self.forward = WholeGraphForward("graph", Fields(publish=self.sent.append), Converter(sends_parts))
        self.forward.filter = Fields(passes=lambda name: name[1] in self.believed)

    def comes(self, *edges: int) -> None:
        assert list(self.forward.begin(Graph(list(edges), "map"), [])) == []

    def goes(self) -> list[list[int]]:
        """What goes out now."""
        self.sent.clear()
        self.forward.end()
        assert all(graph.frame == "map" for graph in self.sent)
        return [graph.edges for graph in self.sent]


def test_a_whole_graph_goes_out_when_it_comes_and_when_a_verdict_changes() -> None:
    run = Run()
    assert run.goes() == []
    run.comes(0, 1, 2, 3)
    assert run.goes() == [[0, 2]]
    assert run.goes() == []
    run.believed = {3}
    assert run.goes() == [[0, 2, 3]]
    run.comes(0, 1, 2, 3, 4)
    assert run.goes() == [[0, 2, 3, 4]]
    run.believed = {1, 3}
    assert run.goes() == [[0, 1, 2, 3, 4]]  # the newer graph stands for the older
    run.believed = {1}
    assert run.goes() == [[0, 1, 2, 4]]


def test_an_older_graph_never_goes_out_after_a_newer_one() -> None:
    """RTAB-Map's optimiser leaves closures out."""
    run = Run()
    run.comes(0, 1, 2)
    assert run.goes() == [[0, 2]]
    run.comes(0, 2, 4)
    assert run.goes() == [[0, 2, 4]]
    run.believed = {1}
    assert run.goes() == []
    run.comes(0, 1, 2)
    run.comes(0, 2, 3)
    assert run.goes() == [[0, 2]]
    run.believed = {1, 3}
    assert run.goes() == [[0, 2, 3]]


def test_parts_of_a_graph_all_go_out_and_what_is_believed_later_as_well() -> None:
    run = Run(sends_parts=True)
    run.comes(0, 1)
    run.comes(2)
    run.comes(4, 3, 5)
    run.believed = {3}
    assert run.goes() == [[0], [2], [4, 3]]
    run.comes(6)
    assert run.goes() == [[6]]
    run.believed = {1, 3, 5}
    assert run.goes() == [[0, 1], [4, 3, 5]]
    assert run.goes() == []
    run.comes(8)
    assert run.goes() == [[8]]


def test_after_a_reset_nothing_of_before_goes_out() -> None:
    run = Run()
    run.comes(0, 1)
    run.goes()
    run.comes(2, 3)
    run.forward.forget()
    assert run.goes() == []
    run.comes(0, 1)
    assert run.goes() == [[0]]


def test_a_closure_that_was_given_up_and_is_sent_again_goes_out_once(probe_node) -> None:
    """It waited for its keyframe for too long, so the estimator takes it once more."""
    options = {"forward_topics": ["edges:trusted"], "edge_topics": ["edges"], "pending_timeout_s": 5.0}
    parameters = NodeParameters().changed(options | {"keyframe_angle_deg": 0, "keyframe_distance_m": 0})
    online = OnlineEstimator(parameters.estimator)
    forwarding = Forwarding(probe_node, parameters, online)
    forward = forwarding.of(adapters.edge_topic("edges", Source("r")))
    sent: list[str] = []
    forward.send = sent.extend
    ends = KeyframeReference("r", 0), KeyframeReference("r", 20)
    record = EdgeRecord(EdgeMeasurement(7, *ends, (0.0, 0.0, 0.0, 1.0)), element="it")
    for second in range(30):
        if second in {0, 15}:
            forwarding.taken(forward, record, online.add_edge(record.edge), online.generation)
        online.add_odometry("r", (100 + second) * 10**9, (0.0, 0.0, 0.0, 1.0))
    assert online.counts().rejected == {"pending_timeout": 1} and online.counts().edges == 30
    assert forwarding.waiting == 1 and not forward.shares_names
    forwarding.decide(online.tick())
    assert sent == ["it"] and forwarding.waiting == 0


def test_edges_of_an_array_stay_in_its_frame() -> None:
    """Two cameras on one topic: what passed together went out under the last one's frame."""
    sent: list[RelativeRotationArray] = []
    entry = adapters.edge_topic("arrays:rotavg_msgs/msg/RelativeRotationArray", Source("r"))
    forward = ArrayForward(entry, Fields(publish=sent.append))
    frames = ["front", "front", "rear", "rear", "front"]
    forward.send([(Header(frame_id=frame), RelativeRotation(id=number)) for number, frame in enumerate(frames)])
    told = [(array.header.frame_id, [edge.id for edge in array.edges]) for array in sent]
    assert told == [("front", [0, 1]), ("rear", [2, 3]), ("front", [4])]
    forward.send([])
    assert len(sent) == 3
