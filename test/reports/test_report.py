from __future__ import annotations

import base64
import itertools
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from PIL import Image
from scipy.spatial.transform import Rotation

from rotavg_ros.online import Answer, RejectReason
from rotavg_ros.replay.record import RunRecord, TopicUse
from rotavg_ros.reports import ReportError, report, write_report
from rotavg_ros.reports.facts import RunFacts
from rotavg_ros.reports.map_pictures import trajectory
from rotavg_ros.reports.page import page_of
from rotavg_ros.reports.report import PICTURES
from rotavg_ros.reports.tables import WHY_REFUSED
from rotavg_ros.reports.theme import DARK, LIGHT, Theme, plain
from rotavg_ros.reports.time_pictures import flips, orientation, position_error, ticks, uncertainty
from rotavg_ros.reports.tracks import best_position, tracks_of
from rotavg_ros.view_graph import EdgeKind

from .records import record_of, simulated_run, two_robots, without_closures, without_positions, without_reference

SECTIONS = {"trajectory", "orientations", "closures", "solving", "dropped", "inputs"}


class Page(HTMLParser):
    """What a reader of the page gets: its text, its elements, what it refers to."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.images: dict[str, str] = {}
        self.text = ""
        self._figure = ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        attributes = {name: value or "" for name, value in attrs}
        self.references += [attributes[name] for name in ("src", "srcset", "href", "action") if name in attributes]
        if "id" in attributes:
            self.ids.append(attributes["id"])
        if tag == "figure":
            self._figure = attributes["id"].removeprefix("picture-")
        if tag == "img":
            self.images[self._figure] = attributes["src"]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def record() -> RunRecord:
    return record_of(simulated_run(400, dimensions=3))


@pytest.fixture(scope="module")
def folder(record: RunRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    assert write_report(record, folder) == folder / "report.html"
    return folder


def test_the_page_needs_nothing_else(folder: Path) -> None:
    page = Page(folder / "report.html")
    assert page.references
    assert all(reference.startswith(("data:", "#")) for reference in page.references)
    assert {reference[1:] for reference in page.references if reference.startswith("#")} <= set(page.ids)
    source = (folder / "report.html").read_text(encoding="utf-8")
    for outside in ("http:", "https:", "//", "@import", "url("):
        assert outside not in source.replace("data:image/png;base64,", "").split("<style>")[1].split("</style>")[0]
    assert "<script" not in source


def test_every_section_and_picture_is_there(folder: Path) -> None:
    page = Page(folder / "report.html")
    assert set(page.ids) == SECTIONS | {f"picture-{picture.name}" for picture in PICTURES}
    assert len(page.ids) == len(set(page.ids))
    names = {picture.name for picture in PICTURES}
    assert set(page.images) == names == {path.stem for path in folder.glob("*.png")}
    for name, uri in page.images.items():
        content = base64.b64decode(uri.removeprefix("data:image/png;base64,"))
        assert content == (folder / f"{name}.png").read_bytes()
    assert {path.suffix for path in folder.iterdir()} == {".html", ".png"}


def test_pictures_hold_their_curves(folder: Path) -> None:
    for name, colours in (
        ("trajectory", (LIGHT.odometry, LIGHT.corrected, LIGHT.reference)),
        ("orientation", (LIGHT.odometry, LIGHT.corrected)),
        ("scores", (LIGHT.kept, LIGHT.flagged)),
    ):
        pixels = np.asarray(Image.open(folder / f"{name}.png").convert("RGB")).reshape(-1, 3).astype(int)
        for colour in colours:
            wanted = np.array([int(colour[start : start + 2], 16) for start in (1, 3, 5)])
            assert (np.abs(pixels - wanted).max(axis=1) <= 3).sum() > 100, (name, colour)


def test_numbers_of_the_page(record: RunRecord, folder: Path) -> None:
    page = Page(folder / "report.html")
    answer = record.answer
    closures = answer.kind == EdgeKind.LOOP_CLOSURE
    assert f"{answer.outlier[closures].sum()} of {closures.sum()}" in page.text
    worst = np.flatnonzero(closures)[np.argmax(answer.outlier_score[closures])]
    stamp = int(answer.stamp_ns[answer.source[worst]])
    assert f"{stamp // 10**9}.{stamp % 10**9:09d}" in page.text
    assert "the edge's stamp lies outside the odometry" in page.text
    assert "nan_rotation" not in page.text  # counted zero times


@pytest.fixture
def few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes most of the time, and some tests are about the text."""
    few = [picture for picture in PICTURES if picture.name in ("trajectory", "position_error", "matches")]
    monkeypatch.setattr(report, "PICTURES", few)


