"""Recordings cut off or garbled anywhere: all that is sound is read, in order and once, and the rest is told."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from rotavg_ros.bags.message_types import ODOMETRY, typestore
from rotavg_ros.bags.messages import odometry_message
from rotavg_ros.bags.reader import BagReader, BagReadError
from rotavg_ros.bags.writer import BagWriter

START_NS, STEP_NS = 1_700_000_000_000_000_000, 100_000_000
COUNT, CHUNK = 200, 10_000  # messages, and bytes of a chunk: 13 messages
LEFT = np.array([0.0, 0.0, 0.0, 1.0])


def serialized(index: int) -> bytes:
    stamp = START_NS + index * STEP_NS
    message = odometry_message(stamp, np.array([float(index), 0.0, 0.0]), LEFT, "odom")
    return bytes(typestore().serialize_cdr(message, ODOMETRY))


def recording(path: Path, compression: CompressionType = CompressionType.NONE, crc: bool = True) -> bytes:
    """As rosbag2 writes one, by MCAP's own library: chunks with checksums, an index at the end."""
    definition, _ = typestore().generate_msgdef(ODOMETRY)
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=CHUNK, compression=compression, enable_crcs=crc)
        writer.start("ros2")
        schema = writer.register_schema(ODOMETRY, "ros2msg", definition.encode())
        channel = writer.register_channel("/odom", "cdr", schema)
        for index in range(COUNT):
            stamp = START_NS + index * STEP_NS
            writer.add_message(channel, stamp, serialized(index), stamp)
        writer.finish()
    return path.read_bytes()


def read(path: Path) -> tuple[list[int], str | None]:
    """Which messages are read, and what the reader says of the rest."""
    with BagReader(path, salvage=True) as bag:
        found = [round(message.pose.pose.position.x) for _, _, message in bag.decoded(["/odom"])]
        return found, bag.damage


