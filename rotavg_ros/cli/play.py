"""What ``rotavg play`` does: it publishes a bag and says what was played."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

from rotavg_ros.bags.reader import BagMessage
from rotavg_ros.cli.progress import progress
from rotavg_ros.errors import UserError


class PlayNeedsRosError(UserError):
    """ROS 2 is missing; playing is the only use of bags that needs it."""


def run(arguments: argparse.Namespace) -> int:
    """Play and say what was played."""
    try:
        from rotavg_ros.ros.harness.player import PlayOptions, play
    except ImportError as error:
        raise PlayNeedsRosError(
            f"playing needs ROS 2's rclpy ({error}); source your ROS 2 setup, or run `make setup` in the sources"
        ) from None

    options = PlayOptions(
        rate=arguments.rate,
        topics=None if arguments.topics is None else tuple(arguments.topics),
        wait_for_subscribers_s=arguments.wait_for_subscribers,
        clock=arguments.clock,
        max_messages_per_second=arguments.max_messages_per_second,
    )
    playback = play(str(arguments.bag), options, _with_bar)
    for topic, reason in playback.left_out.items():
        print(f"rotavg: {topic} left out: {reason}", file=sys.stderr)
    counts = ", ".join(f"{count} on {topic}" for topic, count in playback.messages.items())
    print(f"played {sum(playback.messages.values())} messages in {playback.seconds:.1f} s: {counts}")
    return 0


def _with_bar(messages: Iterator[BagMessage], total: int) -> Iterator[BagMessage]:
    return progress(messages, description="playing", total=total, unit="msg")
