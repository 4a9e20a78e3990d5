"""Arrows point inward: what may import what, read from the sources."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "rotavg_ros"
# The parts that others build on, and the parts of this package that they may import themselves.
INWARD = {
    "errors": set(),
    "view_graph": {"errors"},
    "rotations": set(),
    "solver": {"errors", "rotations", "view_graph"},
    "datasets": {"errors", "rotations", "view_graph"},
    "online": {"errors", "rotations", "solver", "view_graph"},
    "inputs": {"online", "view_graph"},
    "settings": {"errors", "inputs", "online", "solver", "view_graph"},
}
# What a robot runs needs no more.
NODE_MAY_USE = {
    "errors",
    "version",
    "view_graph",
    "solve",
    "ViewGraph",
    "solver",
    "online",
    "inputs",
    "settings",
    "ros",
}
# Others' packages that only one part may know.
BORDERS = {"rclpy": "ros", "rosbags": "bags", "mcap": "bags"}


def imported(part: str) -> Iterator[tuple[str, str]]:
    """Modules that a part of the package imports, anywhere in it, and the file that does."""
    files = (PACKAGE / part).rglob("*.py") if (PACKAGE / part).is_dir() else [PACKAGE / f"{part}.py"]
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from ((alias.name, file.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module == PACKAGE.name:
                yield from ((f"{node.module}.{alias.name}", file.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield node.module, file.name


def test_the_node_knows_nothing_of_the_harness() -> None:
    """What a robot runs stands by itself; what demonstrates and measures it may use its parts."""
    for module, file in imported("ros/node"):
        top, *inner = module.split(".")
        if top == PACKAGE.name:
            assert inner[0] in NODE_MAY_USE and module.split(".")[1:3] != ["ros", "harness"], f"{file} imports {module}"
    assert {path.name for path in (PACKAGE / "ros").iterdir() if path.is_dir()} - {"__pycache__"} == {"node", "harness"}


@pytest.mark.parametrize("part", INWARD)
def test_nothing_imports_outward(part: str) -> None:
    for module, file in imported(part):
        top, *inner = module.split(".")
        if top == PACKAGE.name:
            assert inner[0] in {part, *INWARD[part]}, f"{part}/{file} imports {module}"
        else:
            assert top not in BORDERS and not top.endswith("_msgs"), f"{part}/{file} imports {module}"


def test_borders() -> None:
    parts = sorted({path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")})
    assert set(INWARD) < set(parts)
    for part in parts:
        for module, file in imported(part):
            top = module.partition(".")[0]
            owner = "ros" if top.endswith("_msgs") else BORDERS.get(top, part)
            assert part == owner, f"{part}/{file} imports {module}, which only {owner} may know"
