"""Publishing a bag's messages live, as they were serialised, paced by the bag's time."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from rotavg_ros.bags.reader import BagMessage, BagReader
from rotavg_ros.errors import UserError
from rotavg_ros.stamps import NANOSECONDS

# Number of messages that a publisher keeps for retransmission. Fast DDS asks its readers what they lack every 3 s.
_DEPTH = 10_000
_ACKNOWLEDGE_TIMEOUT_S = 10.0
_CLOCK_TOPIC, _CLOCK_PERIOD_NS = "/clock", 10_000_000
# Subscribers of one process do not appear at once: start when their number has been constant for this long.
_SETTLE_SECONDS = 0.5
_CATCH_UP_SECONDS = 0.01


class PlayError(UserError):
    """A bag that cannot be played as asked for; the message says why."""


@dataclass(frozen=True)
class PlayOptions:
    """How to play.

    Attributes:
        rate: bag seconds per second; 0: as fast as ``max_messages_per_second`` allows.
        topics: only these; default: all whose message types are installed.
        wait_for_subscribers_s: how long to wait for subscribers; 0: do not wait.
        clock: whether to publish the bag's time on ``/clock``.
        max_messages_per_second: limit on bursts, which transports would otherwise lose.
    """

    rate: float = 1.0
    topics: tuple[str, ...] | None = None
    wait_for_subscribers_s: float = 10.0
    clock: bool = False
    max_messages_per_second: float = 3000.0


@dataclass(frozen=True)
class Playback:
    """What was played: messages per topic, topics left out with the reason, wall-clock seconds."""

    messages: dict[str, int]
    left_out: dict[str, str]
    seconds: float


def play(
    path: str,
    options: PlayOptions,
    watch: Callable[[Iterator[BagMessage], int], Iterator[BagMessage]] = lambda messages, total: messages,
) -> Playback:
    """Publish a bag's messages and return when every reliable subscriber has them.

    Args:
        path: a ROS 2 bag.
        options: how.
        watch: is given the messages and their number and passes them on (a progress bar).

    Raises:
        BagReadError: an unreadable bag, or no such topic.
        PlayError: a ROS 1 bag, an impossible option, a message type that is not installed, no subscribers, or a
            reliable subscriber that does not get everything.
    """
    _check(options)
    with BagReader(path) as bag:
        if not bag.is_ros2:
            raise PlayError(f"{path}: is a ROS 1 bag; convert it first: rosbags-convert --src {path} --dst BAG")
        types, left_out = _message_types(path, bag, options.topics)
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        try:
            player = _Player(bag, types, options)
            try:
                player.wait_for_subscribers()
                start = time.monotonic()
                player.publish(watch(bag.messages(types), bag.num_messages(types)))
                player.wait_until_all_is_received()
                return Playback(player.counts, left_out, time.monotonic() - start)
            finally:
                player.node.destroy_node()
        finally:
            rclpy.shutdown()


class _Player:
    def __init__(self, bag: BagReader, types: dict[str, Any], options: PlayOptions) -> None:
        self._options = options
        self.node: Node = rclpy.create_node("rotavg_player", start_parameter_services=False)
        self._publishers: dict[str, Publisher] = {}
        for topic, message_type in types.items():
            # Reliable publishers serve best-effort subscribers, too.
            durability = DurabilityPolicy.TRANSIENT_LOCAL if bag.is_latched(topic) else DurabilityPolicy.VOLATILE
            qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
            self._publishers[topic] = self.node.create_publisher(message_type, topic, qos)
        self._clock = self.node.create_publisher(Clock, _CLOCK_TOPIC, 10) if options.clock else None
        self.counts = dict.fromkeys(types, 0)

    def wait_for_subscribers(self) -> None:
        deadline = time.monotonic() + self._options.wait_for_subscribers_s
        settled_at, seen = 0.0, 0
        while self._options.wait_for_subscribers_s > 0:
            now = time.monotonic()
            count = sum(publisher.get_subscription_count() for publisher in self._publishers.values())
            if count != seen:
                seen, settled_at = count, now + _SETTLE_SECONDS
            if seen and now >= settled_at:
                return
            if now > deadline:
                raise PlayError(
                    f"nobody subscribed to {', '.join(self._publishers)} within "
                    f"{self._options.wait_for_subscribers_s:g} s; start the node first, or give "
                    "--wait-for-subscribers 0"
                )
            time.sleep(0.02)

    def publish(self, messages: Iterator[BagMessage]) -> None:
        shortest = 1 / self._options.max_messages_per_second
        due = start = time.monotonic()
        first_ns = clock_ns = None
        for message in messages:
            first_ns = message.time_ns if first_ns is None else first_ns
            if self._options.rate > 0:
                due = max(due, start + (message.time_ns - first_ns) / 1e9 / self._options.rate)
            ahead = due - time.monotonic()
            if ahead > 0.001:  # shorter sleeps take longer than they should
                time.sleep(ahead)
            # After a delay, go on at the bounded pace instead of catching up in one burst.
            due = max(due, time.monotonic() - _CATCH_UP_SECONDS) + shortest
            if self._clock is not None and (clock_ns is None or message.time_ns - clock_ns >= _CLOCK_PERIOD_NS):
                clock_ns = message.time_ns
                self._clock.publish(_clock_message(clock_ns))
            self._publishers[message.topic].publish(bytes(message.data))
            self.counts[message.topic] += 1

    def wait_until_all_is_received(self) -> None:
        deadline = time.monotonic() + _ACKNOWLEDGE_TIMEOUT_S
        publishers = self._publishers if self._clock is None else {**self._publishers, _CLOCK_TOPIC: self._clock}
        lacking = [
            topic
            for topic, publisher in publishers.items()
            if not publisher.wait_for_all_acked(Duration(seconds=max(0.0, deadline - time.monotonic())))
        ]
        if lacking:
            raise PlayError(
                f"all was played, but {_ACKNOWLEDGE_TIMEOUT_S:g} s later a reliable subscriber of {', '.join(lacking)} "
                "has not got everything; see whether it hangs"
            )


def _check(options: PlayOptions) -> None:
    if not 0 <= options.rate < float("inf"):
        raise PlayError(f"the rate is {options.rate:g}; use a positive number, or 0 for as fast as possible")
    if not 0 < options.max_messages_per_second < float("inf"):
        raise PlayError("the bound of messages per second must be positive")


def _message_types(path: str, bag: BagReader, wanted: Collection[str] | None) -> tuple[dict[str, Any], dict[str, str]]:
    """Message classes of the topics to play, and why others are left out."""
    recorded = bag.topics
    if wanted is not None and (missing := [topic for topic in wanted if topic not in recorded]):
        raise PlayError(f"{path}: no topic {', '.join(missing)}; the bag has {', '.join(recorded)}")
    types, left_out = {}, {}
    for topic, name in recorded.items():
        if wanted is not None and topic not in wanted:
            continue
        package, _, kind = name.partition("/msg/")
        try:
            types[topic] = getattr(importlib.import_module(f"{package}.msg"), kind)
        except (ImportError, AttributeError):
            left_out[topic] = f"{name} is not installed"
    if wanted is not None and left_out:
        topic, reason = next(iter(left_out.items()))
        raise PlayError(f"{path}: {topic} cannot be played: {reason}; install the package {reason.split('/')[0]}")
    if not types:
        raise PlayError(f"{path}: nothing to play: {'; '.join(left_out.values()) or 'the bag has no topics'}")
    return types, left_out


def _clock_message(time_ns: int) -> Clock:
    message = Clock()
    message.clock.sec, message.clock.nanosec = divmod(time_ns, NANOSECONDS)
    return message