@pytest.mark.usefixtures("few_pictures")
def test_what_a_bag_says_is_shown_and_not_obeyed(record: RunRecord, tmp_path: Path) -> None:
    evil = "_$\\frac$</td><script>alert(1)</script><img src=x onerror=alert(1)>\"'&amp;{{ 7*7 }}\ud800"
    topics = (TopicUse(evil, evil, 1, "", evil),)
    pair = two_robots(record)
    answer = replace(pair.answer, robots=(evil, "beta"))
    robots = (replace(pair.robots[0], robot=evil), pair.robots[1])
    options: dict[str, object] = {evil: evil}
    strange = replace(record, name=evil, topics=topics, answer=answer, robots=robots, options=options)
    page = Page(write_report(strange, tmp_path))
    assert "script" not in page.tags
    assert page.tags.count("img") == len(page.images)
    assert page.text.count(evil.replace("\ud800", "?")) >= 6


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("ロボット 1", "???? 1"),
        ("Робот", "Робот"),
        ("warehouse_floor_3_robot_11", "warehouse_…_robot_11"),
        ("warehouse_floor_3_robot_12", "warehouse_…_robot_12"),
        ("exactly_twenty_chars", "exactly_twenty_chars"),
        ("$x$", r"\$x\$"),
    ],
)
def test_labels_of_robots_are_readable_and_differ(name: str, label: str) -> None:
    assert plain(name) == label
    figure = LIGHT.figure(2, 2)
    figure.text(0, 0, plain(name))
    figure.canvas.draw()  # warnings are errors: no letter is missing


def test_a_page_says_what_is_missing(record: RunRecord, tmp_path: Path) -> None:
    bare = without_positions(without_reference(without_closures(record)))
    page = Page(write_report(replace(bare, ticks=(), topics=(), rejected={}, interrupted=True), tmp_path))
    for sentence in (
        "There are no positions",
        "There is no reference",
        "There are no loop closures",
        "Nothing was solved",
        "every message of the used topics was taken",
        "interrupted",
    ):
        assert sentence in page.text
    assert set(page.images) == {"orientation", "uncertainty"}


@pytest.mark.usefixtures("few_pictures")
def test_warnings_stand_above_all_results(record: RunRecord, tmp_path: Path) -> None:
    warned = replace(
        record, answer=replace(record.answer, warnings=("closures <may> be inverted: invert them", "A slip. Or not."))
    )
    text = Page(write_report(warned, tmp_path)).text
    assert "Closures <may> be inverted: invert them." in text
    assert "A slip. Or not." in text and ".." not in text
    assert text.index("Closures <may> be") < text.index("Odometry and the corrected trajectory")


@pytest.mark.usefixtures("few_pictures")
def test_what_was_not_used_of_the_bag_is_told(record: RunRecord, tmp_path: Path) -> None:
    partly = replace(record, warnings=("3 edges were not used",), damage="the bag is damaged", interrupted=True)
    text = Page(write_report(partly, tmp_path)).text
    assert "3 edges were not used." in text
    assert "This is what can be read of the bag, not all of it: the bag is damaged." in text
    assert "interrupted" not in text


@pytest.mark.usefixtures("few_pictures")
def test_a_reference_at_another_time(record: RunRecord, tmp_path: Path) -> None:
    (robot,) = record.robots
    assert robot.reference is not None
    late = replace(robot.reference, stamp_ns=robot.reference.stamp_ns + 10**15)
    page = Page(write_report(replace(record, robots=(replace(robot, reference=late),)), tmp_path))
    assert "check its clock" in page.text
    assert "position_error" not in page.images


