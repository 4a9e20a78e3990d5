"""What ``rotavg benchmark`` does: it measures and writes reports."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from rotavg_ros.cli.options.benchmark import SMALL_KEYFRAMES, SOAK_KEYFRAMES, SOAK_SECONDS
from rotavg_ros.cli.progress import progress
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.benchmark import report, schedule
from rotavg_ros.evaluation.benchmark.measure import ENOUGH_S
from rotavg_ros.evaluation.common.tables import Report, Table
from rotavg_ros.evaluation.live import long_run, ticks
from rotavg_ros.online.ticks import WORK_AFTER
from rotavg_ros.results import make_folder
from rotavg_ros.solver import SECONDS_PER_UNIT

# Load average below which hardly anything else was running.
_QUIET_LOAD = 0.5
_QUIET = ": nothing else ran to speak of."
_BUSY = """:
other work ran besides, so wall-clock times say little, CPU times are inflated by shared caches, and several threads
by waiting for each other. Ratios with a peer in the same run are what counts."""
_INTRODUCTION = """\
Medians over the solves of a process, {repeats} or as many as begin within {enough:g} s, after one of a tiny graph;
graph in memory → orientations in memory; {threads} for every solver. CPU seconds are those of all threads. Peak
memory is the whole process's, with interpreter, libraries and the graph; beside it what it was before the first
solve. Errors are against the truth after one rotation of the world. GNC gets the odometry as known inliers and as its
start, and the precisions that the graph states; peers are timed without what it takes to build their graphs.

The load average was {load} before the run{quiet}

`{command}`
"""

_SOAK_INTRODUCTION = """\
The installed node over DDS, in a process of its own. It holds a simulated city with as many loop closures as
keyframes, four keyframes a second go on coming, and odometry arrives at the rate below. Ticks count from when the graph
was solved, but for the longest before; latency is from the odometry's stamp to the corrected orientation.
Milliseconds, as the node reports them; on a machine that does other work besides, they are mostly waiting, and the
CPU time says more. The load average was {load} before the run.

`{command}`
"""

_SMALL_INTRODUCTION = """\
The installed node over DDS on one core and on two of this machine (taskset), in processes of its own: it and the one
that it solves in. It holds a simulated city with as many loop closures as keyframes, four keyframes a second go on
coming, and odometry arrives at 50 Hz. Memory is the peak of each process, with libraries and what both share, and what
both have at the end, in which that counts once; cores busy is of both. The first solve is the longest tick before all
of the graph was solved. Ticks count from then on, milliseconds as the node reports them. A slower clock was not tried.
The load average was {load} before the run, and what sends the odometry runs beside the node.

`{command}`
"""

_TICKS_INTRODUCTION = """\
The estimator in this process, and iSAM2 (GTSAM) after it, on a simulated city of {keyframes} keyframes with as many
loop closures, a tenth of them false; two keyframes a tick go on coming, with two closures. An answer is of all
keyframes: ours orientations and flags, or poses; iSAM2's poses. What goes on after an answer is {work:g} units of work,
about {unit_ms:g} ms each, and one factorisation more. iSAM2 knows the noise's deviations, has Cauchy's loss on
closures and judges none.
Wall-clock milliseconds; loops beside them that keep a core busy each: {busy}. The load average was {load} before the
run.

`{command}`
"""

_HOURS_INTRODUCTION = """\
The estimator in this process: odometry at 50 Hz of a robot that drives a figure of eight of 200 s again and again, a
loop closure a second to a moment some laps ago, 20 % of them false, a tick every ten seconds. Memory is what the
process has grown by since its first, tiny solve; what a tick needs for itself is part of it. Errors are against the
truth. The load average was {load} before the run.

`{command}`
"""


class BenchmarkUsageError(UserError):
    """Options that do not fit together."""


def run(arguments: argparse.Namespace) -> int:
    """Measure and report."""
    _check(arguments)
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    make_folder(arguments.output)
    if arguments.hours is not None:
        print(_long_run(arguments))
    elif arguments.ticks is not None:
        print(_ticks(arguments))
    elif arguments.small:
        print(_small(arguments))
    else:
        print(_soak(arguments) if arguments.soak else _benchmark(arguments))
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuse options of another kind of run, which would otherwise be ignored silently."""
    hours, several = arguments.hours is not None, len(arguments.keyframes or ()) > 1
    is_live = (arguments.soak and not hours) or arguments.small
    of_ticks = arguments.ticks is not None
    for option, is_heard, remedy in (
        ("--hours", arguments.soak, "add --soak"),
        ("--max-keyframes", arguments.soak and hours, "add --soak --hours H"),
        ("--seconds", is_live, "give it with --small, or with --soak and without --hours"),
        ("--keyframes", is_live or of_ticks, "give it with --small or --ticks, or with --soak and without --hours"),
        ("--busy", of_ticks, "add --ticks N"),
    ):
        if getattr(arguments, option[2:].replace("-", "_")) is not None and not is_heard:
            raise BenchmarkUsageError(f"{option} means nothing here; {remedy}")
    if of_ticks and (arguments.soak or arguments.small or several):
        raise BenchmarkUsageError("--ticks is a run of its own, of one size; leave --soak and --small out")
    if arguments.soak and (arguments.small or several):
        raise BenchmarkUsageError("--soak is of one size, on all cores; give --small without it")
    if arguments.min_pairs > arguments.max_pairs:
        raise BenchmarkUsageError(
            f"--min-pairs {arguments.min_pairs} is more than --max-pairs {arguments.max_pairs}; no graph lies between"
        )


