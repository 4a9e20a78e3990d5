"""A graph that a bag repeats, of which the estimator could not keep a closure at first."""

from __future__ import annotations

from types import SimpleNamespace as Fields

from rotavg_ros.online import EstimatorOptions, OnlineEstimator
from rotavg_ros.replay.feed import Feed
from rotavg_ros.replay.plan import Input, Plan
from rotavg_ros.settings.parameters import NodeParameters

MAP_GRAPH = "rtabmap_msgs/msg/MapGraph"


def link(source: int, target: int, kind: int) -> Fields:
    rotation, translation = Fields(x=0.0, y=0.0, z=0.0, w=1.0), Fields(x=1.0, y=0.0, z=0.0)
    transform = Fields(rotation=rotation, translation=translation)
    return Fields(from_id=source, to_id=target, type=kind, transform=transform, information=[1.0] * 36)


def graph(*links: Fields) -> Fields:
    return Fields(header=Fields(stamp=Fields(sec=1000, nanosec=0)), poses_id=[], links=links)


def test_a_closure_that_had_to_go_comes_in_with_a_later_graph() -> None:
    online = OnlineEstimator(EstimatorOptions(keyframe_source="edges", pending_capacity=1), lambda *_, **__: None)
    parameters = NodeParameters().changed({"edge_topics": (f"graph:{MAP_GRAPH}",), "keyframe_source": "edges"})
    plan = Plan(parameters, (), (Input("graph", MAP_GRAPH),), {}, ())
    feed = Feed(online, plan, Fields(edge_of_body=lambda edge, *_: edge), lambda *_: None)
    closures = link(0, 4, 1), link(1, 5, 1)
    feed("graph", graph(*(link(step, step + 1, 0) for step in range(3)), *closures))
    assert online.counts().rejected == {"pending_overflow": 1}
    for _ in range(2):
        feed("graph", graph(*(link(step, step + 1, 0) for step in range(5)), *closures))
    assert online.counts().edges == 7 and online.counts().rejected == {"pending_overflow": 1}