def test_a_robot_without_a_reference_lies_beside_the_others(record: RunRecord) -> None:
    robots = two_robots(record)
    alpha, beta = robots.robots
    both = tracks_of(RunFacts(robots))
    facts = RunFacts(replace(robots, robots=(alpha, replace(beta, reference=None))))
    one = tracks_of(facts)
    np.testing.assert_array_equal(one[0].corrected, both[0].corrected)
    np.testing.assert_allclose(one[1].corrected, both[1].corrected, atol=0.5)  # the reference's world is metres away
    assert one[1].odometry is not None and one[1].reference is None
    np.testing.assert_allclose(one[1].odometry[0], one[1].corrected[0], atol=1e-9)
    assert "reference with positions: beta" in " ".join(page_of(facts).sections[0].text)
    apart = replace(robots.answer, component=robots.answer.keyframe_robot.astype(np.int64))
    (_, unjoined) = tracks_of(replace(facts, record=replace(facts.record, answer=apart)))
    np.testing.assert_array_equal(unjoined.corrected, best_position(beta))


def test_robots_of_one_colour_have_other_dashes(record: RunRecord) -> None:
    many = replace(record, robots=tuple(replace(record.robots[0], robot=f"robot_{number}") for number in range(14)))
    for draw in (trajectory, uncertainty):
        figure = draw(RunFacts(many), LIGHT)
        assert figure is not None
        named = [line for line in figure.axes[0].lines if str(line.get_label()).startswith("robot_")]
        assert len({(str(line.get_color()), str(line._dash_pattern)) for line in named}) == len(named) == 14


def test_robots_without_a_panel_of_their_own_are_told(record: RunRecord) -> None:
    many = replace(record, robots=tuple(replace(record.robots[0], robot=f"robot_{number}") for number in range(7)))
    section = page_of(RunFacts(many)).sections[1]
    assert "the first 6 robots" in " ".join(section.text)
    assert {row.cells[0] for row in section.tables[0].rows} == {f"robot_{number}" for number in range(7)}
    assert "first 6" not in " ".join(page_of(RunFacts(record)).sections[1].text)


def test_an_empty_run(record: RunRecord, tmp_path: Path) -> None:
    empty = replace(record, answer=record.answer.without_content(), robots=(), ticks=(), duration_s=0.0)
    page = Page(write_report(empty, tmp_path))
    assert "No keyframe" in page.text
    assert set(page.ids) == SECTIONS
    assert page.images == {}