def _benchmark(arguments: argparse.Namespace) -> Path:
    load = _load()
    pairs = arguments.min_pairs, arguments.max_pairs
    wishes = schedule.Wishes(
        arguments.families, arguments.minutes, pairs, arguments.repeats, tuple(arguments.contenders)
    )
    results = schedule.run(wishes)
    tables: dict[str, Table] = {}
    results = {family: of_family for family, of_family in results.items() if of_family}
    for family, of_family in results.items():
        table = report.recipe_table(of_family) if family == "recipe" else report.time_table(family, of_family)
        tables[f"benchmark-{family}"] = table
    tables["benchmark-stages"] = report.stage_table(results)
    picture = "benchmark-scaling.png"
    report.draw_scaling(arguments.output / picture, results)
    threads = torch.get_num_threads()
    introduction = _INTRODUCTION.format(
        repeats=arguments.repeats,
        enough=ENOUGH_S,
        threads="one thread" if threads == 1 else f"{threads} threads",
        load=load,
        quiet=_QUIET if float(load.split()[0]) < _QUIET_LOAD else _BUSY,
        command=arguments.command_line,
    )
    introduction += "".join(f"\n- {line}" for line in report.summary(results))
    pictures = {picture: "Time, error and memory over the number of edges"}
    return Report("benchmark", "Speed and memory", introduction, tables, pictures).write(arguments.output)


def _soak(arguments: argparse.Namespace) -> Path:
    from rotavg_ros.ros.harness import soak  # needs ROS 2, which the rest does not

    load = _load()
    (keyframes,) = arguments.keyframes or (SOAK_KEYFRAMES,)
    rows = soak.run(keyframes, arguments.seconds or SOAK_SECONDS)
    introduction = _SOAK_INTRODUCTION.format(load=load, command=arguments.command_line)
    tables = {"benchmark-soak": soak.table(rows)}
    return Report("benchmark-soak", "The node under load", introduction, tables).write(arguments.output)


def _small(arguments: argparse.Namespace) -> Path:
    from rotavg_ros.ros.harness import small_robots  # needs ROS 2, which the rest does not

    load = _load()
    rows = small_robots.run(
        arguments.keyframes or SMALL_KEYFRAMES,
        arguments.seconds or SOAK_SECONDS,
        lambda runs: progress(runs, description="nodes", unit="node"),
    )
    introduction = _SMALL_INTRODUCTION.format(load=load, command=arguments.command_line)
    tables = {"benchmark-small": small_robots.table(rows)}
    return Report("benchmark-small", "The node on a small machine", introduction, tables).write(arguments.output)


def _ticks(arguments: argparse.Namespace) -> Path:
    load = _load()
    (keyframes,) = arguments.keyframes or (SOAK_KEYFRAMES,)
    if arguments.threads is None:
        torch.set_num_threads(1)
    drive = ticks.Drive(keyframes, arguments.ticks, arguments.busy or 0)
    rows = ticks.run(drive, lambda numbers: progress(numbers, description="ticks", unit="tick"))
    introduction = _TICKS_INTRODUCTION.format(
        keyframes=keyframes,
        busy=drive.busy,
        load=load,
        command=arguments.command_line,
        work=WORK_AFTER,
        unit_ms=1e3 * SECONDS_PER_UNIT,
    )
    name = f"benchmark-ticks-{keyframes}" + (f"-busy-{drive.busy}" if drive.busy else "")
    return Report(name, "Ticks beside iSAM2", introduction, {name: ticks.table(rows)}).write(arguments.output)


def _long_run(arguments: argparse.Namespace) -> Path:
    load = _load()
    rows = long_run.run(arguments.hours, arguments.max_keyframes)
    name = "benchmark-hours" if arguments.max_keyframes is None else f"benchmark-hours-{arguments.max_keyframes}"
    introduction = _HOURS_INTRODUCTION.format(load=load, command=arguments.command_line)
    tables = {name: long_run.table("Memory and accuracy", rows)}
    return Report(name, "Hours of driving", introduction, tables).write(arguments.output)


def _load() -> str:
    with Path("/proc/loadavg").open() as file:
        return " ".join(file.read().split()[:3])
