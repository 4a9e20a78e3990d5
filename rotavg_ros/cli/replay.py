"""What ``rotavg replay`` does: it runs the node's estimator on a bag and writes the results."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from rotavg_ros.bags.reader import BagReader
from rotavg_ros.cli.main import EXIT_INTERRUPTED, print_warning
from rotavg_ros.cli.progress import seconds_bar, working
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.replay.options import read_parameter_file, read_settings
from rotavg_ros.replay.plan import Plan, Wishes, make_plan
from rotavg_ros.replay.run import Window
from rotavg_ros.wording import counted, unless_nearly_all

# Number of ticks and duration from which a hint on how to make it faster is shown.
_MANY_TICKS, _LONG_SECONDS = 500, 60.0


class ReplayUsageError(UserError):
    """Options that do not fit together, or a bag without anything to replay."""


def run(arguments: argparse.Namespace) -> int:
    """Replay and write."""
    values, notes = read_parameter_file(arguments.params) if arguments.params else ({}, [])
    values |= read_settings(arguments.p)
    wishes = Wishes(arguments.odometry, arguments.edges, arguments.reference, arguments.robots)
    with BagReader(arguments.bag, salvage=True) as bag:
        plan = make_plan(bag, values, wishes)
        if plan.unused:
            notes.append(f"a replay has no use for {', '.join(plan.unused)}, which only a running node has")
        for note in notes:
            print_warning(note)
        print(_described(plan))
        if arguments.list:
            if bag.damage is not None:
                print_warning(bag.damage)
            return 0
        if arguments.output is None:
            raise ReplayUsageError("give a folder for the answer (--output DIR), or --list to see the topics")
        if not plan.has_input:
            raise ReplayUsageError(
                f"{bag.path}: no topic is odometry or relative rotations, so there is nothing to replay; its topics: "
                + ", ".join(f"{use.topic} ({use.type_name})" for use in plan.topics)
            )
        _check_inputs(bag.path, plan, arguments.output)
        print(f"  {plan.pace().told()}", flush=True)
        window = Window(arguments.start, arguments.duration, arguments.rate)
        summary = _replay(bag, plan, window, arguments)
    print(_told(summary, arguments.output))
    for warning in summary["warnings"]:
        print_warning(f"{arguments.bag}: {warning}")
    if summary["damage"] is not None:
        print_warning(f"{summary['damage']}; what could be made of it is in {arguments.output}")
    return EXIT_INTERRUPTED if _is_cut_short(summary) else 0


def _check_inputs(bag: Path, plan: Plan, output: Path) -> None:
    """Refuse an output folder whose files would replace the inputs."""
    files = [reference for reference in plan.references.values() if isinstance(reference, Path)]
    with asking_about(output, ReplayUsageError):
        place = output.resolve()
    if place == bag.resolve() or any(path.resolve().parent == place for path in (bag, *files)):
        raise ReplayUsageError(f"{output}: has the bag or a reference in it; choose another --output")


def _replay(bag: BagReader, plan: Plan, window: Window, arguments: argparse.Namespace) -> dict[str, Any]:
    # The solver and the plots take seconds to import, so they are imported only when needed.
    from rotavg_ros.replay.assemble import assemble, check_references
    from rotavg_ros.replay.outputs import RECORDING, output_folder, write_summary, write_tables
    from rotavg_ros.replay.run import Onlooker, replay
    from rotavg_ros.reports import write_report

    seconds = min(bag.duration_s - window.start_s, window.duration_s or bag.duration_s)
    period_ns = round(1e9 * seconds / arguments.answers) if arguments.answers else 0
    with output_folder(arguments.output, overwrite=arguments.overwrite) as (folder, replaces):
        with _asked_to_stop(not replaces) as stop, seconds_bar("replaying", seconds) as progress:
            check_references(bag, plan, window)
            outcome = replay(bag, plan, window, folder / RECORDING, period_ns, Onlooker(progress, stop))
        with working("writing the report"):
            record = assemble(bag, plan, outcome)
            write_tables(folder, record)
            if not arguments.no_report:
                write_report(record, folder)
            return write_summary(folder, record, bag.path, outcome)


@contextmanager
def _asked_to_stop(may_end_early: bool) -> Iterator[Callable[[], bool]]:
    """The first Ctrl-C only requests the end, so that what is done can be written; the second one ends at once.

    Args:
        may_end_early: if False, the first one ends at once, since a partial answer must not replace a whole one.
    """
    if not may_end_early:
        yield lambda: False
        return
    times = 0

    def ask(_number: int, _frame: FrameType | None) -> None:
        nonlocal times
        times += 1
        if times > 1:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: times > 0
    finally:
        signal.signal(signal.SIGINT, before)
    if times > 1:  # raised again in case Python swallowed it, as in the callback of a weak reference
        raise KeyboardInterrupt


def _described(plan: Plan) -> str:
    """A table of the topics."""
    rows = [(use.topic, use.type_name, str(use.messages), use.used_as or f"— ({use.why_not})") for use in plan.topics]
    rows += [
        (str(path), "file", "", f"reference for {robot}")
        for robot, path in plan.references.items()
        if isinstance(path, Path)
    ]
    widths = [max((len(row[column]) for row in rows), default=0) for column in range(3)]
    return "\n".join(
        f"  {topic:<{widths[0]}}  {kind:<{widths[1]}}  {count:>{widths[2]}}  {use}" for topic, kind, count, use in rows
    )


def _is_cut_short(summary: dict[str, Any]) -> bool:
    """Whether the user stopped it before its end."""
    return bool(summary["interrupted"]) and summary["damage"] is None


def _told(summary: dict[str, Any], output: Path) -> str:
    lines = []
    if _is_cut_short(summary):
        lines.append(f"interrupted after {summary['duration_s']:.1f} s of the bag; what is done is written")
    if not summary["loop_closures"]:
        which = "no loop closure of this bag could be used" if summary["waiting"] else "no loop closures in this bag"
        lines.append(f"{which}: orientations are the odometry's, and nothing could be corrected")
    refused = ", ".join(f"{count} × {reason}" for reason, count in summary["rejected"].items())
    if refused:
        lines.append(f"refused: {refused}")
    if summary["failed_ticks"]:
        lines.append(f"{summary['failed_ticks']} solves on the way failed")
    if summary["time_jumps"]:
        lines.append(f"time went back {summary['time_jumps']} ×; see the parameter on_time_jump")
    if summary["ticks"] > _MANY_TICKS and summary["wall_seconds"] > _LONG_SECONDS:
        lines.append(f"most of the time went into {summary['ticks']} solves; -p solve_period_s:=5.0 makes fewer")
    for robot, said in summary["robots"].items():
        if "reference" in said:
            lines.append(_compared(robot, said))
    counts = (
        f"{counted(summary['keyframes'], 'keyframe')}, {counted(summary['loop_closures'], 'loop closure')}, "
        f"{counted(summary['outliers'], 'outlier')}"
    )
    components = "" if summary["components"] == 1 else f", {summary['components']} components"
    times = f"{summary['duration_s']:.0f} s of the bag in {summary['wall_seconds']:.1f} s"
    lines.append(f"{counts}{components}; {times} → {output}")
    return "\n".join(lines)


def _compared(robot: str, said: dict[str, Any]) -> str:
    known, keyframes = said["compared_keyframes"], said["keyframes"]
    if not known:
        return f"{robot} against {said['reference']}: not compared, for it has nothing within 0.15 s of any keyframe"
    where = unless_nearly_all(known, keyframes, "keyframes")
    degrees = said["orientation_error_mean_deg"]
    line = f"{robot} against {said['reference']}{where}: orientation {_arrow(degrees, '°')} in the mean"
    metres = said.get("position_error_rms_m")
    return line if metres is None else f"{line}, position {_arrow(metres, ' m')} RMS"


def _arrow(values: dict[str, float | None], unit: str) -> str:
    """The errors of odometry and of the corrected answer."""
    return " → ".join(
        "?" if values[which] is None else f"{values[which]:.2f}{unit}" for which in ("odometry", "corrected")
    )