def chunks(path: Path) -> list[tuple[int, int, range]]:
    """Where each chunk's record begins and ends, and which messages it has, by MCAP's own reader."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [
        (
            index.chunk_start_offset,
            index.chunk_start_offset + index.chunk_length,
            range((index.message_start_time - START_NS) // STEP_NS, (index.message_end_time - START_NS) // STEP_NS + 1),
        )
        for index in summary.chunk_indexes
    ]


def test_a_whole_recording_has_lost_nothing(tmp_path: Path) -> None:
    recording(tmp_path / "whole.mcap")
    assert read(tmp_path / "whole.mcap") == (list(range(COUNT)), None)


@pytest.mark.parametrize("compression", CompressionType)
def test_a_recording_that_is_cut_off(tmp_path: Path, compression: CompressionType) -> None:
    whole = recording(tmp_path / "whole.mcap", compression)
    places, cut = chunks(tmp_path / "whole.mcap"), tmp_path / "cut.mcap"
    for length in np.linspace(places[1][1], places[-1][1] - 1, 12).astype(int).tolist():
        cut.write_bytes(whole[:length])
        found, damage = read(cut)
        complete = sum(len(messages) for _, end, messages in places if end <= length)
        if compression is CompressionType.NONE:  # of the torn chunk all that is there, byte for byte
            complete = sum(whole[:length].count(serialized(index)) for index in range(COUNT))
        assert found == list(range(len(found))) and len(found) >= complete > 0
        assert damage is not None and damage.startswith(f"{cut}: the bag is damaged: cut.mcap is cut off, after ")
        assert damage.endswith(f"{len(found)} messages can be read") and "\n" not in damage
        with pytest.raises(BagReadError, match="truncated"), BagReader(cut):
            pass


def test_a_recording_that_is_cut_off_in_its_index(tmp_path: Path) -> None:
    whole = recording(tmp_path / "cut.mcap")
    (tmp_path / "cut.mcap").write_bytes(whole[:-50])
    found, damage = read(tmp_path / "cut.mcap")
    assert found == list(range(COUNT))
    assert damage is not None and "cut.mcap has no index; 200 messages can be read" in damage


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize(("spot", "share"), [("sizes", 0.5), ("content", 0.5), ("content", 0.0)])
def test_a_corrupt_chunk(tmp_path: Path, compression: CompressionType, spot: str, share: float) -> None:
    bad = tmp_path / "bad.mcap"
    garbled = bytearray(recording(bad, compression))
    places = chunks(bad)
    start, end, lost = places[int(share * len(places))]
    at = start + 25 if spot == "sizes" else (start + end) // 2
    garbled[at : at + 16] = bytes(byte ^ 0x5A for byte in garbled[at : at + 16])
    bad.write_bytes(garbled)
    found, damage = read(bad)
    assert found == [index for index in range(COUNT) if index not in lost]
    assert damage is not None
    assert f"1 chunk is corrupt, between {lost[0] / 10:.1f} and {lost[-1] / 10:.1f} s after its start" in damage
    assert damage.endswith(f"{len(found)} of {COUNT} messages can be read")


def test_a_garbled_record_around_a_sound_chunk(tmp_path: Path) -> None:
    """The index says where it is, and the checksum that it is sound."""
    garbled = bytearray(recording(tmp_path / "bad.mcap"))
    start, _, _ = chunks(tmp_path / "bad.mcap")[4]
    garbled[start : start + 9] = bytes(9)
    (tmp_path / "bad.mcap").write_bytes(garbled)
    assert read(tmp_path / "bad.mcap") == (list(range(COUNT)), None)


def test_a_chunk_without_checksum_counts_up_to_where_it_makes_no_sense(tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    garbled = bytearray(recording(bad, crc=False))
    _, _, messages = chunks(bad)[3]
    at = bytes(garbled).index(serialized(messages[5])) - 31  # the record's opcode and length stand before its content
    garbled[at : at + 9] = bytes(9)
    bad.write_bytes(garbled)
    found, damage = read(bad)
    assert found == [index for index in range(COUNT) if index not in messages[5:]]
    assert damage is not None and "1 chunk is corrupt" in damage


def test_a_message_that_makes_no_sense_is_left_out(tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    garbled = bytearray(recording(bad, crc=False))
    at = bytes(garbled).index(serialized(60)) + 12
    garbled[at : at + 4] = b"\xff\xff\xff\x7f"  # the length of frame_id
    bad.write_bytes(garbled)
    found, damage = read(bad)
    assert found == [index for index in range(COUNT) if index != 60]
    assert damage is not None
    assert damage.endswith(f"1 × a message on /odom that cannot be decoded; {COUNT - 1} messages can be read")


def test_a_part_of_a_damaged_recording(tmp_path: Path) -> None:
    whole = recording(tmp_path / "cut.mcap")
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    with BagReader(tmp_path / "cut.mcap", salvage=True) as bag:
        times = [time for _, time, _ in bag.decoded(["/odom"], START_NS + 20 * STEP_NS, START_NS + 30 * STEP_NS)]
        assert times == [START_NS + index * STEP_NS for index in range(20, 30)]
        assert bag.topics == {"/odom": ODOMETRY} and list(bag.decoded(["/wind"])) == []


def test_messages_of_one_moment_come_once(tmp_path: Path) -> None:
    """Reading begins again where the damage shows, in the middle of messages with one and the same time."""
    definition, _ = typestore().generate_msgdef(ODOMETRY)
    with (tmp_path / "same.mcap").open("wb") as file:
        writer = McapWriter(file, chunk_size=CHUNK, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema(ODOMETRY, "ros2msg", definition.encode())
        channel = writer.register_channel("/odom", "cdr", schema)
        for index in range(COUNT):
            writer.add_message(channel, START_NS, serialized(index), START_NS)
        writer.finish()
    garbled = bytearray((tmp_path / "same.mcap").read_bytes())
    garbled[len(garbled) // 2] ^= 1
    (tmp_path / "same.mcap").write_bytes(garbled)
    found, damage = read(tmp_path / "same.mcap")
    assert damage is not None and len(found) == len(set(found)) > COUNT - 15


def write_bag(path: Path) -> None:
    with BagWriter(path) as bag:
        bag.add_topic("/odom", ODOMETRY)
        for index in range(COUNT):
            bag.write_raw("/odom", START_NS + index * STEP_NS, serialized(index))


def test_the_folder_of_a_recorder_that_was_killed(tmp_path: Path) -> None:
    """It has no metadata.yaml; its last file is cut off, and one has nothing in it."""
    folder = tmp_path / "killed"
    folder.mkdir()
    whole = recording(folder / "killed_2.mcap")
    later = recording(folder / "killed_10.mcap")
    (folder / "killed_10.mcap").write_bytes(later[: len(later) // 2])
    (folder / "killed_11.mcap").touch()
    found, damage = read(folder)
    cut = len(found) - COUNT
    assert len(whole) == len(later) and COUNT / 2 - 15 < cut < COUNT / 2 + 5
    assert sorted(found) == sorted([*range(COUNT), *range(cut)])
    assert damage is not None and "killed_10.mcap is cut off" in damage and "killed_11.mcap is cut off" in damage
    with pytest.raises(BagReadError, match=r"no metadata\.yaml"):
        BagReader(folder)


def test_a_bag_whose_metadata_are_lost(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").write_bytes(b"")
    found, damage = read(tmp_path / "bag")
    assert found == list(range(COUNT))
    assert damage is not None and "metadata" in damage and damage.endswith("200 messages can be read")


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"nothing of the kind" * 100])
def test_a_file_of_which_nothing_can_be_read(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "no.mcap").write_bytes(content)
    with pytest.raises(BagReadError, match="not a readable bag"), BagReader(tmp_path / "no.mcap", salvage=True):
        pass


def garbled_somewhere(whole: bytes) -> Iterator[bytes]:
    rng = np.random.default_rng(0)
    for _ in range(60):
        garbled = bytearray(whole)
        for position in rng.integers(0, len(whole), int(rng.integers(1, 30))):
            garbled[position] = rng.integers(0, 256)
        yield bytes(garbled[: int(rng.integers(1, len(whole)))] if rng.random() < 0.3 else garbled)


@pytest.mark.parametrize("crc", [True, False])
def test_garbled_anywhere_nothing_false_is_read(tmp_path: Path, crc: bool) -> None:
    """No crash, no message twice; behind a checksum none that was not recorded, and most of the others."""
    whole = recording(tmp_path / "some.mcap", crc=crc)
    for garbled in garbled_somewhere(whole):
        (tmp_path / "some.mcap").write_bytes(garbled)
        try:
            with BagReader(tmp_path / "some.mcap", salvage=True) as bag:
                data = [message.data for message in bag.messages()]
        except BagReadError:
            continue
        if crc:
            known = {serialized(index): index for index in range(COUNT)}
            order = [known[bytes(each)] for each in data if bytes(each) in known]
            assert order == sorted(set(order)) and len(data) - len(order) <= 13  # of a chunk that is cut off