def overlapping_texts(figure: Figure, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Pairs of texts that cover each other in the picture."""
    boxes: list[tuple[str, Bbox]] = []
    draw = Text.draw

    def note(text: Text, renderer: RendererBase) -> None:
        draw(text, renderer)
        if text.get_visible() and text.get_text().strip():
            boxes.append((text.get_text(), text.get_window_extent(renderer).padded(-1)))

    with monkeypatch.context() as patch:
        patch.setattr(Text, "draw", note)
        figure.draw_without_rendering()
    assert len(boxes) > 3
    return [(a, b) for (a, box), (b, other) in itertools.combinations(boxes, 2) if box.overlaps(other)]


@pytest.mark.parametrize(
    "make",
    [
        lambda: record_of(simulated_run(10)),
        lambda: record_of(simulated_run(10_000, dimensions=3)),
        lambda: two_robots(record_of(simulated_run(300))),
        lambda: without_reference(record_of(simulated_run(300))),
    ],
    ids=["ten keyframes", "ten thousand", "two robots", "no reference"],
)
def test_no_label_covers_another(make: Callable[[], RunRecord], monkeypatch: pytest.MonkeyPatch) -> None:
    facts = RunFacts(make())
    for picture in PICTURES:
        figure = picture.draw(facts, DARK)
        if figure is not None:
            assert overlapping_texts(figure, monkeypatch) == [], picture.name


def test_every_refusal_is_explained() -> None:
    assert set(WHY_REFUSED) == set(RejectReason)


def test_a_folder_that_cannot_be_written(record: RunRecord, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ReportError, match="cannot be written"):
        write_report(record, tmp_path / "file")


@pytest.mark.parametrize("later_s", [-1e9, 0.0, 2.0, 1e9])
def test_ticks_are_shown_since_the_start_whatever_the_recorders_clock(record: RunRecord, later_s: float) -> None:
    moved = [replace(tick, stamp_ns=tick.stamp_ns + round(1e9 * later_s)) for tick in record.ticks]
    facts = RunFacts(replace(record, ticks=tuple(moved)))
    usual = RunFacts(record).tick_time
    begin = later_s if abs(later_s) < record.duration_s else -float(usual[0] * facts.clock.seconds)
    np.testing.assert_allclose(facts.tick_time, usual + begin / facts.clock.seconds, atol=1e-9)


def test_a_tick_that_compiles_for_a_minute_hides_no_other(record: RunRecord) -> None:
    slow = [replace(record.ticks[0], seconds=60.0), *record.ticks[1:]]
    figure = ticks(RunFacts(replace(record, ticks=tuple(slow))), LIGHT)
    assert figure is not None
    figure.canvas.draw()
    upper = figure.axes[0]
    shown = upper.transAxes.inverted().transform(
        upper.transData.transform([[0.0, 1000 * seconds] for seconds in (min(t.seconds for t in slow[1:]), 60.0)])
    )
    assert 0 < shown[0, 1] < shown[1, 1] < 1
    others = upper.transData.transform([[0.0, 1000 * tick.seconds] for tick in slow[1:]])[:, 1]
    assert np.ptp(others) > 5  # pixels


@pytest.mark.parametrize("draw", [orientation, uncertainty])
def test_no_robots_curve_leaves_its_panel(draw: Callable[[RunFacts, Theme], Figure | None], record: RunRecord) -> None:
    robots = two_robots(without_reference(record))
    first, second = robots.robots
    drifting = Rotation.from_rotvec(np.outer(np.arange(len(second.nodes)), [0.0, 0.0, 0.01]))
    second = replace(
        second,
        odometry_world_from_body=(drifting * Rotation.from_quat(second.world_from_body)).as_quat(),
        uncertainty=10 * second.uncertainty,
    )
    figure = draw(RunFacts(replace(robots, robots=(first, second))), LIGHT)
    assert figure is not None
    figure.canvas.draw()
    (axes,) = figure.axes
    bottom, top = axes.get_ylim()
    assert len(axes.lines) == 2 and bottom == 0
    assert all(np.asarray(line.get_ydata()).max() <= top for line in axes.lines)


def labels_of(axes: Axes) -> list[str]:
    """The texts beside the vertical axis, those without text left out."""
    assert axes.figure is not None
    axes.figure.canvas.draw()
    return [text for label in axes.yaxis.get_ticklabels(which="both") if (text := label.get_text())]


def test_axes_of_ticks_have_plain_and_whole_numbers(record: RunRecord) -> None:
    quick = [replace(tick, seconds=0.003 + 0.0001 * number) for number, tick in enumerate(record.ticks)]
    figure = ticks(RunFacts(replace(record, ticks=tuple(quick))), LIGHT)
    assert figure is not None
    assert len(labels_of(figure.axes[0])) > 2
    assert all(float(label) > 0 for label in labels_of(figure.axes[0]))
    clean = [replace(tick, outliers=0, flips=0) for tick in record.ticks]
    figure = flips(RunFacts(replace(record, ticks=tuple(clean))), LIGHT)
    assert figure is not None
    for axes in figure.axes:
        assert labels_of(axes) == ["0", "1"]


@pytest.mark.parametrize("draw", [ticks, flips])
def test_a_single_tick_is_seen(draw: Callable[[RunFacts, Theme], Figure | None], record: RunRecord) -> None:
    figure = draw(RunFacts(replace(record, ticks=record.ticks[-1:])), LIGHT)
    assert figure is not None
    curves = [line for axes in figure.axes for line in axes.lines]
    assert curves and all(line.get_marker() not in ("", "None") for line in curves)


def test_a_clock_that_went_back_begins_another_line() -> None:
    record = record_of(simulated_run(300, dimensions=3))
    (robot,) = record.robots
    stamp_ns, time_line = robot.stamp_ns.copy(), np.repeat([0, 1], 150)
    stamp_ns[150:] -= stamp_ns[150] - stamp_ns[0] - 123_456_789
    assert robot.reference is not None
    reference = replace(robot.reference, stamp_ns=stamp_ns, time_line=time_line)
    robot = replace(robot, stamp_ns=stamp_ns, time_line=time_line, reference=reference)
    answer = replace(record.answer, stamp_ns=stamp_ns, time_line=time_line)
    facts = RunFacts(replace(record, answer=answer, robots=(robot,)))
    for draw in (orientation, position_error, uncertainty, trajectory):
        figure = draw(facts, LIGHT)
        assert figure is not None
        over_time = figure.axes[1:] if draw is trajectory else figure.axes
        for line in (line for axes in over_time for line in axes.lines):
            time = np.asarray(line.get_xdata(), dtype=float)
            assert (np.isnan(time).sum(), len(time)) == (1, 301)
            assert not (np.diff(time) < 0).any()


def judged(record: RunRecord, outlier: np.ndarray, rotation_score: np.ndarray) -> RunFacts:
    """The record with verdicts on its closures: outliers that fail by their rotations where those score high."""
    answer = record.answer
    closures = answer.kind == EdgeKind.LOOP_CLOSURE
    score, flags, turned = answer.outlier_score.copy(), answer.outlier.copy(), np.zeros(len(answer.source))
    flags[closures], turned[closures] = outlier, rotation_score
    score[closures] = np.where(outlier, 0.9, 0.1)
    found = replace(standing_still(answer), outlier_score=score, outlier=flags, rotation_score=turned)
    return RunFacts(replace(record, answer=found))


def standing_still(answer: Answer) -> Answer:
    """With positions and translations, of a robot that goes nowhere."""
    nowhere = np.zeros((len(answer.stamp_ns), 3))
    return replace(answer, position=nowhere, translation=np.zeros((len(answer.source), 3)))


def test_the_table_says_what_is_wrong_with_a_closure_and_by_how_much(record: RunRecord) -> None:
    count = int((record.answer.kind == EdgeKind.LOOP_CLOSURE).sum())
    outlier = np.arange(count) < 50
    facts = judged(record, outlier, np.where(np.arange(count) % 2 == 0, 0.8, 0.0))
    closures = facts.most_suspicious()
    assert len(closures) == count and all(each.outlier for each in closures[:50])
    assert {each.fails for each in closures[:50]} == {"rotation", "place"} and closures[-1].fails == ""
    off = [max(each.off_deg / 10, np.nan_to_num(each.off_m) / 2) for each in closures]
    assert off[:50] == sorted(off[:50], reverse=True)
    section = next(each for each in page_of(facts).sections if each.anchor == "closures")
    assert "50 of" in section.text[0] and "25 of these for joining wrong places" in section.text[0]
    others = next(table for table in section.tables if table.folded.startswith("The other"))
    assert others.folded == "The other 10 that are held false" and all(row.flagged for row in others.rows)
    assert any(column.name == "off by, m" for column in section.tables[0].columns)


def test_believed_closures_that_stay_long_are_named(record: RunRecord) -> None:
    answer = standing_still(record.answer)
    closures = np.flatnonzero(answer.kind == EdgeKind.LOOP_CLOSURE)
    believed = closures[~answer.outlier[closures]][:3]
    translation = answer.translation.copy()
    translation[believed] += [7.0, 0.0, 0.0]
    facts = RunFacts(replace(record, answer=replace(answer, translation=translation)))
    assert {each.edge_id for each in facts.believed_but_long()} >= {int(answer.edge_id[edge]) for edge in believed}
    text = " ".join(next(each for each in page_of(facts).sections if each.anchor == "closures").text)
    assert "more than 2 m off after correction" in text
    assert "more than 2 m off" not in " ".join(
        next(each for each in page_of(RunFacts(record)).sections if each.anchor == "closures").text
    )


def test_nothing_to_correct_has_no_tiles_that_look_like_results(record: RunRecord) -> None:
    labels = " ".join(tile.label for tile in page_of(RunFacts(without_closures(record))).tiles)
    assert "error" not in labels and "turn of the odometry" not in labels
    assert "mean orientation error" in " ".join(tile.label for tile in page_of(RunFacts(record)).tiles)
