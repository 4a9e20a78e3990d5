"""Every command in the README and in docs/ is run as it stands, or is listed here with a reason; links lead on."""

from __future__ import annotations

import ast
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from rotavg_ros.bags.run_bag import write_run_bag
from rotavg_ros.cli.main import COMMANDS, main
from rotavg_ros.datasets.files.formats import write_graph
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.ros.node import diagnostics, parameter_server
from rotavg_ros.ros.node.intake import forwarding, wiring
from rotavg_ros.ros.node.output import frame_correction

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Those that a program has written say so in their own way.
WRITTEN = [page for page in PAGES if "results" not in page.parts or page.name == "README.md"]
LINKED = [*PAGES, ROOT / "CONTRIBUTING.md"]
PROGRAMS = ("rotavg", "rotavg_node", "make", "ros2", "pip", "rosdep", "colcon", "python", "python3", "cd", ".", "git")

# What is not run here, by its first words, and why.
NOT_RUN = {
    "make demo": "minutes; test/ros/harness/test_demo.py runs what it calls",
    ". .venv/bin/activate": "a shell's own",
    "git clone": "the network",
    "cd rotavg_ros": "a clone",
    "python3 -m venv venv": "minutes and a gigabyte",
    ". venv/bin/activate": "a shell's own",
    "pip install .": "minutes and a gigabyte",
    ". install/setup.sh": "a shell's own, on a machine with ROS 2 from apt",
    "cd ~/ws": "a workspace with ROS 2 from apt",
    "rosdep install": "ROS 2 from apt",
    "pip install torch": "the network",
    "pip install safetensors": "ROS 2 from apt",
    "colcon build": "ROS 2 from apt; `make setup` builds the same folders",
    "ros2 topic echo": "ros2cli is not on PyPI",
    "ros2 run rotavg_ros": "ros2cli is not on PyPI; test/ros starts the same node with the same parameters",
    "ros2 interface show": "ros2cli is not on PyPI",
    "ros2 launch slam_toolbox": "another package",
    "ros2 bag record": "ros2cli is not on PyPI",
    "rotavg_node": "runs until it is stopped; test/ros starts it",
    "rotavg play run": "ends only when a subscriber has everything; test/ros/harness/test_play.py",
    "rotavg play b25b": "the same",
    "rotavg demo": "starts a node and plays for 12 s; test/ros/harness/test_demo.py",
    "rotavg convert B25b_0.000.g2o": "data that is no part of the repository; test/ros/node/test_node_b25b.py",
    "python examples/three_robots.py": "minutes; `make test-large` runs it",
}
# Where the lines of the diagnostics come from.
WARNING = (diagnostics, forwarding, wiring, frame_correction, parameter_server)
# What makes a command take seconds instead of minutes or hours.
SMALLER = {
    "--laps 4": "--laps 1",
    "--minutes 10": "--minutes 0.02",
    "replay my_bag --output": "replay my_bag --duration 10 --no-report --output",
}


TINY_TRAINING = """\
family: sfm
recipe: mixture
nodes: [10, 20]
graphs: 6
validation_nodes: [20, 20]
validation_graphs: 3
epochs: 1
batch_graphs: 6
"""


class Command(NamedTuple):
    """A command on a page.

    Attributes:
        page, line: where.
        text: without prompt and remark.
        output: the lines below it that it must print, … standing for anything; None where the page shows none.
    """

    page: str
    line: int
    text: str
    output: tuple[str, ...] | None

    def __str__(self) -> str:
        return f"{self.page}:{self.line}: {self.text}"


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def code_lines(page: Path) -> Iterator[tuple[int, str]]:
    """Lines of indented blocks and of fenced blocks without a language, with their numbers; blocks end in ''."""
    fence = None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        if line.startswith("```"):
            fence = None if fence is not None else line[3:].strip()
            yield number, ""
        elif fence == "":
            yield number, line
        elif fence is None:
            yield number, line[4:] if line.startswith("    ") else ""


def commands(page: Path) -> list[Command]:
    found: list[Command] = []
    name, printing = name_of(page), False
    for number, line in code_lines(page):
        prompted = line.startswith("$ ")
        text = re.split(r"\s{2,}|\s#", line.removeprefix("$ ").strip())[0]
        words = text.removeprefix(".venv/bin/").split(maxsplit=1)
        if words and words[0] in PROGRAMS and (prompted or not printing):
            found.append(Command(name, number, text.removeprefix(".venv/bin/"), () if prompted else None))
            printing = prompted
        elif printing and line:
            last = found[-1]
            found[-1] = last._replace(output=(*(last.output or ()), line))
        else:
            printing = printing and bool(line)
    return found


ALL = [command for page in PAGES for command in commands(page)]
SKIPPED = {command: words for command in ALL for words in NOT_RUN if command.text.startswith(words)}


