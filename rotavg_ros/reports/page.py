"""The content of the page in its order, as plain data; the template only does the layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.reports.facts import RunFacts
from rotavg_ros.reports.tables import (
    Table,
    closure_table,
    error_table,
    option_table,
    rejection_table,
    stage_table,
    topic_table,
)
from rotavg_ros.reports.time_pictures import MOST_ROBOTS
from rotavg_ros.reports.tracks import tracks_of
from rotavg_ros.view_graph import FALSE_CLOSURE_M
from rotavg_ros.wording import counted, unless_nearly_all

MOST_CLOSURES = 40  # in the table that is not folded; edges.csv has all


@dataclass(frozen=True)
class Tile:
    """An important number, and its meaning."""

    value: str
    label: str


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        anchor: its name within the page.
        text: paragraphs.
        pictures: names of the pictures it shows, if there was something to draw.
    """

    anchor: str
    title: str
    text: Sequence[str] = ()
    pictures: Sequence[str] = ()
    tables: Sequence[Table] = ()


@dataclass(frozen=True)
class Page:
    """Everything on the page except the pictures. Notes are what a reader must know before trusting the rest."""

    name: str
    lead: str
    tiles: Sequence[Tile]
    notes: Sequence[str]
    sections: Sequence[Section]


def page_of(facts: RunFacts) -> Page:
    """The page of a run."""
    record = facts.record
    return Page(
        name=record.name,
        lead=_lead(facts),
        tiles=_tiles(facts),
        notes=_notes(facts),
        sections=[
            _trajectory(facts),
            _orientations(facts),
            _closures(facts),
            _solving(facts),
            _dropped(facts),
            _inputs(facts),
        ],
    )


def _lead(facts: RunFacts) -> str:
    record, closures = facts.record, len(facts.closures)
    keyframes = len(record.answer.stamp_ns)
    if keyframes == 0:
        return "No keyframe came out of this run; the topics below say what was in it."
    found = (
        "no loop closures"
        if closures == 0
        else f"{counted(closures, 'loop closure')}, {facts.num_flagged} of which it holds false"
    )
    began = ""
    if facts.start_ns > 10**18:  # after September 2001: seconds since 1970, not since a simulation's start
        began = f" It began at {datetime.fromtimestamp(facts.start_ns // 10**9, timezone.utc):%Y-%m-%d %H:%M:%S} UTC."
    of_robots = f" of {len(record.robots)} robots" if len(record.robots) > 1 else ""
    return f"{_duration(record.duration_s)}{of_robots}, {counted(keyframes, 'keyframe')}, {found}.{began}"


def _tiles(facts: RunFacts) -> list[Tile]:
    record = facts.record
    tiles = [Tile(f"{len(record.answer.stamp_ns)}", "keyframes")]
    if len(facts.closures):
        tiles.append(Tile(f"{facts.num_flagged} of {len(facts.closures)}", "loop closures held false"))
    compared = [errors for _, errors in facts.compared]
    if not len(facts.closures):
        pass  # nothing was corrected: equal errors before and after would look like a result
    elif compared:
        at = _where_known(facts)
        before, after = (
            np.degrees(_mean([getattr(errors, which).angle for errors in compared]))
            for which in ("odometry", "corrected")
        )
        tiles.append(Tile(f"{before:.2f}° → {after:.2f}°", f"mean orientation error{at}, odometry → corrected"))
        before, after = (
            _mean([getattr(errors, which) for errors in compared])
            for which in ("odometry_distance", "corrected_distance")
        )
        if np.isfinite(before) and np.isfinite(after):
            tiles.append(Tile(f"{before:.2f} m → {after:.2f} m", f"mean position error{at}, odometry → corrected"))
    else:
        turned = [values[np.isfinite(values)] for values in facts.correction]
        if any(map(len, turned)):
            largest = np.degrees(max(values.max() for values in turned if len(values)))
            tiles.append(Tile(f"{largest:.1f}°", "largest turn of the odometry by the answer"))
    if record.ticks:
        milliseconds = [1000 * tick.seconds for tick in record.ticks]
        tiles.append(Tile(f"{np.percentile(milliseconds, 95):.0f} ms", "tick time, 95th percentile"))
    if record.wall_seconds > 0:
        speed = record.duration_s / record.wall_seconds
        shown = f"{speed:.0f}" if speed >= 10 else f"{speed:.1f}"
        tiles.append(Tile(_duration(record.wall_seconds), f"of computing, {shown} × real time"))
    return tiles


def _where_known(facts: RunFacts) -> str:
    """Words on the number of keyframes with a reference; empty if nearly all have one."""
    known = sum(int(np.isfinite(errors.corrected.angle).sum()) for _, errors in facts.compared)
    total = sum(len(robot.stamp_ns) for robot, _ in facts.compared)
    return unless_nearly_all(known, total, "keyframes")


def _notes(facts: RunFacts) -> list[str]:
    record = facts.record
    notes = []
    if record.damage is not None:
        notes.append(f"This is what can be read of the bag, not all of it: {record.damage}.")
    elif record.interrupted:
        notes.append("The replay was interrupted: this is what was done by then, not the whole bag.")
    if len(record.answer.stamp_ns) and len(facts.closures) == 0:
        notes.append(
            "There are no loop closures, so there is nothing to correct with: the orientations are odometry's own."
        )
    if record.answer.num_components > 1:
        notes.append(
            f"The graph falls into {record.answer.num_components} parts that no edge connects; each is right only "
            "within itself."
        )
    warnings = (*record.warnings, *record.answer.warnings)
    notes += [f"{warning[:1].upper()}{warning[1:].removesuffix('.')}." for warning in warnings]
    if facts.num_flagged_odometry:
        count = counted(facts.num_flagged_odometry, "odometry edge")
        notes.append(f"{count} contradict the rest of the graph: a slip, a jump, or a wrong stamp.")
    return notes


