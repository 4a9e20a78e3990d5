"""Sends closures that are believed on to a back end, in the same messages in which they came."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import groupby
from typing import Any, TypeGuard

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rotavg_msgs.msg import OutlierFlags
from std_msgs.msg import Header

from rotavg_ros.errors import UserError
from rotavg_ros.inputs import EdgeConverter, EdgeRecord, EdgeVerdict, WholeGraphConverter
from rotavg_ros.online import Answer, OnlineEstimator, RejectReason
from rotavg_ros.online.answer.closure_filter import ClosureFilter
from rotavg_ros.ros.node.intake.adapters import EdgeTopic
from rotavg_ros.ros.node.intake.serialized_array import as_message
from rotavg_ros.ros.node.output.conversions import flags_message
from rotavg_ros.ros.node.topics import publisher, user_error_about
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.view_graph import EdgeKind

# Most graphs that wait to be sent, or with edges that wait.
_MOST_GRAPHS = 1000


class Forward:
    """Forwards one edge topic: takes its messages apart and puts them together again.

    Attributes:
        topic: the topic that edges come from.
        filter: the closures that wait, and those that have passed.
        shares_names: whether different closures of one robot have the same id, those of other topics included.
    """

    def __init__(self, topic: str, output: Publisher) -> None:
        self.topic, self._output = topic, output
        self.filter: ClosureFilter[Any] = self._new_filter()
        self.shares_names = False

    def _new_filter(self) -> ClosureFilter[Any]:
        return ClosureFilter()

    def begin(self, message: Any, records: Iterable[EdgeRecord | EdgeVerdict]) -> Iterator[EdgeRecord | EdgeVerdict]:
        """The records of a message that has come, each with the element to send on for it."""
        for record in records:
            yield replace(record, element=message) if isinstance(record, EdgeRecord) else record

    def send(self, items: list[Any]) -> None:
        """Send on the items that may pass."""
        for item in items:
            self._output.publish(item)

    def end(self) -> None:
        """All decisions of an answer have been made."""

    def forget(self) -> None:
        """Begin anew, as the graph does."""
        self.filter, self.shares_names = self._new_filter(), False


class ArrayForward(Forward):
    """Forwards ``rotavg_msgs/RelativeRotationArray``: edges that pass together are sent together.

    The header of an array names the frame of those of its edges that name none, so frames stay apart.
    """

    def __init__(self, edges: EdgeTopic, output: Publisher) -> None:
        super().__init__(edges.topic, output)
        self._message_type, self._element_type = edges.message_type, edges.element_type

    def begin(self, message: Any, records: Iterable[EdgeRecord | EdgeVerdict]) -> Iterator[EdgeRecord | EdgeVerdict]:
        for record in records:
            if isinstance(record, EdgeRecord):
                yield replace(record, element=(message.header, record.element))

    def send(self, items: list[Any]) -> None:
        for _, of_frame in groupby(items, key=lambda item: item[0].frame_id):
            together = list(of_frame)
            header = as_message(together[-1][0], Header)
            edges = [as_message(element, self._element_type) for _, element in together]
            self._output.publish(self._message_type(header=header, edges=edges))


class _Graph:
    """A message with a graph or a part of one, the names of its closures, and which edges were sent on last."""

    def __init__(self, message: Any, converter: WholeGraphConverter) -> None:
        self.message, self.field = message, converter.edges_field
        self.names = [converter.closure_name(edge) for edge in getattr(message, self.field)]
        self.closures = {name for name in self.names if name is not None}
        self.sent: list[bool] | None = None

    def with_edges(self, kept: list[bool]) -> Any:
        """The same message with some of its edges."""
        graph = type(self.message)()
        for field in graph.get_fields_and_field_types():
            setattr(graph, field, getattr(self.message, field))
        edges = getattr(self.message, self.field)
        setattr(graph, self.field, [edge for edge, keep in zip(edges, kept, strict=True) if keep])
        return graph


class WholeGraphForward(Forward):
    """Sends a graph as it came, but without closures that are not believed, and again when the verdicts change.

    If senders send whole graphs, only the newest counts, since their optimisers may have removed closures. If they send
    parts, a part is kept until all of it has been sent, or until a newer part contains its closures.
    """

    def __init__(self, topic: str, output: Publisher, converter: WholeGraphConverter) -> None:
        super().__init__(topic, output)
        self._converter = converter
        self._incoming: deque[_Graph] = deque(maxlen=_MOST_GRAPHS if converter.sends_parts else 1)
        self._graphs: list[_Graph] = []

    def _new_filter(self) -> ClosureFilter[Any]:
        return ClosureFilter(newest_counts=True)  # a refined closure replaces the old one

    def begin(self, message: Any, records: Iterable[EdgeRecord | EdgeVerdict]) -> Iterator[EdgeRecord | EdgeVerdict]:
        yield from super().begin(None, records)
        self._incoming.append(_Graph(message, self._converter))

    def send(self, items: list[Any]) -> None:
        """Do nothing: closures are sent with their graphs (:meth:`end`)."""

    def end(self) -> None:
        """Send the graphs whose selection of edges has changed since they were last sent."""
        while self._incoming:
            if not self._converter.sends_parts:
                self._graphs.clear()
            self._graphs.append(self._incoming.popleft())
        for graph in self._graphs:
            kept = [name is None or self.filter.passes(name) for name in graph.names]
            if graph.sent != kept:
                graph.sent = kept
                self._output.publish(graph.with_edges(kept))
        if self._graphs:
            *older, newest = self._graphs
            waiting = [each for each in older if not all(each.sent or ()) and not each.closures <= newest.closures]
            self._graphs = [*waiting[-_MOST_GRAPHS:], newest]

    def forget(self) -> None:
        super().forget()
        self._incoming.clear()
        self._graphs.clear()


class Forwarding:
    """All edge topics that are sent on, ``~/revoked`` and ``~/reinstated``.

    Edges come on the executor's thread, answers on the solver's worker.

    Raises:
        UserError: an invalid topic name or ``qos_overrides``, or an output that is listened to.
    """

    def __init__(self, node: Node, parameters: NodeParameters, estimator: OnlineEstimator) -> None:
        self._node, self._estimator = node, estimator
        self._frame_id = parameters.world_frame
        self._output_of = parameters.forwarded()
        entries = (*parameters.odometry_topics, *parameters.edge_topics)
        self._check_outputs(entry.partition(":")[0] for entry in entries if self._output_of)
        self._delay_s = parameters.forward_delay_s
        self._qos = QoSProfile(depth=parameters.edge_queue_depth, reliability=ReliabilityPolicy.RELIABLE)
        self._forwards: list[Forward] = []
        self._lock = threading.Lock()
        self._generation = estimator.generation
        self._decided = 0
        self._verdicts: dict[str, Publisher] = {}
        if self._output_of:
            for name in ("revoked", "reinstated"):
                self._verdicts[name] = publisher(node, OutlierFlags, f"~/{name}", self._qos)

    def set_parameters(self, parameters: NodeParameters) -> None:
        """Take over what may change while the node runs."""
        self._delay_s = parameters.forward_delay_s

    @property
    def waiting(self) -> int:
        """Number of closures that are held back."""
        with self._lock:
            return sum(len(each.filter) for each in self._forwards)

    @property
    def dropped(self) -> int:
        """Number of closures that were held back and will not be sent on, because too many waited."""
        with self._lock:
            return sum(each.filter.dropped for each in self._forwards)

    def warnings(self) -> list[str]:
        """Present mistakes, a line each."""
        return [
            f"{each.topic}: different closures have the same id of the same robot, and go on only together "
            "(forward_topics): give each an id of its own"
            for each in self._forwards
            if each.shares_names and not isinstance(each, WholeGraphForward)
        ]

    def of(self, edges: EdgeTopic) -> Forward | None:
        """The forward of an edge topic; None if its messages are not sent on."""
        topic = self._output_of.get(edges.topic)
        if topic is None:
            return None
        output = publisher(self._node, edges.message_type, topic, self._qos)
        forward: Forward
        if edges.is_array:
            forward = ArrayForward(edges, output)
        elif _is_whole(edges.convert):
            forward = WholeGraphForward(edges.topic, output, edges.convert)
        else:
            forward = Forward(edges.topic, output)
        self._forwards.append(forward)
        return forward

    def _check_outputs(self, listened: Iterable[str]) -> None:
        """Check that no output's full name, with namespace and remappings, is that of an input or another output."""
        taken = {self._full_name(topic) for topic in listened}
        for topic, output in self._output_of.items():
            name = self._full_name(output)
            if name in taken:
                raise UserError(
                    f"forward_topics: the output of {topic} is {name}, which is listened to, or another output, "
                    "already; choose another"
                )
            taken.add(name)

    def _full_name(self, topic: str) -> str:
        with user_error_about(topic):
            return str(self._node.resolve_topic_name(topic))

    def taken(self, forward: Forward, record: EdgeRecord, refusal: RejectReason | None, generation: int) -> None:
        """An edge was handed to the estimator: send it on at once if it is odometry, or let it wait.

        Args:
            forward: of the edge's topic.
            record: the record with the edge.
            refusal: why the estimator refused it; None if it did not.
            generation: of the graph that the edge was meant for; if that is forgotten, so is the edge.
        """
        if isinstance(record.edge, RejectReason) or refusal not in (None, RejectReason.DUPLICATE_EDGE):
            return
        with self._lock:
            self._forget_with_the_estimator()
            if generation != self._generation:
                return
            if record.edge.kind == EdgeKind.LOOP_CLOSURE:
                name, measurement = (record.edge.source.robot, record.edge.edge_id), record.edge.fingerprint()
                if forward.filter.waits(name, measurement):  # the estimator may have given it up meanwhile
                    return
                is_known = forward.filter.knows(name)
                if not is_known or refusal is None:
                    forward.filter.take(name, record.element, time.monotonic(), measurement)
                return
        if refusal is None:
            forward.send([record.element])

    def decide(self, answer: Answer | None) -> None:
        """Send on what the last answer believes; nothing if it was used before and nothing waits."""
        with self._lock:
            self._forget_with_the_estimator()
            if answer is None or not self._forwards or answer.version <= self._estimator.first_version:
                return
            for forward in self._forwards:
                self._decide(forward, answer, answer.version != self._decided)
            self._decided = answer.version

    def _decide(self, forward: Forward, answer: Answer, is_new: bool) -> None:
        if is_new or len(forward.filter):
            self._send(forward, answer)
        forward.end()

    def _send(self, forward: Forward, answer: Answer) -> None:
        decision = forward.filter.decide(answer, time.monotonic(), self._delay_s)
        forward.shares_names |= decision.shares_names
        for name, rows in (("revoked", decision.revoked), ("reinstated", decision.reinstated)):
            if len(rows):
                self._verdicts[name].publish(flags_message(answer, self._frame_id, rows))
        forward.send(decision.passed)
        if len(forward.filter):
            forward.filter.forget_all_but(self._estimator.closure_keys())

    def _forget_with_the_estimator(self) -> None:
        if self._generation != self._estimator.generation:
            self._generation = self._estimator.generation
            self._decided = 0
            for forward in self._forwards:
                forward.forget()


def _is_whole(convert: EdgeConverter) -> TypeGuard[WholeGraphConverter]:
    return hasattr(convert, "edges_field")
