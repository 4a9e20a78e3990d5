"""Paths and markers for those who look: drawn when somebody does, and again where drawing has failed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.ros.node.output import outputs
from rotavg_ros.settings.parameters import NodeParameters


@dataclass(eq=False)
class Output:
    get_subscription_count: Callable[[], int]
    publish: Callable[[object], None]


class Pictures:
    """What the node draws, with publishers that note what goes out."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.watchers = 1
        self.drawn: list[str] = []
        monkeypatch.setattr(outputs, "publisher", self._publisher)
        monkeypatch.setattr(outputs, "_REST", 0.0)
        self.estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges"))
        parameters = NodeParameters(robots=("a", "b"), odometry_topics=("/a", "/b"))
        monkeypatch.setattr(outputs, "RobotPoses", lambda *_: SimpleNamespace(are_wanted=False))
        self.outputs = outputs.Outputs(SimpleNamespace(), parameters, self.estimator)

    def _publisher(self, _: object, message_type: type, topic: str, qos: object) -> Output:
        return Output(lambda: self.watchers, lambda message: self.drawn.append(topic))

    def answer(self, number: int) -> Answer:
        ends = (KeyframeReference("a", number), KeyframeReference("a", number + 1))
        self.estimator.add_edge(EdgeMeasurement(number, *ends, (0.0, 0.0, 0.0, 1.0), kind=0))
        answer = self.estimator.tick()
        assert answer is not None
        return answer

    def goes_out(self, answer: Answer | None) -> list[str]:
        self.drawn.clear()
        self.outputs.draw(answer)
        return list(self.drawn)


ALL = ["a/corrected_path", "b/corrected_path", "~/markers"]


def test_pictures_are_drawn_once_for_each_answer_and_for_who_comes_later(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = Pictures(monkeypatch)
    first, second = pictures.answer(0), pictures.answer(1)
    assert [pictures.goes_out(first) for _ in range(2)] == [ALL, []]
    assert [pictures.goes_out(second) for _ in range(2)] == [ALL, []]
    pictures.watchers = 2
    assert [pictures.goes_out(second) for _ in range(2)] == [ALL, []]
    pictures.watchers = 1
    assert pictures.goes_out(second) == []
    pictures.watchers = 2  # somebody else
    assert [pictures.goes_out(second) for _ in range(2)] == [ALL, []]
    assert [pictures.goes_out(None) for _ in range(2)] == [ALL, []]


def test_nothing_is_drawn_or_taken_back_for_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = Pictures(monkeypatch)
    pictures.watchers = 0
    answer = pictures.answer(0)
    assert pictures.goes_out(answer) == [] == pictures.goes_out(None)
    pictures.watchers = 1
    assert pictures.goes_out(answer) == ALL


def test_what_could_not_be_drawn_is_drawn_later(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = Pictures(monkeypatch)
    answer = pictures.answer(0)
    with monkeypatch.context() as broken:
        broken.setattr(outputs, "markers_message", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            pictures.goes_out(answer)
    assert [pictures.goes_out(answer) for _ in range(2)] == [["~/markers"], []]
