"""What could not be read of a damaged bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from rosbags.highlevel import AnyReader

from rotavg_ros.bags.salvage import Losses


@dataclass
class Lost:
    """What is known about the losses so far.

    Attributes:
        recordings: losses of the damaged recordings.
        expected: number of messages according to the bag; None if that is lost as well.
        cause: why the bag as a whole could not be opened.
        undecodable: topic and time of messages that could not be decoded.
        problem: why nothing is read beyond some place; None: there is no such place.
        is_final: whether the whole bag has been examined.
    """

    recordings: Sequence[Losses] = ()
    expected: int | None = None
    cause: str | None = None
    undecodable: set[tuple[str, int]] = field(default_factory=set)
    problem: str | None = None
    is_final: bool = False

    def told(self, reader: AnyReader) -> str:
        """The losses in a line; ``reader`` reads what is left."""
        start_ns, end_ns = int(reader.start_time), int(reader.end_time)
        start_ns = min([start_ns, *(place.start_ns for losses in self.recordings for place in losses.chunks)])
        parts = [line for losses in self.recordings for line in losses.told(start_ns, end_ns)]
        parts += [] if parts or self.cause is None else [self.cause]
        topics = Counter(topic for topic, _ in self.undecodable)
        parts += [f"{count} × a message on {topic} that cannot be decoded" for topic, count in topics.items()]
        if self.problem is not None:
            parts.append(self.problem)
            return "; ".join(parts)
        left = sum(connection.msgcount for connection in reader.connections) - len(self.undecodable)
        of_all = "" if self.expected is None else f" of {self.expected}"
        return "; ".join([*parts, f"{left}{of_all} messages can be read"])
