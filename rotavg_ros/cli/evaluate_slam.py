"""What ``rotavg evaluate slam`` does."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from rotavg_ros.cli.data_folder import data_folder
from rotavg_ros.cli.progress import progress, working
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.errors import UserError, until_interrupted
from rotavg_ros.evaluation.common.cases import drawings, num_drawings
from rotavg_ros.evaluation.common.contenders import Roster, contenders, warm_up
from rotavg_ros.evaluation.common.scoring import Step, score_all
from rotavg_ros.evaluation.live import incremental
from rotavg_ros.evaluation.names import SLAM_GRAPHS, SLAM_SHARES
from rotavg_ros.evaluation.slam import (
    cases,
    pose_cases,
    pose_contenders,
    pose_report,
    report,
    sensitivity,
    stress,
    stress_report,
    uncertainty,
)
from rotavg_ros.evaluation.slam.contenders import ORACLE, OURS, ROSTER, ROWS
from rotavg_ros.evaluation.slam.same_data import SameData
from rotavg_ros.evaluation.slam.search_or_model import Diagnosis, diagnose
from rotavg_ros.evaluation.slam.stress_calibration import Calibration
from rotavg_ros.solver.methods import SWITCHES, without

_UNCERTAINTY_GRAPHS = ("CSAIL", "intel", "manhattan", "sphere2500")
_UNCERTAINTY_DRAWS = 20
# Beyond those that solvers are tuned on, as in the other two suites.
_RECORDED_SEEDS = (100, 101, 102)
# Peers that the recorded suite's tables leave out unless asked for.
_STRESS_ONLY = ("isam2-cauchy", "isam2-geman-mcclure", "open3d")
# Left out unless --without asks for them.
_ABLATIONS = frozenset(without(name) for name in SWITCHES)


class SlamOptionsError(UserError):
    """An option that the chosen suite does not use."""


def run(arguments: argparse.Namespace) -> Path:
    """Run the suite and write the report; returns the Markdown file."""
    return SUITES[arguments.slam_suite](arguments)


def _run_poses(arguments: argparse.Namespace) -> Path:
    _refuse_graphs(arguments)
    _refuse_what_stress_alone_has(arguments)
    roster = pose_contenders.ROSTER
    names = _methods(arguments, roster, pose_contenders.ROWS)
    chosen = contenders(names, roster, keep=arguments.keep)
    kinds = pose_cases.kinds(lambda: data_folder(arguments, ("slam",)), arguments.kinds or ())
    seeds = arguments.seeds or pose_cases.REPORTING_SEEDS
    with working("warming up"):
        warm_up(contenders(names, roster).values(), roster, pose_cases.tiny_case())

    scores = score_all(drawings(kinds, seeds), chosen, _watch(num_drawings(kinds, seeds) * len(chosen)))
    with working("writing the report"):
        return pose_report.report(arguments.output, scores, arguments.command_line)


def _run_stress(arguments: argparse.Namespace) -> Path:
    _refuse_graphs(arguments)
    kinds = stress.kinds(arguments.kinds or (), translations=arguments.translations)
    seeds = arguments.seeds or stress.REPORTING_SEEDS
    names = _methods(arguments, ROSTER, ROWS)
    chosen = contenders(names, ROSTER, keep=arguments.keep)
    with working("warming up"):
        _warm_up(names, with_translations=arguments.translations)
    calibration, same_data = Calibration(), SameData()
    chosen[OURS] = same_data.watching(calibration.watching(chosen[OURS]))

    scores = score_all(drawings(kinds, seeds), chosen, _watch(num_drawings(kinds, seeds) * len(chosen)))
    diagnoses: list[Diagnosis] = []
    if arguments.search_or_model and not scores.interrupted:
        with until_interrupted():  # what is done by then is written
            cases_again = progress(
                drawings(kinds, seeds), total=num_drawings(kinds, seeds), description="from the truth"
            )
            diagnoses.extend(map(diagnose, cases_again))
    priors: list[list[sensitivity.Answer]] = []
    if arguments.sensitivity and not scores.interrupted:
        with until_interrupted():
            cases_again = progress(drawings(kinds, seeds), total=num_drawings(kinds, seeds), description="other priors")
            priors.extend([*sensitivity.answers(case)] for case in cases_again)
    findings = stress_report.Findings(calibration, same_data, diagnoses, priors)
    with working("writing the report"):
        return stress_report.report(arguments.output, scores, findings, arguments.command_line)


def _run_recorded(arguments: argparse.Namespace) -> Path:
    if arguments.kinds is not None:
        raise SlamOptionsError("--kinds chooses from the suites stress and poses; add --suite stress or --suite poses")
    _refuse_what_stress_alone_has(arguments)
    seeds = arguments.seeds or _RECORDED_SEEDS
    names = _methods(arguments, ROSTER, [name for name in ROWS if name not in _STRESS_ONLY])
    chosen = contenders(names, ROSTER, keep=arguments.keep)
    # Missing files for the last table are noticed before the hours that the others take.
    more = [_uncertainty_file(name) for name in _UNCERTAINTY_GRAPHS] if arguments.uncertainty else []
    data = data_folder(arguments, ("slam", *more))
    with working("warming up"):
        _warm_up(names, with_translations=True)

    kinds = cases.kinds(data, arguments.graphs, arguments.shares, arguments.hard)
    scores = score_all(drawings(kinds, seeds), chosen, _watch(num_drawings(kinds, seeds) * len(chosen)))
    runs: list[incremental.IncrementalRun] = []
    checks: list[uncertainty.UncertaintyCheck] = []
    if not scores.interrupted:
        kinds = cases.kinds(data, arguments.incremental, [0.3], hard=False)
        for case in drawings(kinds, seeds[:1]):
            runs.append(incremental.play(case, watch=_watch_ticks(str(case.key))))
        for name in progress(_UNCERTAINTY_GRAPHS if more else (), description="uncertainty", total=len(more)):
            graph_file = read_graph(data / _uncertainty_file(name))
            checks += uncertainty.check(name, graph_file, _UNCERTAINTY_DRAWS, seeds[0])
    with working("writing the report"):
        return report.report(arguments.output, scores, runs, checks, arguments.command_line)


def _uncertainty_file(name: str) -> str:
    return f"slam/{name}.g2o"


def _refuse_graphs(arguments: argparse.Namespace) -> None:
    if arguments.graphs != SLAM_GRAPHS or arguments.shares != SLAM_SHARES:
        suite = arguments.slam_suite
        raise SlamOptionsError(
            f"--graphs and --shares choose from the recorded suite; with --suite {suite} use --kinds"
        )


def _refuse_what_stress_alone_has(arguments: argparse.Namespace) -> None:
    for name in ("search_or_model", "sensitivity", "translations"):
        if getattr(arguments, name):
            option = name.replace("_", "-")
            raise SlamOptionsError(f"--{option} needs cases of which all is known; add --suite stress")


def _methods(arguments: argparse.Namespace, roster: Roster, default: Iterable[str]) -> list[str]:
    """The methods asked for, or the default ones that can run here; always with ours and the oracle, for ratios."""
    names = arguments.methods or [name for name in default if roster.can_run(name) and name not in _ABLATIONS]
    if arguments.without:
        names = [*names, *(without(name) for name in arguments.without)]
    if not arguments.peers:
        names = [name for name in names if not roster.is_peer(name)]
    return list(dict.fromkeys((OURS, *names, ORACLE)))


def _warm_up(names: Sequence[str], *, with_translations: bool) -> None:
    """Run every contender once, so that one-time costs are not timed."""
    chosen = contenders(names, ROSTER).values()
    warm_up(chosen, ROSTER)
    if with_translations:
        warm_up(chosen, ROSTER, pose_cases.tiny_case())


def _watch(solves: int) -> Callable[[Iterable[Step]], Iterable[Step]]:
    return lambda steps: progress(steps, total=solves, description="solving", unit="solve")


def _watch_ticks(description: str) -> Callable[[Iterable[int]], Iterable[int]]:
    return lambda ticks: progress(ticks, description=description, unit="tick")


SUITES: dict[str, Callable[[argparse.Namespace], Path]] = {
    "recorded": _run_recorded,
    "stress": _run_stress,
    "poses": _run_poses,
}
