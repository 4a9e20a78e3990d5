from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.bags.graph_from_bag import read_graph_bag
from rotavg_ros.bags.graph_to_bag import write_graph_bag
from rotavg_ros.bags.message_types import ODOMETRY, RELATIVE_ROTATION, RELATIVE_ROTATION_ARRAY, TRANSFORMS, typestore
from rotavg_ros.bags.messages import Edge, Keyframe, edge_message, odometry_message
from rotavg_ros.bags.reader import BagReader, BagReadError
from rotavg_ros.bags.run_bag import write_run_bag
from rotavg_ros.bags.topics import EDGE_ARRAY_TOPIC, EDGE_TOPIC, ODOM_TOPIC, TRUTH_TOPIC
from rotavg_ros.bags.writer import BagWriteError, BagWriter
from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import read_graph, write_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.files.ground_truth import attach_stamps, attach_truth
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.online import EstimatorOptions, OnlineEstimator
from rotavg_ros.view_graph import EdgeKind


def simulated(seed: int = 0, **changes: object) -> SimulatedRun:
    config = replace(SlamSimulationConfig(num_keyframes=300, false_share=0.3), **changes)
    return simulate_slam_graph(config, np.random.default_rng(seed))


def assert_same(read: GraphFile, written: GraphFile) -> None:
    """Equal in everything a bag carries."""
    for name in ("source", "target", "kind"):
        assert torch.equal(getattr(read.graph, name), getattr(written.graph, name)), name
    assert read.graph.num_nodes == written.graph.num_nodes
    difference = (read.graph.target_from_source - written.graph.target_from_source).abs().max()
    assert float(difference) < 1e-9
    np.testing.assert_array_equal(read.graph.precision.numpy(), written.graph.precision.numpy())
    np.testing.assert_array_equal(read.node_ids, written.node_ids)
    assert read.planar == written.planar
    for name in ("edge_translation", "stamps_ns", "body_from_world_gt", "position_gt"):
        expected, got = getattr(written, name), getattr(read, name)
        if expected is None:
            assert got is None, name
        else:
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("world", [World.BUILDING, World.SPHERE])
def test_round_trip(tmp_path: Path, world: World) -> None:
    graph_file = simulated(world=world, dimensions=2 if world is World.BUILDING else 3).to_graph_file()
    write_graph_bag(tmp_path / "bag", graph_file)
    assert_same(read_graph_bag(tmp_path / "bag"), graph_file)


def test_round_trip_of_a_bare_graph(tmp_path: Path) -> None:
    graph = simulated().graph
    # Edges in no order, ids with gaps, unknown precisions, a node without edges, nothing else known.
    shuffled = graph.select_edges(torch.from_numpy(np.random.default_rng(0).permutation(graph.num_edges)))
    precision = shuffled.precision.clone()
    precision[::3] = torch.nan
    graph_file = GraphFile(
        replace(shuffled, precision=precision, num_nodes=graph.num_nodes + 1),
        np.append(np.arange(graph.num_nodes) * 7 + 3, 2**62),
        planar=True,
    )
    write_graph_bag(tmp_path / "bag", graph_file)
    assert_same(read_graph_bag(tmp_path / "bag"), graph_file)


def test_round_trip_without_odometry(tmp_path: Path) -> None:
    graph = simulated(dimensions=3).graph
    graph_file = GraphFile(replace(graph, kind=torch.ones_like(graph.kind)), np.arange(graph.num_nodes))
    write_graph_bag(tmp_path / "bag", graph_file)
    with BagReader(tmp_path / "bag") as bag:
        assert bag.topics == {EDGE_TOPIC: RELATIVE_ROTATION}
    assert_same(read_graph_bag(tmp_path / "bag"), graph_file)


@pytest.mark.parametrize("knows", ["all but some", "orientations", "positions"])
def test_round_trip_of_a_truth_with_gaps(tmp_path: Path, knows: str) -> None:
    """What is not known stays so, and what is known of a node stays without the rest."""
    graph_file = simulated(num_keyframes=60).to_graph_file()
    assert graph_file.position_gt is not None and graph_file.body_from_world_gt is not None
    position, orientation = graph_file.position_gt.copy(), graph_file.body_from_world_gt.copy()
    position[3], orientation[5], position[7], orientation[7] = np.nan, np.nan, np.nan, np.nan
    graph_file = replace(
        graph_file,
        position_gt=None if knows == "orientations" else position,
        body_from_world_gt=None if knows == "positions" else orientation,
    )
    write_graph_bag(tmp_path / "bag", graph_file)
    assert_same(read_graph_bag(tmp_path / "bag"), graph_file)


