from __future__ import annotations

import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rotavg_ros.bags import graph_bag, message_types
from rotavg_ros.bags.graph_from_bag import read_graph_bag
from rotavg_ros.bags.message_types import ODOMETRY, MessageTypeError, definitions_folder, typestore
from rotavg_ros.bags.messages import Edge, Keyframe, edge_message, odometry_message, read_edge, read_odometry
from rotavg_ros.bags.reader import BagReader, BagReadError
from rotavg_ros.bags.writer import BagWriteError, BagWriter
from rotavg_ros.cli.convert import format_of

definitions_folder_of_the_sources = definitions_folder()
START_NS = 1_700_000_000_123_456_789


def write_odometry(path: Path, count: int = 5, *, overwrite: bool = False, topic: str = "/odom") -> None:
    with BagWriter(path, overwrite=overwrite) as bag:
        bag.add_topic(topic, ODOMETRY, latched=topic == "/latched")
        for index in range(count):
            stamp = START_NS + index * 100_000_000
            bag.write(topic, stamp, odometry_message(stamp, np.arange(3.0), np.array([0, 0, 0, 1.0]), "odom"))


def test_messages_survive_serialisation() -> None:
    edge = Edge(
        stamp_ns=START_NS,
        id=2**64 - 2,
        sequence=2**32 - 1,
        source=Keyframe(7, START_NS - 5, "robot_a"),
        target=Keyframe(None, START_NS),
        source_from_target=np.array([0.1, 0.2, 0.3, 0.9]),
        precision=1234.5,
        kind=1,
    )
    name = "rotavg_msgs/msg/RelativeRotation"
    data = typestore().serialize_cdr(edge_message(edge), name)
    back = read_edge(typestore().deserialize_cdr(data, name))
    np.testing.assert_array_equal(back.source_from_target, edge.source_from_target)
    for field in ("stamp_ns", "id", "sequence", "source", "target", "precision", "kind"):
        assert getattr(back, field) == getattr(edge, field)
    message = odometry_message(START_NS, np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.6, 0.0, 0.8]), "map")
    assert read_odometry(message) == (START_NS, [1.0, 2.0, 3.0], [0.0, 0.6, 0.0, 0.8])


def test_the_definitions_are_those_of_the_interface_package() -> None:
    assert {path.stem for path in definitions_folder().glob("*.msg")} >= {"RelativeRotation", "OutlierFlags"}
    rotavg_msgs = pytest.importorskip("rotavg_msgs.msg")
    for name in ("RelativeRotation", "KeyframeReference", "AbsoluteOrientations", "OutlierFlags"):
        fields = [field for field, _ in typestore().fielddefs[f"rotavg_msgs/msg/{name}"][1]]
        assert fields == list(getattr(rotavg_msgs, name).get_fields_and_field_types())


@pytest.mark.parametrize("site", ["lib/python3.12/site-packages", "."])
def test_the_definitions_are_found_where_an_installation_puts_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, site: str
) -> None:
    module = tmp_path / site / "rotavg_ros" / "bags" / "message_types.py"
    monkeypatch.setattr(message_types, "__file__", str(module))
    with pytest.raises(MessageTypeError, match="install rotavg_ros again"):
        message_types.definitions_folder()
    share = tmp_path / "share" / "rotavg_ros" / "msg"
    shutil.copytree(definitions_folder_of_the_sources, share)
    assert message_types.definitions_folder() == share


