"""What the README says is so: its table, its commands, its example."""

from __future__ import annotations

import importlib
import re
import shlex
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rotavg_ros.bags.graph_from_bag import read_graph_bag
from rotavg_ros.cli.main import COMMANDS, main
from rotavg_ros.datasets.graph_file import read_graph, write_graph
from rotavg_ros.datasets.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.ros.parameters import to_markdown

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"^    (?:\.venv/bin/)?rotavg (.+)$", README, re.MULTILINE)
CONVERT_BACK = re.findall(r"and back: rotavg (.+)$", README, re.MULTILINE)


def words_of(example: str) -> list[str]:
    """The words of a command, without the remark that stands after two spaces or a `#`."""
    command = re.split(r"\s{2,}|\s#", example)[0]
    return shlex.split(command.replace("GRAPH...", "my.g2o").replace("DIR", "answer"))


def examples_of(*commands: str) -> list[list[str]]:
    found = [words_of(example) for example in [*EXAMPLES, *CONVERT_BACK]]
    return [words for words in found if words[0] in commands]


def test_the_parameter_table_is_the_nodes_own() -> None:
    table = re.search(r"^<!-- parameters: .*-->\n(.*?)^<!-- end of parameters -->$", README, re.MULTILINE | re.DOTALL)
    assert table is not None
    assert table[1] == to_markdown(), "paste the output of rotavg_ros.ros.parameters.to_markdown()"


@pytest.mark.parametrize("words", examples_of(*(command.name for command in COMMANDS)), ids=" ".join)
def test_every_command_line_is_understood(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    module = next(command.module for command in COMMANDS if command.name == words[0])
    monkeypatch.setattr(importlib.import_module(module), "run", lambda arguments: 0)
    assert main(words) == 0


def test_examples_name_existing_commands() -> None:
    named = {words_of(example)[0] for example in EXAMPLES} - {"--help"}  # which test_errors.py calls
    assert named <= {command.name for command in COMMANDS}
    assert named >= {"solve", "simulate", "convert", "play", "demo"}


@pytest.fixture
def my_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """my.g2o in a working directory of the test's own."""
    monkeypatch.chdir(tmp_path)
    run = simulate_slam_graph(SlamSimulationConfig(num_keyframes=200), np.random.default_rng(0))
    write_graph("my.g2o", run.to_graph_file())
    return Path("my.g2o")


@pytest.mark.parametrize("words", examples_of("solve"), ids=" ".join)
def test_solve(words: list[str], my_graph: Path) -> None:
    assert main(words) == 0
    assert {path.name for path in Path("answer").iterdir()} == {"orientations.csv", "edges.csv", "summary.json"}


@pytest.mark.parametrize("words", examples_of("simulate"), ids=" ".join)
def test_simulate(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 0
    assert read_graph_bag(words[words.index("--output") + 1]).graph.num_edges > 0


def test_convert_and_back(my_graph: Path) -> None:
    before = read_graph(my_graph)
    there, back = (words for words in examples_of("convert") if "--stamps" not in words)
    assert main(there) == 0
    assert main(back) == 0
    after = read_graph(back[-1])
    np.testing.assert_array_equal(after.graph.source, before.graph.source)
    np.testing.assert_array_equal(after.graph.target, before.graph.target)
    np.testing.assert_allclose(after.graph.target_from_source, before.graph.target_from_source, atol=1e-12)


def test_the_library_example() -> None:
    section = README.partition("## The library")[2]
    example = re.search(r"(?:^(?:    .*)?\n)+", section[section.index("    from") :], re.MULTILINE)
    assert example is not None
    names: dict[str, Any] = {}
    exec(textwrap.dedent(example[0]), names)  # noqa: S102 - the README is ours
    solution = names["solution"]
    assert solution.body_from_world.shape == (4, 4)
    assert solution.outlier_score.shape == (4,)
    np.testing.assert_allclose(solution.body_from_world[0], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(solution.body_from_world[3], [0, 0, 0.296, 0.9552], atol=1e-3)
