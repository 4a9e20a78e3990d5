"""Decides what a replay uses each topic of a bag for: as the user says, and by a good guess for the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from rotavg_ros.bags.reader import RECORDING_SUFFIXES, BagReader
from rotavg_ros.bags.topics import static_transforms
from rotavg_ros.datasets.files.pose_files import read_pose_file
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.inputs import BRINGS_KEYFRAMES, EDGE_CONVERTERS, ODOMETRY_CONVERTERS
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.replay.pace import Pace, WorkRates
from rotavg_ros.replay.record import TopicUse
from rotavg_ros.replay.topics import Candidate, Candidates, can_be_read_as, find_candidates, of_others, robots_of
from rotavg_ros.settings.parameters import NodeParameters

# Parameters that name topics, and for each the parameters with values per topic, with the number of values.
_PER_TOPIC = {
    "odometry_topics": {"odometry_sensor_orientations": 4},
    "edge_topics": {"edge_robots": 1, "edge_sensor_orientations": 4},
}

# Parameters that only matter to a running node; topics that they name would not be the bag's.
_OF_LIVE_NODES = (
    *("forward_topics", "forward_delay_s", "edge_frame_wait_s", "publish_tf", "transform_tolerance_s"),
    *("correction_rate_deg_s", "correction_rate_m_s", "odometry_queue_depth", "edge_queue_depth", "tick_budget_s"),
    *("solver_process", "state_file", "autosave_period_s", "odometry_timeout_s"),
)


class PlanError(UserError):
    """Topics that the bag does not have or that cannot be used; the message names the candidates."""


@dataclass(frozen=True)
class Wishes:
    """What the user wants to use; None: guess. Entries are ``topic``, ``topic:package/msg/Type``, or just ``none``.

    Attributes:
        odometry, edges: topics.
        references: topics or files, one per robot in the robots' order.
        robots: names, one per odometry topic.
    """

    odometry: Sequence[str] | None = None
    edges: Sequence[str] | None = None
    references: Sequence[str] | None = None
    robots: Sequence[str] | None = None


class Input(NamedTuple):
    """A topic and the type that its messages are read as."""

    topic: str
    type_name: str


@dataclass(frozen=True)
class Plan:
    """All decisions about a replay.

    Attributes:
        parameters: the node's, with the bag's topics; ``odometry_topics`` may name some that the bag lacks.
        odometry: those of ``parameters.odometry_topics`` that the bag has, in that order.
        edges: in the order of ``parameters.edge_topics``.
        references: topic or file by robot.
        topics: every topic of the bag and its use.
        edge_frames_from_tf: whether edges of sensors are converted to the body's frame by the bag's static transforms.
        tick_work: what ticks may cost; None if the user has set how often they come.
        unused: parameters that were set to other than their defaults, but that a replay does not use.
    """

    parameters: NodeParameters
    odometry: tuple[Input, ...]
    edges: tuple[Input, ...]
    references: dict[str, Input | Path]
    topics: tuple[TopicUse, ...]
    edge_frames_from_tf: bool = True
    tick_work: WorkRates | None = None
    unused: tuple[str, ...] = ()

    @property
    def has_input(self) -> bool:
        return bool(self.odometry or self.edges)

    def odometry_of_robots(self) -> list[tuple[str, Input, Quaternion]]:
        """The robots whose odometry the bag has, with its topic and body_from_sensor."""
        recorded, parameters = {_entry(source): source for source in self.odometry}, self.parameters
        rows = zip(parameters.robots, parameters.odometry_topics, parameters.odometry_sensors(), strict=True)
        return [(robot, recorded[entry], sensor) for robot, entry, sensor in rows if entry in recorded]

    def pace(self) -> Pace:
        """When there are ticks, from the first message on."""
        return Pace(self.parameters.solve_period_s, self.tick_work)


def make_plan(bag: BagReader, values: Mapping[str, Any], wishes: Wishes) -> Plan:
    """Decide.

    Args:
        bag: open.
        values: parameters that the user has set, by name. Topics among them count as wishes, but need not all be in the
            bag: a node may listen to more than was recorded.
        wishes: from command-line options, which take precedence.

    Raises:
        PlanError: a topic that is not in the bag, or whose type is not supported.
        GraphFileError: a reference file that holds no poses.
        OptionError: parameters that do not fit together.
    """
    if bag.num_messages() == 0:
        raise PlanError(f"{bag.path}: has no messages; there is nothing to replay")
    found = find_candidates(bag)
    defaults = NodeParameters().values()
    unused = tuple(name for name in _OF_LIVE_NODES if values.get(name, defaults[name]) != defaults[name])
    values = {name: value for name, value in values.items() if name not in _OF_LIVE_NODES}
    values = _without_absent_topics(bag, values)
    odometry = _odometry(bag, found, wishes.odometry, values.get("odometry_topics", ()))
    edges = _edges(bag, found, wishes.edges or values.get("edge_topics"), odometry)
    settings = dict(values)
    topics = _odometry_topics(odometry, () if wishes.odometry else values.get("odometry_topics", ()))
    settings["robots"] = robots = _robots(wishes.robots or values.get("robots"), topics)
    if not odometry and len(topics) != len(robots):
        topics = tuple(f"/{robot}/odom" for robot in robots)  # the bag has none, whatever its name
    settings["odometry_topics"] = topics
    settings["edge_topics"] = tuple(map(_entry, edges))
    of_edges = robots_of([edge.topic for edge in edges], topics, robots) if len(robots) > 1 else ()
    if any(of_edges) and (wishes.edges or "edge_topics" not in values):  # those among parameters mean what a node does
        settings.setdefault("edge_robots", of_edges)
    if any(edge.topic in found.brings_keyframes or edge.type_name in BRINGS_KEYFRAMES for edge in edges):
        settings.setdefault("keyframe_source", "edges")
    elif edges and not odometry:
        settings.setdefault("unknown_keyframes", "create")
    parameters = NodeParameters().changed(settings)
    tick_work = None if "solve_period_s" in values else WorkRates()
    plan = Plan(parameters, odometry, edges, {}, (), parameters.places_edges_by_tf, tick_work, unused)
    plan = replace(plan, references=_references(bag, found, wishes.references, plan))
    return replace(plan, topics=_uses(bag, found, plan))


def _without_absent_topics(bag: BagReader, values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters restricted to topics that the bag has; if it has none of them, the topics are guessed.

    Of several robots none is left out, since messages may mean their places among all: their topics stay as they are.
    """
    recorded, kept = bag.topics, dict(values)
    for topics, lists in _PER_TOPIC.items():
        entries = values.get(topics, ())
        present = [index for index, entry in enumerate(entries) if _is_recorded(entry, recorded)]
        if len(present) == len(entries) or (topics == "odometry_topics" and len(entries) > 1):
            continue
        kept[topics] = tuple(entries[index] for index in present) or None
        for name, width in lists.items():
            if len(values.get(name, ())) == width * len(entries) > width:
                rows = [values[name][width * index : width * (index + 1)] for index in present]
                kept[name] = tuple(chain.from_iterable(rows))
            if not present:
                kept.pop(name, None)
    return {name: value for name, value in kept.items() if value is not None}


