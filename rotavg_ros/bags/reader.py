"""Reading bags, with errors that a user can act on."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePath
from types import TracebackType
from typing import Any

import yaml
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection, QosDurability
from rosbags.rosbag1 import ReaderError as Rosbag1Error
from rosbags.rosbag2 import ReaderError as Rosbag2Error

from rotavg_ros.bags.lost import Lost
from rotavg_ros.bags.message_types import typestore
from rotavg_ros.bags.salvage import salvaging_reader
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.packed import head_of, how_to_unpack

# Suffixes of files that can be bags by themselves.
RECORDING_SUFFIXES = (".mcap", ".db3", ".bag")
COMPRESSED_SUFFIX = ".zstd"  # of a recording that rosbag2 has compressed as a whole
_METADATA = "metadata.yaml"


class BagReadError(UserError):
    """A bag that cannot be read; the message names it, what is wrong and what to do."""


@dataclass(frozen=True)
class BagMessage:
    """One recorded message.

    Attributes:
        topic, message_type: e.g. ``/odom``, ``nav_msgs/msg/Odometry``.
        time_ns: when it was recorded.
        data: serialised message (CDR in ROS 2 bags).
    """

    topic: str
    message_type: str
    time_ns: int
    data: bytes


class BagReader:
    """A rosbag2 folder (MCAP or sqlite3, compressed or not), a single recording or a ROS 1 bag, opened by ``with``.

    Args:
        path: of the bag.
        salvage: whether to read what is readable of a damaged bag, and to report the rest in :attr:`damage`.

    Raises:
        BagReadError: no such bag, a truncated or foreign file, an unknown compression, an sqlite file whose last
            messages are in a log beside it; with ``salvage`` a truncated one only if nothing can be read.
    """

    def __init__(self, path: str | Path, *, salvage: bool = False) -> None:
        self._salvages = salvage
        self._path = _bag_of(Path(path), salvage)
        self._reader: AnyReader | None = None
        self._lost: Lost | None = None

    def __enter__(self) -> BagReader:
        try:
            self._reader = AnyReader([self._path], default_typestore=typestore())
            self._reader.open()
        except Exception as error:
            self._reader = None
            problem = self._unreadable(error)
            if not self._salvages or "not supported" in str(error):  # an unknown compression is no damage
                raise problem from None
            self._salvage(problem)
            self._losing().cause = _one_line(error)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._reader is not None:
            with suppress(AnyReaderError):
                self._reader.close()

    @property
    def path(self) -> Path:
        """The bag's file or folder."""
        return self._path

    @property
    def damage(self) -> str | None:
        """A line about what cannot be read, as far as known by now; None: nothing."""
        return None if self._lost is None else f"{self._path}: the bag is damaged: {self._lost.told(self._open())}"

    @property
    def topics(self) -> dict[str, str]:
        """Message type of every topic, in the order of their names; of several types, that of most messages."""
        counts: dict[str, Counter[str]] = {}
        for connection in sorted(self._all(), key=lambda c: c.topic):
            counts.setdefault(connection.topic, Counter())[connection.msgtype] += connection.msgcount
        return {topic: of_type.most_common(1)[0][0] for topic, of_type in counts.items()}

    @property
    def is_ros2(self) -> bool:
        return bool(self._open().is2)

    @property
    def duration_s(self) -> float:
        return max(0.0, self._open().duration / 1e9)

    @property
    def start_ns(self) -> int:
        """When the first message was recorded."""
        return int(self._open().start_time)

    @property
    def end_ns(self) -> int:
        """Just after the last message."""
        return int(self._open().end_time)

    def num_messages(self, topics: Collection[str] | None = None) -> int:
        """Number of messages on the given topics; default: all."""
        return sum(c.msgcount for c in self._all() if topics is None or c.topic in topics)

    def is_latched(self, topic: str) -> bool:
        """Whether the topic was offered to late subscribers (transient_local) when it was recorded."""
        return any(
            profile.durability is QosDurability.TRANSIENT_LOCAL
            for connection in self._all()
            if connection.topic == topic
            for profile in getattr(connection.ext, "offered_qos_profiles", [])
        )

    def note(self, key: str) -> str | None:
        """A line of the bag's own metadata, as :meth:`BagWriter.set_note` writes it."""
        storage = getattr(self._open().readers[0], "storage", None)  # ROS 1 bags have none
        custom = getattr(getattr(storage, "metadata", None), "custom", None) or {}
        value = custom.get(key)
        return None if value is None else str(value)

    def require(self, topic: str, message_type: str) -> None:
        """Refuse a bag without that topic, naming the candidates.

        Raises:
            BagReadError: there is no such topic, or it has another type.
        """
        found = self.topics
        if found.get(topic) == message_type:
            return
        candidates = [name for name, kind in found.items() if kind == message_type]
        hint = f"topics of that type: {', '.join(candidates)}" if candidates else "the bag has no topic of that type"
        if topic in found:
            raise BagReadError(f"{self._path}: topic {topic} has type {found[topic]}, not {message_type}; {hint}")
        raise BagReadError(f"{self._path}: no topic {topic} ({message_type}); {hint}")

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Messages in the order of recording, still serialised; default: of all topics."""
        for connection, time_ns, data in self._records(topics):
            yield BagMessage(connection.topic, connection.msgtype, time_ns, data)

    def decoded(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Messages as (topic, time in ns, message), of those recorded from ``start_ns`` on and before ``stop_ns``.

        Types of packages that are not installed are decoded by the definitions in the bag. Where a topic has several
        types, its messages of others than :attr:`topics` says are left out.
        """
        type_of = self.topics
        for connection, time_ns, data in self._records(topics, start_ns, stop_ns):
            if connection.msgtype != type_of.get(connection.topic, connection.msgtype):
                continue
            reader = self._open()  # a new one after the bag has turned out to be damaged
            if connection.msgtype not in reader.typestore.fielddefs:
                raise BagReadError(
                    f"{self._path}: {connection.topic} has type {connection.msgtype}, which neither the bag nor rotavg "
                    "defines; record it as MCAP, which carries definitions, or leave the topic out"
                )
            try:
                message = reader.deserialize(data, connection.msgtype)
            except Exception as error:  # whatever garbled bytes make the decoder stumble over
                if self._salvages:
                    self._losing().undecodable.add((connection.topic, time_ns))
                    continue
                raise BagReadError(
                    f"{self._path}: a message on {connection.topic} cannot be decoded ({_one_line(error)}); "
                    "the bag is damaged"
                ) from None
            yield connection.topic, time_ns, message

    def _records(
        self, topics: Collection[str] | None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Records in order; if a recording turns out to be damaged, also those that can be read after the damage."""
        passed = _Passed()
        while True:
            try:
                for record in self._sound_records(topics, start_ns, stop_ns):
                    if passed.is_new(*record):
                        yield record
                return
            except BagReadError as problem:
                if not self._salvages:
                    raise
                if self._lost is not None and self._lost.is_final:
                    return
                self._salvage_thoroughly(problem)
                passed.begin_again()

    def _sound_records(
        self, topics: Collection[str] | None, start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Records up to the first that cannot be read."""
        connections = [c for c in self._all() if topics is None or c.topic in topics]
        if not connections:
            return
        records = self._open().messages(connections, start_ns, stop_ns)
        count, expected = 0, sum(connection.msgcount for connection in connections)
        while True:
            try:
                record = next(records)
            except StopIteration:
                break
            except Exception as error:
                raise self._unreadable(error) from None
            count += 1
            yield record
        if start_ns is None and stop_ns is None and count < expected:
            # Garbled records may look like a kind that readers have to skip.
            raise BagReadError(
                f"{self._path}: the bag is damaged: only {count} of {expected} messages can be read; "
                "`ros2 bag convert` may save them"
            )

    def _salvage(self, problem: BagReadError, *, thorough: bool = False) -> None:
        """Continue with a reader of what is left.

        Raises:
            BagReadError: the problem, since nothing is left.
        """
        try:
            reader, losses = salvaging_reader(_recordings(self._path), typestore(), thorough=thorough)
        except Exception:
            raise problem from None
        if self._reader is not None:
            self._reader.close()
        self._reader = reader
        self._losing().recordings = losses

    def _salvage_thoroughly(self, problem: BagReadError) -> None:
        """The same in the middle of a bag: if nothing is left, what was read so far is all."""
        lost, expected = self._losing(), self.num_messages()
        lost.is_final, lost.expected = True, expected
        try:
            self._salvage(problem, thorough=True)
        except BagReadError:
            lost.problem = str(problem)

    def _losing(self) -> Lost:
        if self._lost is None:
            self._lost = Lost()
        return self._lost

    def _open(self) -> AnyReader:
        assert self._reader is not None, "use the reader in a with statement"
        return self._reader

    def _all(self) -> Sequence[Connection]:
        return self._open().connections

    def _unreadable(self, error: Exception) -> BagReadError:
        if isinstance(error, PermissionError):
            return BagReadError(f"{self._path}: permission denied; check the rights of the bag's files")
        known = isinstance(error, AnyReaderError | Rosbag1Error | Rosbag2Error)
        what = _one_line(error) if known else f"{type(error).__name__}: {_one_line(error)}"
        if isinstance(error, FileNotFoundError) and self._path.is_dir():
            what = f"it has no {_METADATA}, and no message in it can be read"
        elif self._path.suffix == ".bag" and re.search("not indexed|index looks damaged", str(error)):
            what = f"no index at its end; `rosbag reindex {shlex.quote(str(self._path))}` makes one"
        return BagReadError(f"{self._path}: not a readable bag, or a truncated one ({what})")


class _Passed:
    """Remembers which records have been handed out, for an iteration in time order that starts again."""

    def __init__(self) -> None:
        self._newest_ns = -1
        self._at_newest: Counter[tuple[str, bytes]] = Counter()
        self._horizon_ns, self._again = -1, Counter[tuple[str, bytes]]()

    def begin_again(self) -> None:
        """The iteration starts again: records that were handed out come once more."""
        self._horizon_ns, self._again = self._newest_ns, Counter(self._at_newest)

    def is_new(self, connection: Connection, time_ns: int, data: bytes) -> bool:
        """Whether a record has not been handed out before; it counts as handed out from now on."""
        key = connection.topic, bytes(data)
        if time_ns < self._horizon_ns:
            return False
        if time_ns == self._horizon_ns and self._again[key] > 0:
            self._again[key] -= 1
            return False
        if time_ns > self._newest_ns:
            self._newest_ns, self._at_newest = time_ns, Counter()
        if time_ns == self._newest_ns:
            self._at_newest[key] += 1
        return True


def _bag_of(path: Path, salvage: bool) -> Path:
    """The bag that a path means: itself, or the rosbag2 folder that a recording is part of."""
    with asking_about(path, BagReadError):
        exists, is_folder = path.exists(), path.is_dir()
        has_metadata = ((path if is_folder else path.parent) / _METADATA).exists()
    if not exists:
        raise BagReadError(f"{path}: no such bag; check the path")
    listed = _listed(path if is_folder else path.parent) if has_metadata else []
    if not is_folder and path.suffix == COMPRESSED_SUFFIX and path.name not in listed:
        raise BagReadError(
            f"{path}: a compressed recording is read only in its folder, beside the {_METADATA} that lists it; unpack "
            f"it by `unzstd {shlex.quote(str(path))}`"
        )
    if not is_folder and path.suffix not in (*RECORDING_SUFFIXES, COMPRESSED_SUFFIX):
        if (what := how_to_unpack(path, head_of(path))) is not None:
            raise BagReadError(f"{path}: {what}")
        raise BagReadError(f"{path}: give a rosbag2 folder, or a file with suffix {', '.join(RECORDING_SUFFIXES)}")
    bag = path.parent if path.name in listed else path
    with asking_about(path, BagReadError):
        if is_folder and not listed:
            listed = [each.name for each in sorted(path.iterdir()) if each.suffix in RECORDING_SUFFIXES]
        for recording in [bag] if not bag.is_dir() else [bag / name for name in listed]:
            _check_log(recording)
    if is_folder and not has_metadata and not (salvage and _recordings(path)):
        if not listed:
            raise BagReadError(f"{path}: is no rosbag2 folder (it has no {_METADATA}); give a bag")
        raise BagReadError(
            f"{path}: has no {_METADATA}; name the recording in it ({', '.join(listed)}), or make one with "
            f"`ros2 bag reindex {shlex.quote(str(path))}`"
        )
    return bag


def _listed(folder: Path) -> list[str]:
    """Names of the recordings listed in a rosbag2 folder's metadata; empty if that cannot be read."""
    try:
        metadata = yaml.safe_load((folder / _METADATA).read_text(encoding="utf-8"))
        return [PurePath(each).name for each in metadata["rosbag2_bagfile_information"]["relative_file_paths"]]
    except Exception:  # whatever a broken file makes the parser stumble over
        return []


def _check_log(recording: Path) -> None:
    """Refuse an sqlite file whose last messages are in the log beside it, since rosbags reads only the file.

    Raises:
        BagReadError: there is such a log.
    """
    log = recording.with_name(f"{recording.name}-wal")
    if recording.suffix == ".db3" and log.exists() and log.stat().st_size > 0:
        raise BagReadError(
            f"{recording}: its last messages are still in {log.name} beside it, as when a recorder is killed; fold "
            f"them in with `sqlite3 {shlex.quote(str(recording))} 'PRAGMA wal_checkpoint(TRUNCATE)'`"
        )


def _recordings(bag: Path) -> list[Path]:
    """MCAP files of a bag, in the order in which rosbag2 numbers them."""
    if not bag.is_dir():
        return [bag] if bag.suffix == ".mcap" else []
    return sorted(bag.glob("*.mcap"), key=lambda path: (len(path.name), path.name))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
