"""What ``rotavg train slam --from`` does: it fine-tunes the SLAM FineNet to the errors of the user's own robot."""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
import yaml

from rotavg_ros.cli.convert import format_of
from rotavg_ros.cli.progress import working
from rotavg_ros.datasets.files.ground_truth import attach_truth
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.results import make_folder
from rotavg_ros.solver.learning.fine_tuning import SlamFineNet
from rotavg_ros.solver.learning.robot_runs import RobotNoise, RobotRun
from rotavg_ros.training.checkpoint import save_text
from rotavg_ros.training.own_robot import (
    LARGEST_CLOSURE_DEG,
    LARGEST_STEP_DEG,
    LEAST_CLOSURES,
    Verdict,
    compare,
    configuration,
    fine_tune,
)
from rotavg_ros.training.run import writing
from rotavg_ros.whole_file import replacing
from rotavg_ros.wording import counted

_TRIED = "tried"
# Keys of the configuration whose values are what the time allows.
_BY_TIME = ("graphs", "validation_graphs", "epochs")


class OwnRobotError(UserError):
    """Runs that say too little about a robot's errors."""


def run(arguments: argparse.Namespace) -> int:
    """Examine the runs, simulate, train, compare; keep the better network."""
    truths = arguments.truth or [None] * len(arguments.runs)
    if len(truths) != len(arguments.runs):
        raise OwnRobotError(f"--truth names {len(truths)} files, --from {len(arguments.runs)}; give one for each")
    for name in ("config", "clean_net", "start"):
        if getattr(arguments, name) is not None:
            raise OwnRobotError(f"slam takes no {name.replace('_', '-')}: it begins with the package's network")
    if arguments.device == "cuda":
        raise OwnRobotError("robots' networks train on the CPU, where their graphs live; leave out --device cuda")
    tried = arguments.output / _TRIED
    # Told before the minutes that solving the runs takes. A network of before would be used, whatever the verdict is.
    for path in (tried, arguments.output / f"{SlamFineNet.NAME}.safetensors"):
        with asking_about(path, OwnRobotError):
            is_taken = path.exists()
        if is_taken:
            raise OwnRobotError(f"{path}: is there from before; remove it or choose another --output")
    runs = [_read(path, truth) for path, truth in zip(arguments.runs, truths, strict=True)]
    noises = [each.noise() for each in runs]
    for path, truth, noise in zip(arguments.runs, truths, noises, strict=True):
        print(f"{path}: {_told(noise)}", flush=True)
        if truth is not None and (noise.odometry_deg > LARGEST_STEP_DEG or noise.closure_deg > LARGEST_CLOSURE_DEG):
            raise OwnRobotError(f"{truth}: the errors above, by this truth, are too large for it to be that of {path}")
    config = configuration(noises)
    make_folder(tried)
    stated = {key: value for key, value in config.to_dict().items() if key not in _BY_TIME}
    with writing(tried):
        save_text(tried / "robots.yaml", yaml.safe_dump(stated, sort_keys=False))
    network = fine_tune(config, tried, arguments.minutes, lambda line: print(line, flush=True))
    with working("comparing on stretches that are held back"):
        verdict = compare(runs, network)
    print(_said(verdict))
    with writing(arguments.output):
        # The verdict comes first: without it no network is to be in use.
        kept = {**asdict(verdict), "kept": verdict.is_better}
        save_text(arguments.output / "verdict.json", json.dumps(kept) + "\n")
        for suffix in (".json", ".safetensors") if verdict.is_better else ():
            with replacing(arguments.output / f"{SlamFineNet.NAME}{suffix}") as temporary:
                shutil.copyfile(tried / f"{SlamFineNet.NAME}{suffix}", temporary)
    if verdict.is_better:
        print(f"{arguments.output / SlamFineNet.NAME}.safetensors: use it by `--weights {arguments.output}`")
    else:
        print(f"the package's network stays; what was tried lies in {tried}")
    return 0


def _read(path: Path, truth: Path | None) -> RobotRun:
    with working(f"solving {path}"):
        graph_file = format_of(path).read_graph(path)
        if truth is not None:
            graph_file = attach_truth(graph_file, truth)
        closures = int((~graph_file.graph.is_odometry).sum())
        if closures < LEAST_CLOSURES or closures == graph_file.graph.num_edges:
            has = counted(closures, "closure")
            raise OwnRobotError(f"{path}: has {has}; need odometry and {LEAST_CLOSURES} closures at least")
        known = graph_file.body_from_world_gt if truth is not None else None
        if known is not None and not np.isfinite(known).all():
            raise OwnRobotError(f"{truth}: does not tell all orientations of {path}; leave it out")
        return RobotRun.of(graph_file.graph, None if known is None else torch.from_numpy(known))


def _told(noise: RobotNoise) -> str:
    parts = [
        f"odometry {noise.odometry_deg:.3g}° a step",
        f"level spread {noise.step_spread:.2f}",
        f"closures {noise.closure_deg:.3g}°",
        f"level spread {noise.closure_spread:.2f}",
        f"{100 * noise.false_share:.0f} % false, {100 * noise.grouped_share:.0f} % of these in groups",
    ]
    if noise.per_turn > 0:
        parts.append(f"{100 * noise.per_turn:.1f} % of the angle in turns")
    if noise.common_share > 0:
        parts.append(f"closures of a run share {100 * noise.common_share:.0f} % of their variance")
    return ("planar; " if noise.planar else "") + ", ".join(parts)


def _said(verdict: Verdict) -> str:
    if verdict.stretches < 2:
        return "too few closures to hold stretches of them back: nothing can be said"
    return (
        f"{verdict.stretches} stretches held back: {verdict.gain:+.3f} ± {verdict.standard_error:.3f} nats a closure "
        f"beside the package's network, which gains {verdict.without:+.3f} over none"
    )
