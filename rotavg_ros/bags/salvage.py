"""Reads what is left of a damaged MCAP recording: all sound chunks, and the written part of a torn one.

A recorder that loses its power leaves a file without an index that ends in the middle of a chunk. A bad disk leaves
chunks with a wrong checksum or invalid compression; it is not known which of their messages are sound, so they are left
out. A chunk without a checksum is read up to the first invalid record.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import ReaderMetadata, parse_qos
from rosbags.typesys.store import Typestore

from rotavg_ros.bags.mcap_records import NONSENSE, Block, Exact, begun, parsed, record_head_of, summary_of, whole

_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
_MAX_STAMP_NS = 2**63 - 1


class _Place(NamedTuple):
    """Where a chunk begins in the file, and when its first and its last message were recorded."""

    offset: int
    start_ns: int
    end_ns: int


@dataclass
class Losses:
    """What cannot be read of a recording.

    Attributes:
        file: name of its file.
        chunks: corrupt chunks.
        is_cut: whether the file ends in the middle of its messages.
        has_index: whether the file is complete to its end, with the index.
    """

    file: str
    chunks: set[_Place] = field(default_factory=set)
    is_cut: bool = False
    has_index: bool = True

    def told(self, start_ns: int, end_ns: int) -> list[str]:
        """A line for each loss.

        Args:
            start_ns: of the bag's first message, readable or not.
            end_ns: of all messages of the bag that can be read.
        """
        lines = []
        if self.chunks:
            first = (min(place.start_ns for place in self.chunks) - start_ns) / 1e9
            last = (max(place.end_ns for place in self.chunks) - start_ns) / 1e9
            what = "1 chunk is" if len(self.chunks) == 1 else f"{len(self.chunks)} chunks are"
            lines.append(f"{self.file}: {what} corrupt, between {first:.1f} and {last:.1f} s after its start")
        if self.is_cut:
            lines.append(f"{self.file} is cut off, after {(end_ns - start_ns) / 1e9:.1f} s")
        elif not self.has_index:
            lines.append(f"{self.file} has no index")
        return lines


class SalvagedRecording:
    """A storage for rosbags' readers that reads what is sound and reports what is not.

    Attributes:
        connections, metadata: of the readable part.
        losses: what cannot be read; known once it is open.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None
        self.connections: list[Connection] = []
        self.metadata = _metadata(0, _MAX_STAMP_NS, 0)
        self.losses = Losses(path.name)

    def open(self) -> None:
        """Read everything once, to know what there is; a second call does nothing.

        Raises:
            ReaderError: no message can be read.
        """
        if self._file is not None:
            return
        self._file = self._path.open("rb")
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        counts: dict[int, int] = {}
        start_ns, end_ns = _MAX_STAMP_NS, 0
        for record in (record for block in self._blocks() for record in block):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif record.channel_id in channels:
                counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
                start_ns, end_ns = min(start_ns, record.log_time), max(end_ns, record.log_time)
        if not counts:
            self.close()
            raise ReaderError("it has no message that can be read")
        self.metadata = _metadata(sum(counts.values()), start_ns, end_ns)
        self.connections = [
            self._connection(channel, schemas[channel.schema_id], counts.get(channel.id, 0))
            for channel in channels.values()
            if channel.schema_id in schemas
        ]

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Messages chunk by chunk, in each by the time of recording: from ``start`` on and before ``stop``, ns."""
        wanted = {connection.id: connection for connection in connections}
        first, end = start or 0, _MAX_STAMP_NS if stop is None else stop
        for block in self._blocks():
            messages = [record for record in block if isinstance(record, Message) and record.channel_id in wanted]
            for message in sorted(messages, key=lambda message: message.log_time):
                if first <= message.log_time < end:
                    yield wanted[message.channel_id], message.log_time, message.data

    def _connection(self, channel: Channel, schema: Schema, count: int) -> Connection:
        definition = MessageDefinition(
            _FORMATS.get(schema.encoding, MessageDefinitionFormat.NONE), schema.data.decode("utf-8", "replace")
        )
        qos = parse_qos(channel.metadata.get("offered_qos_profiles", ""))
        ext = ConnectionExtRosbag2(channel.message_encoding, qos)
        return Connection(channel.id, channel.topic, schema.name, definition, "", count, ext, self)

    def _blocks(self) -> Iterator[Block]:
        """Sound records, those of a chunk together, in the order of the file."""
        assert self._file is not None, "open it first"
        file, summary = self._file, summary_of(self._file)
        if summary is None:
            self.losses.has_index = False
            yield from self._in_sequence(file)
            return
        yield [*summary.schemas.values(), *summary.channels.values()]
        for index in sorted(summary.chunk_indexes, key=lambda index: int(index.chunk_start_offset)):
            place = _Place(index.chunk_start_offset, index.message_start_time, index.message_end_time)
            try:
                file.seek(place.offset)
                chunk = next(StreamReader(file, skip_magic=True, emit_chunks=True).records)
            except Exception:  # whatever garbled bytes make the reader stumble over
                self.losses.chunks.add(place)
                continue
            if isinstance(chunk, Chunk):
                yield self._sound(place, chunk)
            else:
                self.losses.chunks.add(place)

    def _in_sequence(self, file: IO[bytes]) -> Iterator[Block]:
        """Record by record, for a file without index."""
        file.seek(0)
        reached = 0
        exact: Any = Exact(file, self._path.stat().st_size)
        try:
            for record in StreamReader(exact, emit_chunks=True).records:
                if isinstance(record, DataEnd):
                    return
                if isinstance(record, Chunk):
                    place = _Place(reached, record.message_start_time, record.message_end_time)
                    yield self._sound(place, record)
                elif isinstance(record, Schema | Channel | Message):
                    yield [record]
                reached = file.tell()
        except NONSENSE:
            self.losses.is_cut = True
            yield self._torn(file, reached)

    def _torn(self, file: IO[bytes], offset: int) -> Block:
        """The written records of the chunk in which the file ends."""
        file.seek(offset)
        if record_head_of(file) != Opcode.CHUNK:
            return []
        try:
            chunk = Chunk.read(ReadDataStream(file))
        except NONSENSE:
            return []
        records, _ = parsed(chunk, begun)
        return records

    def _sound(self, place: _Place, chunk: Chunk) -> Block:
        records, is_whole = parsed(chunk, whole)
        if not is_whole:
            self.losses.chunks.add(place)
        return records


def _metadata(count: int, start_ns: int, end_ns: int) -> ReaderMetadata:
    duration_ns = end_ns + 1 - start_ns if count else 0
    return ReaderMetadata(duration_ns, start_ns, end_ns + 1 if count else 0, count, None, None, None, None)


def salvaging_reader(recordings: Iterable[Path], store: Typestore, *, thorough: bool) -> tuple[AnyReader, list[Losses]]:
    """An open reader of MCAP recordings that reads damaged ones as far as possible.

    Args:
        recordings: of one bag, in order. Those of which nothing can be read are left out.
        store: types for messages without a definition.
        thorough: whether recordings with a sound index may be damaged, too.

    Returns:
        the reader, and what each of the damaged recordings has lost.

    Raises:
        ReaderError: nothing can be read of any.
    """
    storages = {path: None if not thorough and _opens(path) else _salvaged(path) for path in recordings}
    paths = [path for path, storage in storages.items() if storage is None or storage.connections]
    if not paths:
        raise ReaderError("it has no message that can be read")
    reader: Any = AnyReader(paths, default_typestore=store)
    for each, path in zip(reader.readers, paths, strict=True):
        each.storage = storages[path] or each.storage
    reader.open()
    return reader, [storage.losses for storage in storages.values() if storage is not None]


def _opens(path: Path) -> bool:
    try:
        with AnyReader([path]):
            return True
    except Exception:  # whatever garbled bytes make the reader stumble over
        return False


def _salvaged(path: Path) -> SalvagedRecording:
    """The recording, opened; without connections if nothing can be read."""
    recording = SalvagedRecording(path)
    with suppress(ReaderError, OSError):
        recording.open()
    return recording
