"""The command that reports print is one that makes the same report."""

from __future__ import annotations

import argparse
import shlex
from typing import Any

import pytest

from rotavg_ros.cli.main import parse

PLACES = ("output", "keep", "data")
REPLAY = "replay bag --output out --odometry /a --odometry /b:nav_msgs/msg/Odometry --rate 0.3333333333333333"


def meaning(arguments: argparse.Namespace) -> dict[str, Any]:
    """What arguments say but for places; a tuple that is a default is no other than the list that was given."""
    said = {name: value for name, value in vars(arguments).items() if name not in PLACES}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in said.items()}


@pytest.mark.parametrize(
    ("words", "spelled"),
    [
        ("benchmark", "benchmark"),
        ("benchmark --soak --hours 0.5 --max-k=400", "benchmark --soak --hours 0.5 --max-keyframes 400"),
        ("benchmark --families recipe --contenders gnc neurora --threads 2 --output here", None),
        ("evaluate synthetic --graphs 100 --methods spt+wang oracle --few-graphs 0 --keep there", None),
        ("evaluate robustness --settings planar cameras-5000 --minutes 1.5", None),
        ("evaluate real --methods neurora spt --seed 3 --data /somewhere", None),
        ("evaluate rgbd --sets redwood_fgr --scenes 9 --folds 2", None),
        (
            "evaluate slam --no-hard --hard --shares 0 0.1 0.3 0.5 0.8 --incremental --no-uncertainty --no-peers",
            "evaluate slam --no-peers --incremental --no-uncertainty",
        ),
        ("evaluate slam --no-hard --graphs intel CSAIL --seeds 100 101 --shares 0.25 --incremental CSAIL", None),
        ("solve --poses 'a graph.g2o' b.npz --output out --refine 3", None),
        (REPLAY, None),
    ],
)
def test_spelled_again_it_means_the_same(words: str, spelled: str | None) -> None:
    arguments = parse(shlex.split(words))
    if spelled is not None:
        assert arguments.command_line == f"rotavg {spelled}"
    assert not any(f"--{place}" in arguments.command_line for place in PLACES)
    # What has to be given is given again.
    needed = ["--output", "out"] if arguments.command == "solve" else []
    again = parse([*shlex.split(arguments.command_line)[1:], *needed])
    assert meaning(again) == meaning(arguments)


@pytest.mark.parametrize(
    "words",
    [
        "train clean-net c.yaml --output w",
        "train clean-net --output w c.yaml",
        "train --output w clean-net c.yaml",
        "train --threads 1 clean-net --output w c.yaml",
    ],
)
def test_a_word_that_may_be_left_out_stands_anywhere(words: str) -> None:
    parsed = parse(shlex.split(words))
    assert (parsed.network, parsed.config, str(parsed.output)) == ("clean-net", "c.yaml", "w")
    left_out = parse(shlex.split(words.replace(" c.yaml", "")))
    assert (left_out.network, left_out.config) == ("clean-net", None)


def test_help_of_what_goes_on_unasked(capsys: pytest.CaptureFixture[str]) -> None:
    """`--graphs` limits neither what is played edge by edge nor the check of the uncertainty."""
    with pytest.raises(SystemExit):
        parse(["evaluate", "slam", "--help"])
    told = " ".join(capsys.readouterr().out.split())
    assert "whatever --graphs says; without a name none" in told
    assert "on graphs of its own" in told
