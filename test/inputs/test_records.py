"""What a source says of robots."""

from __future__ import annotations

from rotavg_ros.inputs import Source


def test_numbers_of_robots() -> None:
    assert [Source("", ("red", "blue")).robot_of(number) for number in (0, 1, 2)] == ["red", "blue", "2"]
    assert [Source("", ("7", "0")).robot_of(number) for number in (0, 1, 7)] == ["0", "1", "7"]
