"""Publish a bag's messages live over ROS 2, as they were recorded, stamps unchanged.

Waits for a subscriber first, and until every reliable subscriber has everything before it ends.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from rotavg_ros.bags.reader import BagMessage
from rotavg_ros.cli.arguments import non_negative_number, positive_number
from rotavg_ros.cli.progress import progress
from rotavg_ros.errors import UserError


class PlayNeedsRosError(UserError):
    """Playing is the one thing among bags that takes ROS 2."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg play``."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 folder, or a single .mcap or .db3")
    parser.add_argument(
        "--rate",
        type=non_negative_number,
        default=1.0,
        metavar="R",
        help="times real time; 0: as fast as possible (default: 1)",
    )
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="only these (default: all)")
    parser.add_argument(
        "--wait-for-subscribers",
        type=non_negative_number,
        default=10.0,
        metavar="SECONDS",
        help="give up if nobody listens by then; 0: do not wait (default: 10)",
    )
    parser.add_argument("--clock", action="store_true", help="publish the bag's time on /clock")
    parser.add_argument(
        "--max-messages-per-second",
        type=positive_number,
        default=3000.0,
        metavar="N",
        help="bound of bursts (default: 3000)",
    )


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