def _trajectory(facts: RunFacts) -> Section:
    text = []
    if not tracks_of(facts):
        text.append("There are no positions: no odometry in the bag carries translations, so there is no map to draw.")
    elif all(errors.truth.position is None for _, errors in facts.compared):
        text.append(
            "There is no reference with positions. Odometry and the corrected trajectory start at the same pose."
        )
    else:
        text.append(
            "Odometry and the corrected trajectory are each laid onto the reference as a whole, by one rotation and "
            "one shift, without scaling (as evo_ape --align does; per connected part of the graph)."
        )
        if alone := [track.robot for track in tracks_of(facts) if track.reference is None]:
            text.append(
                f"Without a reference with positions: {', '.join(alone)}, moved as a robot that it is joined with, "
                "if there is one; its odometry starts at its corrected trajectory's first pose."
            )
    return Section("trajectory", "Trajectory", text, ["trajectory", "position_error"])


def _orientations(facts: RunFacts) -> Section:
    compared = list(facts.compared)
    if compared:
        names = ", ".join(robot.reference.name for robot, _ in compared if robot.reference is not None)
        known = sum(int(np.isfinite(errors.corrected.angle).sum()) for _, errors in compared)
        total = sum(len(robot.stamp_ns) for robot, _ in compared)
        text = [
            f"The reference is {names}; it is known at {known} of {total} keyframes.",
            "Errors are angles to the reference after one rotation of the whole trajectory onto it (robust, per "
            "connected part of the graph).",
        ]
        if len(compared) > MOST_ROBOTS:
            text.append(f"The pictures show the first {MOST_ROBOTS} robots with a reference, the table all.")
        tables = [error_table(facts)]
    elif any(robot.reference is not None for robot in facts.record.robots):
        text = ["The reference has no sample within 0.15 s of any keyframe, so errors are not known: check its clock."]
        tables = []
    else:
        text = ["There is no reference, so errors are not known; shown is what the answer changes."]
        tables = []
    return Section("orientations", "Orientations", text, ["orientation", "uncertainty"], tables)


def _closures(facts: RunFacts) -> Section:
    if len(facts.closures) == 0:
        text = ["There are no loop closures in this run."]
        return Section("closures", "Loop closures", text)
    ordered = facts.most_suspicious()
    shown, further = ordered[:MOST_CLOSURES], ordered[MOST_CLOSURES:]
    flagged = [closure for closure in further if closure.outlier]
    more = len(further) - len(flagged)
    rest = f" {counted(more, 'further closure')} with lower scores: edges.csv has all." if more else ""
    places = sum(closure.fails == "place" for closure in ordered)
    of_places = f", {places} of these for joining wrong places though their rotation may be right" if places else ""
    text = [
        f"{facts.num_flagged} of {len(facts.closures)} are held false{of_places}. "
        f"The table lists the most suspicious first.{rest}"
    ]
    tables = [closure_table(shown, facts)]
    if flagged:
        tables.append(closure_table(flagged, facts, f"The other {len(flagged)} that are held false"))
    if long := facts.believed_but_long():
        are = "is" if len(long) == 1 else "are"
        text.append(
            f"{counted(len(long), 'believed closure')} {are} more than {FALSE_CLOSURE_M:g} m off after correction, "
            f"{long[0].off_m:.1f} m at most: nothing else tells enough of these places, or this front end states "
            "directions rather than lengths."
        )
        tables.append(closure_table(long, facts, f"Believed, but more than {FALSE_CLOSURE_M:g} m off: {len(long)}"))
    close = facts.closest_calls(MOST_CLOSURES)
    if close:
        tables.append(closure_table(close, facts, f"The {len(close)} closest calls, scores between 0.1 and 0.9"))
    return Section("closures", "Loop closures", text, ["graph", "matches", "scores", "flips"], tables)


def _solving(facts: RunFacts) -> Section:
    answer, ticks = facts.record.answer, facts.record.ticks
    if not ticks:
        return Section("solving", "Solving", ["Nothing was solved."])
    cold = sum(tick.was_cold for tick in ticks)
    text = [
        f"{counted(len(ticks), 'tick')}, {cold} of them from scratch (cold). "
        f"Method {answer.method}, profile {answer.profile}, on the {answer.device}."
    ]
    return Section("solving", "Solving", text, ["ticks"], [stage_table(facts)] if answer.stage_seconds else [])


def _dropped(facts: RunFacts) -> Section:
    table = rejection_table(facts.record.rejected)
    if not table.rows:
        return Section("dropped", "What was dropped", ["Nothing: every message of the used topics was taken."])
    total = sum(facts.record.rejected.values())
    text = [f"{counted(total, 'message')} changed nothing, for these reasons."]
    return Section("dropped", "What was dropped", text, tables=[table])


def _inputs(facts: RunFacts) -> Section:
    record = facts.record
    ignored = sum(not topic.used_as for topic in record.topics)
    text = [f"{counted(len(record.topics), 'topic')} in the bag, {ignored} ignored."]
    tables = [topic_table(record.topics)] if record.topics else []
    return Section("inputs", "Topics and options", text, tables=[*tables, option_table(record.options)])


def _mean(values: Sequence[NDArray[np.float64]]) -> float:
    """Mean of all known values."""
    every = np.concatenate(values)
    known = every[np.isfinite(every)]
    return float(known.mean()) if len(known) else float("nan")


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"