def test_round_trip_of_a_truth_of_some_nodes_of_a_stamp(tmp_path: Path) -> None:
    graph_file = simulated(num_keyframes=60).to_graph_file()
    assert graph_file.body_from_world_gt is not None
    orientation = graph_file.body_from_world_gt.copy()
    orientation[::3] = np.nan
    stamps_ns = np.arange(60) // 4 * 10**9
    graph_file = replace(graph_file, stamps_ns=stamps_ns, body_from_world_gt=orientation, position_gt=None)
    write_graph_bag(tmp_path / "bag", graph_file)
    assert_same(read_graph_bag(tmp_path / "bag"), graph_file)


def test_round_trip_of_the_truth_of_a_node_without_edges(tmp_path: Path) -> None:
    graph_file = simulated(num_keyframes=60).to_graph_file()
    graph = graph_file.graph
    chosen = torch.nonzero((graph.source != 20) & (graph.target != 20)).squeeze(1)
    lone = replace(
        graph_file,
        graph=graph.select_edges(chosen),
        edge_translation=None if graph_file.edge_translation is None else graph_file.edge_translation[chosen.numpy()],
        stamps_ns=None,
    )
    write_graph_bag(tmp_path / "bag", lone)
    assert_same(read_graph_bag(tmp_path / "bag"), lone)


def test_a_true_pose_that_is_none_is_not_known(tmp_path: Path) -> None:
    """As of a motion capture that has lost the robot."""
    graph_file = simulated(num_keyframes=60).to_graph_file()
    write_graph_bag(tmp_path / "bag", graph_file)
    with BagReader(tmp_path / "bag") as whole, BagWriter(tmp_path / "lost") as lost:
        for topic, kind in whole.topics.items():
            lost.add_topic(topic, kind)
        for message in whole.messages([EDGE_TOPIC]):
            lost.write_raw(message.topic, message.time_ns, message.data)
        for index, (topic, time_ns, message) in enumerate(whole.decoded([TRUTH_TOPIC])):
            message.pose.pose.orientation.w *= index % 4 > 0
            message.pose.pose.orientation.z *= index % 4 > 0
            lost.write(topic, time_ns, message)
    read = read_graph_bag(tmp_path / "lost")
    assert read.body_from_world_gt is not None
    assert np.isnan(read.body_from_world_gt).any(axis=1).tolist() == [index % 4 == 0 for index in range(60)]
    write_graph(tmp_path / "lost.npz", read)
    assert read_graph(tmp_path / "lost.npz").body_from_world_gt is not None


def test_round_trip_of_a_real_robot(tmp_path: Path, shared_data: Path) -> None:
    folder = shared_data / "slam" / "b25b"
    graph_file = attach_stamps(read_graph(folder / "B25b_0.000.g2o"), folder / "B25b_timestamps.txt")
    graph_file = attach_truth(graph_file, folder / "ground_truth.csv")
    write_graph_bag(tmp_path / "bag", graph_file)
    assert_same(read_graph_bag(tmp_path / "bag"), graph_file)
    with BagReader(tmp_path / "bag") as bag:
        assert bag.num_messages([ODOM_TOPIC]) == 8358
        assert bag.num_messages([TRUTH_TOPIC]) == 7352


@pytest.mark.parametrize("seconds", [-1, 9_000_000_000])
def test_stamps_that_no_message_can_have(tmp_path: Path, seconds: int) -> None:
    graph_file = replace(simulated().to_graph_file(), stamps_ns=np.arange(300) + seconds * 10**9)
    with pytest.raises(BagWriteError, match=f"bag: node 0 has the stamp {seconds} s; a bag's stamps lie"):
        write_graph_bag(tmp_path / "bag", graph_file)
    assert not (tmp_path / "bag").exists()