def _is_recorded(entry: str, recorded: Mapping[str, str]) -> bool:
    name = entry.partition(":")[0]
    return name in recorded or f"/{name.lstrip('/')}" in recorded


def _entry(source: Input) -> str:
    """As the node's parameters name a topic."""
    return f"{source.topic}:{source.type_name}"


def _odometry(
    bag: BagReader, found: Candidates, wanted: Sequence[str] | None, listed: Sequence[str]
) -> tuple[Input, ...]:
    """The topics wanted, else those of the node's list that the bag has, else the best."""
    recorded = bag.topics
    if wanted is None and listed:
        wanted = [entry for entry in listed if _is_recorded(entry, recorded)]
    if wanted is None:
        return tuple(Input(best.topic, best.type_name) for best in found.odometry[:1])
    return _chosen(bag, wanted, ODOMETRY_CONVERTERS, "odometry", found.odometry)


def _odometry_topics(odometry: Sequence[Input], listed: Sequence[str]) -> tuple[str, ...]:
    """The node's list with these in their places; only these where it has no list."""
    entry_of = {source.topic.lstrip("/"): _entry(source) for source in odometry}
    if not listed:
        return tuple(entry_of.values())
    return tuple(entry_of.get(entry.partition(":")[0].lstrip("/"), entry) for entry in listed)


def _edges(
    bag: BagReader, found: Candidates, wanted: Sequence[str] | None, odometry: Sequence[Input]
) -> tuple[Input, ...]:
    """The topics wanted, else all but those of robots whose odometry is not used."""
    if wanted is None:
        others = _of_others(found, odometry)
        wanted = [edge.topic for edge in found.edges if edge.topic not in others]
    return _chosen(bag, wanted, EDGE_CONVERTERS, "relative rotations", found.edges)


def _of_others(found: Candidates, odometry: Sequence[Input]) -> frozenset[str]:
    """Topics of the closures of other robots; an IMU beside a camera makes it no robot, where others have odometry."""
    used, types = [source.topic for source in odometry], {source.type_name for source in odometry}
    other = [each.topic for each in found.odometry if each.topic not in used and each.type_name in types]
    return of_others([edge.topic for edge in found.edges], used, other)