@pytest.fixture(scope="module")
def belongings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a user has: a graph, a bag and, for troubleshooting, what can be wrong with them."""
    folder = tmp_path_factory.mktemp("belongings")
    run = simulate_slam_graph(SlamSimulationConfig(num_keyframes=200), np.random.default_rng(0))
    write_graph(folder / "my.g2o", run.to_graph_file())
    lines = (folder / "my.g2o").read_text().splitlines(keepends=True)
    (folder / "half.g2o").write_text("".join(lines[:268]) + " ".join(lines[268].split()[:4]))
    (folder / "nan.g2o").write_text("".join([*lines[:299], "EDGE_SE2 0 1 nan 0 0.1 1 0 0 1 0 1\n", *lines[300:]]))
    (folder / "foreign.g2o").write_text("".join(lines).replace("EDGE_SE2", "EDGE_FOO"))
    write_run_bag(folder / "my_bag", simulate_slam_graph(RobotRun(laps=2).config(), np.random.default_rng(0)))
    (recording,) = (folder / "my_bag").glob("*.mcap")
    (folder / "half.mcap").write_bytes(recording.read_bytes()[:60_000])
    (folder / "empty.mcap").touch()
    for name in ("killed.db3", "killed.db3-wal"):
        (folder / name).write_text("what a recorder leaves when it is killed")
    (folder / "my-robot.yaml").write_text(TINY_TRAINING)
    return folder


def test_pages_have_commands() -> None:
    assert len(ALL) > 30
    assert {command.page for command in ALL} >= {"README.md", "docs/troubleshooting.md", "docs/from-your-slam.md"}
    assert set(NOT_RUN) == set(SKIPPED.values()), "an exception that no page needs"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands(
    page: Path, belongings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In order and in one folder, for later ones use what earlier ones have written."""
    on_page = [command for command in ALL if command.page == name_of(page)]
    shutil.copytree(belongings, tmp_path / "user")
    monkeypatch.chdir(tmp_path / "user")
    for command in on_page:
        made = Path(command.text.split()[-1])
        if command.output is None and command.text.startswith(("rotavg simulate", "rotavg convert")) and made.exists():
            shutil.move(made, tmp_path)  # the page makes it itself
    for command in on_page:
        if command not in SKIPPED:
            check(command, capsys)
    if page.name == "train-on-your-noise.md":
        (code,) = re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
        exec(code, {})  # noqa: S102 - the page is ours
        assert re.fullmatch(r"tensor\(\d+\) tensor\(\d+\)\n", capsys.readouterr().out)


def check(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    """Run one command in this process; it must succeed, or print what the page shows."""
    text = command.text
    for large, small in SMALLER.items():
        text = text.replace(large, small)
    program, *words = shlex.split(text)
    assert program == "rotavg", f"{command}: run it here or give a reason in NOT_RUN"
    try:
        code = main(words)
    except SystemExit as leaving:  # --help
        code = int(leaving.code or 0)
    printed = capsys.readouterr()
    if command.output is None:
        assert code == 0, f"{command}: {printed.err}"
        return
    shown = [line for line in (printed.out + printed.err).splitlines() if line.strip()]
    assert len(shown) == len(command.output), f"{command}: {shown}"
    for line, expected in zip(shown, command.output, strict=True):
        assert re.fullmatch(re.escape(expected).replace("…", ".*"), line), f"{command}: {line}"


@pytest.mark.parametrize("command", SKIPPED, ids=str)
def test_command_that_is_not_run_can_be_read(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    program, *words = shlex.split(command.text.replace("<", "").replace(">", ""))
    if program == "rotavg":
        module = next(known.module for known in COMMANDS if known.name == words[0])
        monkeypatch.setattr(f"{module}.run", lambda arguments: 0)
        assert main(words) == 0


def links(page: Path) -> list[str]:
    return re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", LINKED, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    for target in links(page):
        path, _, anchor = target.partition("#")
        assert not target.startswith("http")
        found = (page.parent / path) if path else page
        assert found.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", found.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_page_is_linked() -> None:
    """From the README on."""
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        if page not in reached:
            reached.add(page)
            targets = [(page.parent / target.partition("#")[0]).resolve() for target in links(page)]
            waiting += [target for target in targets if target in PAGES]
    assert not [name_of(page) for page in PAGES if page not in reached]


@pytest.mark.parametrize("page", WRITTEN, ids=name_of)
def test_a_page_says_first_whom_it_is_for(page: Path) -> None:
    title, blank, first = page.read_text(encoding="utf-8").splitlines()[:3]
    assert title.startswith("# ") and not blank and first.startswith("For "), first


def test_where_is_what() -> None:
    """Every name in the method's table is defined in the file that is linked beside it."""
    page = ROOT / "docs" / "method.md"
    table = page.read_text(encoding="utf-8").partition("## Where is what")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| .* \| \[[^\]]*\]\((\S+)\) \| (.*) \|$", table, re.MULTILINE)
    assert len(rows) > 30
    for path, names in rows:
        tree = ast.parse((page.parent / path).read_text(encoding="utf-8"))
        defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        assert set(re.findall(r"`(\w+)`", names)) <= defined, f"{path}: {names}"


def test_diagnostics_that_troubleshooting_quotes() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    table = page[page.index("| diagnostics say") : page.index("**Nothing at all arrives.**")]
    sources = [Path(module.__file__).read_text(encoding="utf-8") for module in WARNING]
    source = re.sub(r'"\s+f?"', "", " ".join(" ".join(sources).split()))  # strings over several lines as one
    quotes = re.findall(r"^\| `([^`]+)` \|", table, re.MULTILINE)
    assert len(quotes) >= 5
    for quote in quotes:
        for part in quote.split("…"):
            assert part.strip("() ") in source, quote