def test_edges_are_published_when_their_later_end_exists(tmp_path: Path) -> None:
    run = simulated()
    write_graph_bag(tmp_path / "bag", run.to_graph_file())
    newest_odometry, sequence = 0, 0
    with BagReader(tmp_path / "bag") as bag:
        for topic, time_ns, message in bag.decoded([ODOM_TOPIC, EDGE_TOPIC]):
            stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            assert stamp_ns == time_ns
            if topic == ODOM_TOPIC:
                newest_odometry = stamp_ns
                continue
            sequence += 1
            assert message.sequence == sequence
            ends = [end.stamp.sec * 1_000_000_000 + end.stamp.nanosec for end in (message.source, message.target)]
            assert max(ends) == newest_odometry


def test_ros_conventions_in_the_bag(tmp_path: Path) -> None:
    """world_from_target = world_from_source ∘ rotation, for orientations of /ground_truth."""
    run = simulated(dimensions=3, closure_noise_deg=0, odometry_noise_deg=0, false_share=0)
    write_graph_bag(tmp_path / "bag", run.to_graph_file())
    orientation, position = {}, {}
    checked = 0
    with BagReader(tmp_path / "bag") as bag:
        for topic, _, message in bag.decoded([TRUTH_TOPIC, EDGE_TOPIC]):
            if topic == TRUTH_TOPIC:
                q, p = message.pose.pose.orientation, message.pose.pose.position
                stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
                orientation[stamp] = Rotation.from_quat([q.x, q.y, q.z, q.w])
                position[stamp] = np.array([p.x, p.y, p.z])
                continue
            source, target = ((end.stamp.sec, end.stamp.nanosec) for end in (message.source, message.target))
            q = message.rotation
            reached = orientation[source] * Rotation.from_quat([q.x, q.y, q.z, q.w])
            assert (reached.inv() * orientation[target]).magnitude() < 1e-7
            checked += 1
    assert checked == run.graph.num_edges


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_robots_run_reads_back_as_its_graph(tmp_path: Path, dimensions: int) -> None:
    config = RobotRun("building", dimensions=dimensions, laps=2).config()
    run = simulate_slam_graph(config, np.random.default_rng(1))
    write_run_bag(tmp_path / "bag", run)
    with BagReader(tmp_path / "bag") as bag:
        assert bag.topics[ODOM_TOPIC] == bag.topics[TRUTH_TOPIC] == ODOMETRY
        assert bag.num_messages([ODOM_TOPIC]) == config.num_keyframes
        assert bag.duration_s == pytest.approx((config.num_keyframes - 1) * 0.1)
        closures = int((run.graph.kind == 1).sum())
        assert bag.num_messages([EDGE_TOPIC]) == closures
    read = read_graph_bag(tmp_path / "bag")
    assert torch.equal(read.graph.source, run.graph.source)
    assert torch.equal(read.graph.target, run.graph.target)
    assert torch.equal(read.graph.kind, run.graph.kind)
    assert float((read.graph.target_from_source - run.graph.target_from_source).abs().max()) < 1e-12
    np.testing.assert_allclose(read.edge_translation, run.edge_translation, atol=1e-9)
    np.testing.assert_allclose(read.position_gt, run.position)
    assert read.planar == (dimensions == 2)


def bag_of_edges(path: Path, edges: list[Edge], odometry_ns: Sequence[int] = (), *, in_array: bool = False) -> Path:
    """A bag of these edges, after odometry that stands still at these moments."""
    messages = list(map(edge_message, edges))
    with BagWriter(path) as bag:
        topic, kind = (EDGE_ARRAY_TOPIC, RELATIVE_ROTATION_ARRAY) if in_array else (EDGE_TOPIC, RELATIVE_ROTATION)
        bag.add_topic(topic, kind)
        if odometry_ns:
            bag.add_topic(ODOM_TOPIC, ODOMETRY)
        for stamp in odometry_ns:
            bag.write(ODOM_TOPIC, stamp, odometry_message(stamp, np.zeros(3), np.array([0, 0, 0, 1.0]), "odom"))
        after = max(odometry_ns, default=0)
        for message in [typestore().types[kind](messages[0].header, messages)] if in_array else messages:
            bag.write(topic, after + message.header.stamp.nanosec, message)
    return path