def _chosen(
    bag: BagReader,
    wanted: Sequence[str],
    converters: Mapping[str, object],
    what: str,
    candidates: Sequence[Candidate],
) -> tuple[Input, ...]:
    if list(wanted) == ["none"]:
        return ()
    recorded = bag.topics
    inputs = []
    for entry in wanted:
        name, _, type_name = entry.partition(":")
        topic = name if name in recorded else f"/{name.lstrip('/')}"
        names = ", ".join(candidate.topic for candidate in candidates) or "none"
        if topic not in recorded:
            raise PlanError(f"{bag.path}: no topic {topic}; candidates for {what}: {names}")
        type_name = type_name or recorded[topic]
        if type_name not in converters:
            raise PlanError(
                f"{bag.path}: {topic} is {type_name}, of which no {what} can be made; candidates: {names}; "
                f"types: {', '.join(converters)}"
            )
        if not can_be_read_as(bag, topic, type_name):
            if type_name != recorded[topic]:
                raise PlanError(f"{bag.path}: {topic} is {recorded[topic]} and cannot be read as {type_name}")
            raise PlanError(
                f"{bag.path}: {topic} is {type_name}, in a version with other fields than those that rotavg knows; "
                "name other topics, or none (--edges, --odometry)"
            )
        inputs.append(Input(topic, type_name))
    return tuple(inputs)


def _robots(wanted: Sequence[str] | None, entries: Sequence[str]) -> tuple[str, ...]:
    """Names for the robots of the odometry topics: as given, or their topics' namespaces, or the default for one."""
    if wanted:
        return tuple(wanted)
    if len(entries) < 2:
        return NodeParameters().robots
    topics = [entry.partition(":")[0].strip("/") for entry in entries]
    namespaces = [topic.rpartition("/")[0] for topic in topics]
    names = namespaces if len(set(namespaces)) == len(topics) and all(namespaces) else None
    return tuple(names or topics)


def _references(bag: BagReader, found: Candidates, wanted: Sequence[str] | None, plan: Plan) -> dict[str, Input | Path]:
    robots = plan.parameters.robots
    if wanted is None:
        used = {source.topic for source in plan.odometry}
        best = next((candidate for candidate in found.references if candidate.topic not in used), None)
        known = robots if len(robots) == 1 else [robot for robot, _, _ in plan.odometry_of_robots()]
        return {known[0]: Input(best.topic, best.type_name)} if best and len(known) == 1 else {}
    if list(wanted) == ["none"]:
        return {}
    if len(wanted) > len(robots):
        raise PlanError(f"{len(wanted)} references for {len(robots)} robots; give at most one per robot")
    references: dict[str, Input | Path] = {}
    for robot, entry in zip(robots, wanted, strict=False):
        path, is_topic = Path(entry), entry.partition(":")[0] in bag.topics
        with asking_about(path, PlanError):
            exists = path.exists()
        if not is_topic and exists and path.suffix not in RECORDING_SUFFIXES:
            read_pose_file(entry)  # so that a mistake shows before the replay
            references[robot] = path
        elif not is_topic and path.suffix and not exists:  # topic names have no dots
            names = ", ".join(candidate.topic for candidate in found.references) or "none"
            raise PlanError(f"{entry}: no such file, and no topic of that name; candidates for a reference: {names}")
        else:
            (references[robot],) = _chosen(bag, [entry], ODOMETRY_CONVERTERS, "a reference", found.references)
    return references


def _uses(bag: BagReader, found: Candidates, plan: Plan) -> tuple[TopicUse, ...]:
    """Every topic of the bag, and its use in the plan."""
    roles: dict[str, list[str]] = {}
    for robot, source, _ in plan.odometry_of_robots():
        roles.setdefault(source.topic, []).append(f"odometry of {robot}")
    brings = plan.parameters.estimator.keyframe_source == "edges"
    role = "keyframes and loop closures" if brings else "loop closures"
    stated = plan.parameters.edge_robots
    for source, robot in zip(plan.edges, stated * (len(plan.edges) // len(stated)), strict=True):
        roles.setdefault(source.topic, []).append(f"{role} of {robot}" if robot else role)
    for robot, reference in plan.references.items():
        if isinstance(reference, Input):
            roles.setdefault(reference.topic, []).append(f"reference for {robot}")
    for topic in static_transforms(bag.topics) if plan.edge_frames_from_tf and plan.edges else ():
        roles.setdefault(topic, []).append("frames of sensors")
    could_be = {candidate.topic: "could be a reference: --reference" for candidate in found.references}
    could_be |= {candidate.topic: "could be odometry: --odometry" for candidate in found.odometry}
    could_be |= {candidate.topic: "could be loop closures: --edges" for candidate in found.edges}
    others = _of_others(found, plan.odometry)
    could_be |= dict.fromkeys(others, "loop closures of another robot, by its namespace: --odometry, --edges")
    nothing = "neither odometry nor relative rotations"
    return tuple(
        TopicUse(
            topic,
            type_name,
            bag.num_messages([topic]),
            ", ".join(roles.get(topic, [])),
            "" if topic in roles else found.why_not.get(topic) or could_be.get(topic, nothing),
        )
        for topic, type_name in bag.topics.items()
    )