def test_a_written_bag_is_an_mcap_that_others_read(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run")
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == ["metadata.yaml", "run.mcap"]
    with (tmp_path / "run" / "run.mcap").open("rb") as file:
        messages = list(make_reader(file).iter_messages())
    assert [message.log_time for _, _, message in messages] == [START_NS + k * 100_000_000 for k in range(5)]
    assert {schema.name for schema, _, _ in messages if schema} == {ODOMETRY}


def test_an_existing_output_is_refused_unless_overwritten(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run", 5)
    with pytest.raises(BagWriteError, match="exists already"):
        write_odometry(tmp_path / "run", 3)
    with BagReader(tmp_path / "run") as bag:
        assert bag.num_messages() == 5
    write_odometry(tmp_path / "run", 3, overwrite=True)
    with BagReader(tmp_path / "run") as bag:
        assert bag.num_messages() == 3


def test_overwrite_spares_what_is_not_a_bag(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    with pytest.raises(BagWriteError, match="not a bag"):
        write_odometry(tmp_path / "thesis", overwrite=True)
    assert (tmp_path / "thesis" / "chapter1.tex").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(BagWriteError, match="not a bag"):
        write_odometry(tmp_path / "file", overwrite=True)


@pytest.mark.parametrize("name", ["notes.txt", "answer/report.html"])
def test_overwrite_spares_a_bag_with_files_that_are_not_its_own(tmp_path: Path, name: str) -> None:
    write_odometry(tmp_path / "run", 5)
    mine = tmp_path / "run" / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("by hand")
    with pytest.raises(BagWriteError, match=f"run: holds {name.split('/')[0]} as well, .* move it away"):
        write_odometry(tmp_path / "run", 3, overwrite=True)
    assert mine.read_text() == "by hand"
    with BagReader(tmp_path / "run") as bag:
        assert bag.num_messages() == 5


def test_overwrite_replaces_whatever_a_recorder_has_left(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run", 5)
    for name in ("run_1.mcap", "run_2.mcap.zstd", "run_0.db3", "run_0.db3-wal", "run_0.db3-shm"):
        (tmp_path / "run" / name).touch()
    write_odometry(tmp_path / "run", 3, overwrite=True)
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"metadata.yaml", "run.mcap"}


def test_a_bag_behind_a_link_is_written_where_it_lies(tmp_path: Path) -> None:
    write_odometry(tmp_path / "disk" / "run", 5)
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "run")
    write_odometry(tmp_path / "link", 3, overwrite=True)
    assert (tmp_path / "link").is_symlink()
    with BagReader(tmp_path / "disk" / "run") as bag:
        assert bag.num_messages() == 3


@pytest.mark.parametrize("name", [".", "inside/.."])
def test_the_folder_one_is_in_is_no_place_for_a_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    write_odometry(tmp_path / "run", 5)
    (tmp_path / "run" / "inside").mkdir()
    monkeypatch.chdir(tmp_path / "run")
    with pytest.raises(BagWriteError, match=f"^{re.escape(name)}: is the folder you are in"):
        write_odometry(Path(name), overwrite=True)
    monkeypatch.chdir(tmp_path)
    write_odometry(Path("run/inside/.."), 3, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    with BagReader(tmp_path / "run") as bag:
        assert bag.num_messages() == 3


def test_an_interrupted_recording_leaves_nothing(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run", 5)

    def interrupted() -> None:
        with BagWriter(tmp_path / "run", overwrite=True) as bag:
            bag.add_topic("/odom", ODOMETRY)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    with BagReader(tmp_path / "run") as bag:
        assert bag.num_messages() == 5


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BagWriteError, match="cannot be written"):
        write_odometry(tmp_path / "file" / "run")


def test_truncated_recordings(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run", 2000)
    recording = tmp_path / "run" / "run.mcap"
    whole = recording.read_bytes()
    for length in (0, 5, 100, len(whole) // 2, len(whole) - 10):
        recording.write_bytes(whole[:length])
        with pytest.raises(BagReadError, match="truncated") as caught, BagReader(tmp_path / "run") as bag:
            list(bag.decoded(["/odom"]))
        assert "\n" not in str(caught.value)


def test_garbled_recordings_never_crash(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run", 50)
    recording = tmp_path / "run" / "run.mcap"
    whole = bytearray(recording.read_bytes())
    rng = np.random.default_rng(0)
    for _ in range(100):
        garbled = whole.copy()
        for position in rng.integers(0, len(whole), 20):
            garbled[position] = rng.integers(0, 256)
        recording.write_bytes(garbled)
        with suppress(BagReadError), BagReader(tmp_path / "run") as bag:
            list(bag.decoded(["/odom"]))


@pytest.mark.parametrize("metadata", ["", "nonsense", "rosbag2_bagfile_information: {version: 99}"])
def test_broken_metadata(tmp_path: Path, metadata: str) -> None:
    write_odometry(tmp_path / "run")
    (tmp_path / "run" / "metadata.yaml").write_text(metadata)
    with pytest.raises(BagReadError, match="not a readable bag"), BagReader(tmp_path / "run"):
        pass


def test_a_folder_of_recordings_in_which_nothing_is(tmp_path: Path) -> None:
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / "killed_0.mcap").touch()
    told = r"\(it has no metadata\.yaml, and no message in it can be read\)"
    with pytest.raises(BagReadError, match=told), BagReader(tmp_path / "killed", salvage=True):
        pass


def test_paths_that_are_no_bags(tmp_path: Path) -> None:
    with pytest.raises(BagReadError, match="no such bag"):
        BagReader(tmp_path / "nothing")
    with pytest.raises(BagReadError, match=r"metadata\.yaml"):
        BagReader(tmp_path)
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(BagReadError, match="give a bag"):
        BagReader(tmp_path, salvage=True)
    (tmp_path / "graph.g2o").write_text("")
    with pytest.raises(BagReadError, match="suffix"):
        BagReader(tmp_path / "graph.g2o")
    (tmp_path / "foreign.mcap").write_text("not an mcap")
    with pytest.raises(BagReadError, match="not a readable bag"), BagReader(tmp_path / "foreign.mcap"):
        pass


def test_missing_topics_name_the_candidates(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run", topic="/wheel/odom")
    with BagReader(tmp_path / "run") as bag:
        with pytest.raises(BagReadError, match=r"no topic /odom.*topics of that type: /wheel/odom"):
            bag.require("/odom", ODOMETRY)
        with pytest.raises(BagReadError, match="has type nav_msgs/msg/Odometry, not"):
            bag.require("/wheel/odom", "sensor_msgs/msg/Imu")
    with pytest.raises(BagReadError, match="no topic /relative_rotations"):
        read_graph_bag(tmp_path / "run")


def test_latched_topics_are_known(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run", topic="/latched")
    write_odometry(tmp_path / "other")
    with BagReader(tmp_path / "run") as bag:
        assert bag.is_latched("/latched")
    with BagReader(tmp_path / "other") as bag:
        assert not bag.is_latched("/odom")


def test_a_single_recording_is_a_bag(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run")
    with BagReader(tmp_path / "run" / "run.mcap") as bag:
        assert bag.num_messages() == 5
    shutil.move(tmp_path / "run" / "run.mcap", tmp_path / "alone.mcap")
    with BagReader(tmp_path / "alone.mcap") as bag:
        assert len(list(bag.decoded(["/odom"]))) == 5
        assert bag.is_ros2


def test_a_recording_beside_a_bag_is_no_part_of_it(tmp_path: Path) -> None:
    write_odometry(tmp_path / "run", 5)
    write_odometry(tmp_path / "more", 3)
    other = tmp_path / "run" / "other.mcap"
    shutil.move(tmp_path / "more" / "more.mcap", other)
    for path, count, is_alone in (
        (other, 3, True),
        (tmp_path / "run" / "run.mcap", 5, False),
        (tmp_path / "run", 5, False),
    ):
        with BagReader(path) as bag:
            assert (bag.num_messages(), bag.path) == (count, other if is_alone else tmp_path / "run")
    (tmp_path / "run" / "metadata.yaml").write_text("nonsense")  # tells nothing of any file
    with BagReader(other) as bag:
        assert bag.num_messages() == 3


def write_sqlite(folder: Path, count: int = 5) -> Path:
    """A bag in an sqlite file, as rosbags writes one; returns the file."""
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
    with writer:
        connection = writer.add_connection("/odom", ODOMETRY, typestore=typestore())
        for index in range(count):
            message = odometry_message(START_NS + index, np.zeros(3), np.array([0, 0, 0, 1.0]), "odom")
            writer.write(connection, START_NS + index, bytes(typestore().serialize_cdr(message, ODOMETRY)))
    (recording,) = folder.glob("*.db3")
    return recording


@pytest.mark.parametrize("is_folder", [True, False])
@pytest.mark.parametrize("salvage", [True, False])
def test_a_log_that_a_killed_recorder_has_left(tmp_path: Path, is_folder: bool, salvage: bool) -> None:
    recording = write_sqlite(tmp_path / "my run")
    recorder = (
        "import os, sqlite3, sys; file = sqlite3.connect(sys.argv[1]); file.execute('PRAGMA journal_mode=WAL'); "
        "file.execute('INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, timestamp + 5, data FROM "
        "messages'); file.commit(); os._exit(1)"
    )
    subprocess.run([sys.executable, "-c", recorder, recording], check=False)
    log = recording.with_name(f"{recording.name}-wal")
    assert log.stat().st_size > 0
    path = recording.parent if is_folder else recording
    with pytest.raises(BagReadError) as caught:
        BagReader(path, salvage=salvage)
    message = str(caught.value)
    assert (
        message.startswith(f"{recording}: its last messages are still in {log.name} beside it") and "\n" not in message
    )
    # What it says to do does it; Python's module is the same library as the program.
    program, file, statement = shlex.split(re.findall("`(.*)`", message)[0])
    assert program == "sqlite3"
    with closing(sqlite3.connect(file)) as database:
        database.execute(statement)
    with BagReader(recording) as bag:  # the metadata does not know of them
        assert len(list(bag.messages())) == 10
    log.touch()  # an empty one has nothing
    BagReader(path, salvage=salvage)


@pytest.mark.parametrize("part", [0.3, 0.7, 0.95])
def test_cut_files_that_other_tools_have_to_repair(tmp_path: Path, part: float) -> None:
    """As the troubleshooting page says: of them nothing is read, though salvage is asked for."""
    sqlite_file, ros1_file = write_sqlite(tmp_path / "run", 200), tmp_path / "old.bag"
    store = get_typestore(Stores.ROS1_NOETIC)
    with Rosbag1Writer(ros1_file) as writer:
        connection = writer.add_connection("/text", "std_msgs/msg/String", typestore=store)
        text = store.serialize_ros1(store.types["std_msgs/msg/String"](data="x" * 1000), "std_msgs/msg/String")
        for index in range(200):
            writer.write(connection, START_NS + index, text)
    for path in (sqlite_file, ros1_file):
        whole = path.read_bytes()
        path.write_bytes(whole[: int(part * len(whole))])
        told = "truncated" if path == sqlite_file else r"truncated.*`rosbag reindex .*old\.bag`"
        with pytest.raises(BagReadError, match=told), BagReader(path, salvage=True):
            pass


def test_a_log_of_a_recording_that_is_not_meant(tmp_path: Path) -> None:
    recording = write_sqlite(tmp_path / "run")
    (tmp_path / "run" / "other.db3-wal").write_text("anything")
    (tmp_path / "run" / "other.db3").write_text("anything")
    for path in (recording, recording.parent):
        with BagReader(path) as bag:
            assert bag.num_messages() == 5


def test_a_folder_without_metadata_names_its_recording(tmp_path: Path) -> None:
    recording = write_sqlite(tmp_path / "my run")
    (recording.parent / "metadata.yaml").unlink()
    expected = (
        rf"has no metadata\.yaml; name the recording in it \({recording.name}\), or .*`ros2 bag reindex '.*my run'`"
    )
    for salvage in (True, False):
        with pytest.raises(BagReadError, match=expected):
            BagReader(recording.parent, salvage=salvage)
    with BagReader(recording) as bag:
        assert bag.num_messages() == 5
    write_odometry(tmp_path / "run")
    (tmp_path / "run" / "metadata.yaml").unlink()
    with pytest.raises(BagReadError, match=r"name the recording in it \(run\.mcap\)"):
        BagReader(tmp_path / "run")


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE])
def test_bags_of_others_with_types_of_their_own(tmp_path: Path, mode: CompressionMode) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float64 value\nstring name", "their_msgs/msg/Thing"))
    writer = Writer(tmp_path / "theirs", version=8, storage_plugin=StoragePlugin.MCAP)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/thing", "their_msgs/msg/Thing", typestore=store)
        thing = store.types["their_msgs/msg/Thing"](value=2.5, name="x")
        writer.write(connection, 10, store.serialize_cdr(thing, "their_msgs/msg/Thing"))
    with BagReader(tmp_path / "theirs") as bag:
        [(topic, time_ns, message)] = bag.decoded(["/thing"])
    assert (topic, time_ns, message.value, message.name) == ("/thing", 10, 2.5, "x")


@pytest.mark.parametrize("storage", StoragePlugin)
def test_a_compressed_recording_that_is_named_itself(tmp_path: Path, storage: StoragePlugin) -> None:
    writer = Writer(tmp_path / "run", version=9, storage_plugin=storage)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/odom", ODOMETRY, typestore=typestore())
        message = odometry_message(START_NS, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), "odom")
        writer.write(connection, START_NS, typestore().serialize_cdr(message, ODOMETRY))
    (recording,) = (tmp_path / "run").glob("*.zstd")
    with BagReader(recording) as bag:
        assert (bag.num_messages(), bag.path) == (1, tmp_path / "run")
    assert format_of(recording) is graph_bag
    alone = shutil.move(recording, tmp_path / recording.name)
    with pytest.raises(BagReadError, match=f"unpack it by `unzstd {alone}`"):
        BagReader(alone)


def test_a_topic_of_two_types_is_of_the_one_with_more_messages(tmp_path: Path) -> None:
    store, pose = typestore(), "geometry_msgs/msg/PoseStamped"
    with Writer(tmp_path / "two", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {kind: writer.add_connection("/odom", kind, typestore=store) for kind in (ODOMETRY, pose)}
        for index in range(5):
            odometry = odometry_message(START_NS + index, np.arange(3.0), np.array([0, 0, 0, 1.0]), "odom")
            messages = {ODOMETRY: odometry, pose: store.types[pose](odometry.header, odometry.pose.pose)}
            for kind in (ODOMETRY, pose) if index % 2 else (ODOMETRY,):
                writer.write(connections[kind], START_NS + index, store.serialize_cdr(messages[kind], kind))
    with BagReader(tmp_path / "two") as bag:
        assert bag.topics == {"/odom": ODOMETRY}
        assert [message.child_frame_id for _, _, message in bag.decoded(["/odom"])] == ["base_link"] * 5


def test_real_bags(shared_data: Path) -> None:
    with BagReader(shared_data / "bags" / "husky_test1.bag") as bag:
        assert not bag.is_ros2
        assert len(list(bag.decoded(["/husky_velocity_controller/odom"]))) == 3952
    with BagReader(shared_data / "bags" / "nav2_turtlebot.mcap") as bag:
        assert bag.is_ros2
        assert len(list(bag.decoded(["/odom"]))) == 2639