def edge(number: int, source: Keyframe, target: Keyframe, rotation: tuple[float, ...] = (0, 0, 0, 1.0)) -> Edge:
    return Edge(10 + number, number, number + 1, source, target, np.array(rotation), np.nan, 1)


def test_self_edges_are_skipped_and_counted(tmp_path: Path) -> None:
    first, second = Keyframe(3, 5), Keyframe(9, 6)
    bag = bag_of_edges(tmp_path / "bag", [edge(0, first, second), edge(1, second, second)])
    graph_file = read_graph_bag(bag)
    assert graph_file.skipped == {"self-edges": 1}
    assert graph_file.node_ids.tolist() == [3, 9]
    assert graph_file.stamps_ns.tolist() == [5, 6]


@pytest.mark.parametrize(("first", "again", "stamps"), [(0, 0, None), (5, 0, [5, 6]), (0, 5, [5, 6]), (0, 0, [0, 6])])
def test_a_stamp_that_is_not_stated_is_none(tmp_path: Path, first: int, again: int, stamps: list[int] | None) -> None:
    second = Keyframe(9, stamps[1] if stamps else 0)
    bag = bag_of_edges(tmp_path / "bag", [edge(0, Keyframe(3, first), second), edge(1, Keyframe(3, again), second)])
    read = read_graph_bag(bag)
    assert (read.stamps_ns if read.stamps_ns is None else read.stamps_ns.tolist()) == stamps
    write_graph_bag(tmp_path / "written", read)
    assert_same(read_graph_bag(tmp_path / "written"), read)


@pytest.mark.parametrize(
    ("edges", "complaint"),
    [
        ([edge(0, Keyframe(1, 0, "a"), Keyframe(2, 0, "b"))], "several robots .* `rotavg replay` reads"),
        ([edge(0, Keyframe(1, 0), Keyframe(2**63, 0))], "too large"),
        ([edge(0, Keyframe(1, 0), Keyframe(2, 0), (0, 0, 0, 0.5))], "no edge can be used; 1 × edges whose rotation"),
        ([edge(0, Keyframe(1, 0), Keyframe(2, 0), (0, 0, 0, np.nan))], "no edge can be used; 1 × edges whose rotation"),
        (
            [replace(edge(0, Keyframe(1, 0), Keyframe(2, 0)), kind=7)],
            "no edge can be used; 1 × edges of an unknown kind",
        ),
        ([edge(0, Keyframe(None, 0), Keyframe(2, 0))], "no topic /odom"),
        ([], "no topic /odom"),
        ([edge(0, Keyframe(1, 0), Keyframe(1, 0))], "no edge joins two keyframes"),
    ],
)
def test_what_makes_no_graph_is_refused(tmp_path: Path, edges: list[Edge], complaint: str) -> None:
    bag = bag_of_edges(tmp_path / "bag", edges)
    with pytest.raises(BagReadError, match=complaint) as caught:
        read_graph_bag(bag)
    assert str(caught.value).startswith(str(bag))
    assert "\n" not in str(caught.value)


def test_what_a_replay_has_a_use_for_is_told(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/loops", RELATIVE_ROTATION)
        bag.write("/loops", 1, edge_message(edge(0, Keyframe(1, 0), Keyframe(2, 0))))
    with pytest.raises(
        BagReadError, match=r"no topic /relative_rotations .*; `rotavg replay` takes /loops and odometry"
    ):
        read_graph_bag(tmp_path / "bag")


@pytest.mark.parametrize("by_stamp", [False, True])
@pytest.mark.parametrize("in_array", [False, True])
def test_edges_that_the_estimator_refuses_are_skipped_and_counted(
    tmp_path: Path, by_stamp: bool, in_array: bool
) -> None:
    ends = [Keyframe(None if by_stamp else number, number * 10**9) for number in (1, 2, 3)]
    good = [edge(number, ends[number], ends[number + 1]) for number in (0, 1)]
    bad = [
        *(edge(2, ends[0], ends[2], (0, 0, 0, w)) for w in (0.0, 0.5, np.nan)),
        replace(edge(3, ends[0], ends[2]), kind=7),
        replace(edge(4, ends[0], ends[2]), precision=-4.0),
        replace(edge(5, ends[0], ends[2]), translation=np.zeros(2)),
        edge(6, ends[0], replace(ends[2], stamp_ns=-(10**9))),
    ]
    odometry_ns = [end.stamp_ns for end in ends] if by_stamp else []
    bag_of_edges(tmp_path / "good", good, odometry_ns, in_array=in_array)
    bag_of_edges(tmp_path / "all", [*bad, *good], odometry_ns, in_array=in_array)
    read = read_graph_bag(tmp_path / "all")
    assert sorted(read.skipped.values()) == [1, 1, 1, 1, 3]
    assert_same(read, read_graph_bag(tmp_path / "good"))


def test_what_odometry_cannot_place_is_skipped_and_counted(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(EDGE_TOPIC, RELATIVE_ROTATION)
        bag.add_topic(ODOM_TOPIC, ODOMETRY)
        for index in range(3):
            stamp = (index + 1) * 10**9
            bag.write(ODOM_TOPIC, stamp, odometry_message(stamp, np.zeros(3), np.array([0, 0, 0, 1.0]), "odom"))
            for bad in (0.0, np.nan):
                garbled = odometry_message(stamp + 1, np.zeros(3), np.array([0, 0, 0, bad]), "odom")
                bag.write(ODOM_TOPIC, stamp + 1, garbled)
        good = edge(0, Keyframe(None, 10**9 + 10**7), Keyframe(None, 3 * 10**9 - 10**7))
        lost = edge(1, Keyframe(None, 10**9), Keyframe(None, 9 * 10**9))
        for message in (good, lost):
            bag.write(EDGE_TOPIC, 4 * 10**9, edge_message(message))
    graph_file = read_graph_bag(tmp_path / "bag")
    assert sorted(graph_file.skipped.values()) == [1, 6]
    assert graph_file.graph.source.tolist() == [0, 1, 0]
    assert graph_file.graph.target.tolist() == [1, 2, 2]
    assert graph_file.graph.kind.tolist() == [0, 0, 1]


@pytest.mark.parametrize("what", ["set back", "set back, each twice", "in a loop", "strays"])
def test_time_that_goes_back_makes_no_graph(tmp_path: Path, what: str) -> None:
    """Messages of two times would alternate, each a leap; a bag in a loop only says again what it has said."""
    second, stamps = 10**9, [(index + 1) * 10**8 for index in range(60)]
    set_back = [stamp + 10**7 for stamp in stamps[20:40]]
    again = {"set back": set_back, "set back, each twice": np.repeat(set_back, 2).tolist(), "in a loop": stamps}.get(
        what, []
    )
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(EDGE_TOPIC, RELATIVE_ROTATION)
        bag.add_topic(ODOM_TOPIC, ODOMETRY)
        for row, stamp in enumerate([*stamps, *again]):
            said = 2 * 10**18 if what == "strays" and row % 20 == 10 else stamp
            place = np.array([said / second + (what.startswith("set back") and row >= len(stamps)) * 50.0, 0, 0])
            told = odometry_message(said, place, np.array([0, 0, 0, 1.0]), "odom")
            bag.write(ODOM_TOPIC, (row + 1) * second, told)
        bag.write(EDGE_TOPIC, 1000 * second, edge_message(edge(0, Keyframe(None, second), Keyframe(None, 2 * second))))
    if what.startswith("set back"):
        with pytest.raises(BagReadError, match=r"time goes back by 3\.5 s after 60 messages.*`rotavg replay`"):
            read_graph_bag(tmp_path / "bag")
    else:
        assert read_graph_bag(tmp_path / "bag").graph.num_nodes == (60 if what == "in a loop" else 57)


@pytest.mark.parametrize("what", ["begins anew", "after a pause", "a wild pose"])
def test_odometry_is_taken_as_the_estimator_takes_it(
    tmp_path: Path, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A robot that was switched off starts at zero again: no edge of odometry leads there from where it was."""
    estimator = OnlineEstimator(EstimatorOptions(keyframe_angle=0, keyframe_distance=0))
    second = 10**9
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(EDGE_TOPIC, RELATIVE_ROTATION)
        bag.add_topic(ODOM_TOPIC, ODOMETRY)
        for index in range(40):
            is_new = index >= 20 and what != "a wild pose"
            stamp = (index + 1) * second // 10 + 500 * second * (is_new and what == "after a pause")
            angle, x = (0.0, 0.1 * (index - 20)) if is_new else (2.0 + 0.1 * index, 30.0 + index)
            x += 5000.0 * (what == "a wild pose" and index == 25)
            turned = Rotation.from_euler("z", angle).as_quat()
            bag.write(ODOM_TOPIC, stamp, odometry_message(stamp, np.array([x, 0, 0]), turned, "odom"))
            estimator.add_odometry("", stamp, turned, (x, 0, 0))
        closure = edge(0, Keyframe(None, second), Keyframe(None, 2 * second))
        bag.write(EDGE_TOPIC, 1000 * second, edge_message(closure))
    expected = estimator.snapshot()
    read = read_graph_bag(tmp_path / "bag")
    odometry = read.graph.kind == EdgeKind.ODOMETRY
    assert read.stamps_ns is not None
    np.testing.assert_array_equal(read.stamps_ns, expected.stamp_ns)
    for name in ("source", "target"):
        assert torch.equal(getattr(read.graph, name)[odometry], getattr(expected.graph, name)), name
    difference = read.graph.target_from_source[odometry] - expected.graph.target_from_source
    assert float(difference.abs().max()) < 1e-12
    np.testing.assert_allclose(read.graph.translation[odometry], expected.translation, atol=1e-12)
    assert len(expected.stamp_ns) - expected.graph.num_edges == (1 if what == "a wild pose" else 2)
    assert main(["convert", str(tmp_path / "bag"), str(tmp_path / "graph.g2o")]) == 0
    assert ("odometry begins anew 1 ×" in capsys.readouterr().err) == (what != "a wild pose")


def test_odometrys_steps_are_kept_where_no_closure_states_a_translation(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(EDGE_TOPIC, RELATIVE_ROTATION)
        bag.add_topic(ODOM_TOPIC, ODOMETRY)
        left = np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)])
        for index in range(3):
            stamp = (index + 1) * 10**9
            bag.write(ODOM_TOPIC, stamp, odometry_message(stamp, np.array([0.0, index, 0.0]), left, "odom"))
        closure = edge(0, Keyframe(None, 10**9), Keyframe(None, 3 * 10**9))
        bag.write(EDGE_TOPIC, 4 * 10**9, edge_message(closure))
    read = read_graph_bag(tmp_path / "bag")
    np.testing.assert_allclose(read.edge_translation, [[1, 0, 0], [1, 0, 0], [np.nan] * 3], atol=1e-12)


@pytest.mark.parametrize("offset_ns", [0, 30_000_000])
def test_a_truth_of_other_moments_is_taken_between_them(tmp_path: Path, offset_ns: int) -> None:
    """As a motion capture states it, which runs at a rate of its own; after 2.6 s it has lost the robot."""
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(EDGE_TOPIC, RELATIVE_ROTATION)
        for topic in (ODOM_TOPIC, TRUTH_TOPIC):
            bag.add_topic(topic, ODOMETRY)
        for tenths in range(10, 41):
            stamp, shifted = tenths * 10**8, tenths * 10**8 - offset_ns
            if tenths % 10 == 0:
                bag.write(ODOM_TOPIC, stamp, odometry_message(stamp, np.zeros(3), np.array([0, 0, 0, 1.0]), "odom"))
            if tenths <= 26:
                turned = Rotation.from_rotvec([0, 0, 0.3 * shifted / 1e9]).as_quat()
                truth = odometry_message(shifted, np.array([shifted / 1e9, 0, 0]), turned, "map")
                bag.write(TRUTH_TOPIC, stamp, truth)
        closure = edge(0, Keyframe(None, 10**9), Keyframe(None, 3 * 10**9))
        bag.write(EDGE_TOPIC, 4 * 10**9, edge_message(closure))
    read = read_graph_bag(tmp_path / "bag")
    assert read.position_gt is not None and read.body_from_world_gt is not None
    np.testing.assert_allclose(read.position_gt, [[1, 0, 0], [2, 0, 0], [np.nan] * 3, [np.nan] * 3], atol=1e-9)
    turns = Rotation.from_quat(read.body_from_world_gt[:2]).as_rotvec()
    np.testing.assert_allclose(turns, [[0, 0, -0.3], [0, 0, -0.6]], atol=1e-9)


@pytest.mark.parametrize("by_stamp", [False, True])
def test_an_edge_that_is_sent_again_counts_once(tmp_path: Path, by_stamp: bool) -> None:
    """As in a replay; another measurement of the same pair, or another edge of the same number, is not the same."""
    first, last = (Keyframe(None if by_stamp else index, (index + 1) * 10**9) for index in (0, 2))
    once = edge(0, first, last)
    again, other = replace(once, sequence=7), replace(once, source_from_target=np.array([0, 0, 1.0, 0]))
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(EDGE_TOPIC, RELATIVE_ROTATION)
        bag.add_topic(ODOM_TOPIC, ODOMETRY)
        for index in range(3):
            stamp = (index + 1) * 10**9
            bag.write(ODOM_TOPIC, stamp, odometry_message(stamp, np.zeros(3), np.array([0, 0, 0, 1.0]), "odom"))
        for message in (once, other, again, replace(once, source=last, target=first)):
            bag.write(EDGE_TOPIC, 4 * 10**9, edge_message(message))
    read = read_graph_bag(tmp_path / "bag")
    assert int((read.graph.kind == 1).sum()) == 3
    assert read.skipped == {"edges that are sent again": 1}


@pytest.mark.parametrize("first_has_stamps", [True, False])
def test_an_edge_that_is_sent_again_with_its_keyframes_stamps_is_the_same(
    tmp_path: Path, first_has_stamps: bool
) -> None:
    """As in a replay: ids say which keyframes are meant. Whichever edge states their stamps, the first one counts."""
    bare, stamped = ([Keyframe(number, number * has_stamps) for number in (3, 9)] for has_stamps in (0, 1))
    first, again = (stamped, bare) if first_has_stamps else (bare, stamped)
    read = read_graph_bag(bag_of_edges(tmp_path / "bag", [edge(5, *first), replace(edge(5, *again), precision=0.25)]))
    assert (read.graph.num_edges, read.skipped) == (1, {"edges that are sent again": 1})
    assert read.stamps_ns is not None and read.stamps_ns.tolist() == [3, 9]
    assert read.graph.precision.tolist() != [0.25]


def test_translations_that_are_none_are_not_known(tmp_path: Path) -> None:
    """What is written can be read."""
    far, lost = (
        replace(edge(0, Keyframe(1, 0), Keyframe(2, 0)), translation=np.array([x, 0, 0])) for x in (2e9, np.inf)
    )
    near = replace(edge(1, Keyframe(2, 0), Keyframe(3, 0)), translation=np.array([1.0, 0, 0]))
    for number, unknown in enumerate((far, lost)):
        read = read_graph_bag(bag_of_edges(tmp_path / f"bag{number}", [unknown, near]))
        np.testing.assert_array_equal(read.edge_translation, [[np.nan] * 3, [1, 0, 0]])
        for suffix in (".npz", ".g2o"):
            write_graph(tmp_path / f"graph{suffix}", read)
            np.testing.assert_array_equal(
                read_graph(tmp_path / f"graph{suffix}").edge_translation, read.edge_translation
            )


@pytest.mark.parametrize("climb", [0.0, 0.5])
@pytest.mark.parametrize("by_stamp", [False, True])
def test_a_lift_leaves_the_plane(tmp_path: Path, by_stamp: bool, climb: float) -> None:
    """Though it turns about the vertical alone: formats in the plane would lose its heights."""
    ends = [Keyframe(None if by_stamp else index, (index + 1) * 10**9) for index in range(3)]
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(EDGE_TOPIC, RELATIVE_ROTATION)
        bag.add_topic(ODOM_TOPIC, ODOMETRY)
        for index in range(3):
            stamp, position = (index + 1) * 10**9, np.array([0.0, 0.0, climb * index])
            bag.write(ODOM_TOPIC, stamp, odometry_message(stamp, position, np.array([0, 0, 0, 1.0]), "odom"))
        for number, (source, target) in enumerate(((0, 1), (1, 2), (0, 2))):
            up = np.array([0, 0, climb * (target - source)])
            seen = replace(edge(number, ends[source], ends[target]), translation=None if by_stamp else up)
            bag.write(EDGE_TOPIC, 4 * 10**9, edge_message(seen))
    read = read_graph_bag(tmp_path / "bag")
    assert read.planar == (climb == 0)
    for suffix in (".g2o", ".toro", ".npz"):
        write_graph(tmp_path / f"graph{suffix}", read)
        again = read_graph(tmp_path / f"graph{suffix}")
        np.testing.assert_allclose(again.edge_translation, read.edge_translation, atol=1e-12)
    arrays = dict(np.load(tmp_path / "graph.npz"))
    np.savez(tmp_path / "graph.npz", **{name: array for name, array in arrays.items() if name != "planar"})
    assert read_graph(tmp_path / "graph.npz").planar == read.planar


def bag_of_a_camera(
    path: Path, frame: str, *, with_transform: bool, in_array: bool, body: str = "base_link"
) -> tuple[Rotation, Path]:
    """Two odometry messages, a quarter of a turn apart, and the closure between them as a camera sees it."""
    turn, camera = Rotation.from_euler("z", 90, degrees=True), Rotation.from_euler("zx", [90, 90], degrees=True)
    seen = replace(
        edge(0, Keyframe(None, 10**9), Keyframe(None, 2 * 10**9)),
        source_from_target=(camera.inv() * turn * camera).as_quat(),
        translation=camera.inv().apply([1.0, 0.0, 0.0]),
        frame_id="" if in_array else frame,
    )
    types = typestore().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), frame)
    array = types[RELATIVE_ROTATION_ARRAY](header, [edge_message(seen)])
    at = types["geometry_msgs/msg/Transform"](
        types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0),
        types["geometry_msgs/msg/Quaternion"](*camera.as_quat().tolist()),
    )
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "base_link")
    transforms = types[TRANSFORMS]([types["geometry_msgs/msg/TransformStamped"](header, "camera", at)])
    with BagWriter(path) as bag:
        bag.add_topic(ODOM_TOPIC, ODOMETRY)
        bag.add_topic("/tf_static", TRANSFORMS)
        topic = EDGE_ARRAY_TOPIC if in_array else EDGE_TOPIC
        bag.add_topic(topic, RELATIVE_ROTATION_ARRAY if in_array else RELATIVE_ROTATION)
        for index, turned in enumerate((Rotation.identity(), turn)):
            stamp = (index + 1) * 10**9
            odometry = odometry_message(stamp, np.array([index, 0.0, 0.0]), turned.as_quat(), "odom")
            odometry.child_frame_id = body
            bag.write(ODOM_TOPIC, stamp, odometry)
        bag.write(topic, 3 * 10**9, array if in_array else edge_message(seen))
        if with_transform:
            bag.write("/tf_static", 4 * 10**9, transforms)
    return turn, path


@pytest.mark.parametrize("in_array", [False, True])
def test_edges_of_a_camera_become_the_bodys(tmp_path: Path, in_array: bool) -> None:
    turn, bag = bag_of_a_camera(tmp_path / "bag", "camera", with_transform=True, in_array=in_array)
    graph_file = read_graph_bag(bag)
    assert graph_file.graph.kind.tolist() == [0, 1] and graph_file.warnings == ()
    for measured in Rotation.from_quat(graph_file.graph.target_from_source.numpy()):
        assert (measured * turn).magnitude() < 1e-12
    np.testing.assert_allclose(graph_file.edge_translation, [[1, 0, 0]] * 2, atol=1e-12)


@pytest.mark.parametrize(("frame", "is_told"), [("camera", True), ("base_link", False), ("", False)])
def test_edges_that_nothing_places_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], frame: str, is_told: bool
) -> None:
    _, bag = bag_of_a_camera(tmp_path / "bag", frame, with_transform=False, in_array=False)
    assert main(["convert", str(bag), str(tmp_path / "graph.g2o")]) == 0
    warning = f"rotavg: warning: {bag}: edges are in frame camera, but odometry tells of base_link, and the bag has no "
    assert [line.startswith(warning) for line in capsys.readouterr().err.splitlines()] == [True] * is_told


def test_odometry_that_does_not_name_the_body_is_told_of(tmp_path: Path) -> None:
    _, bag = bag_of_a_camera(tmp_path / "bag", "camera", with_transform=True, in_array=False, body="")
    (told,) = read_graph_bag(bag).warnings
    assert told.startswith("edges are in frame camera, but no odometry names the frame of the body")
