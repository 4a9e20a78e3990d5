"""The house: who may import whom, from wing to wing and from room to room, read from the sources."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "rotavg_ros"
TOP = PACKAGE.name
# The wings that others build on, and those that they may import themselves.
INWARD: dict[str, set[str]] = {
    "errors": set(),
    "option": {"errors"},
    "view_graph": {"errors", "rotations"},
    "odometry_route": set(),
    "hamilton": set(),
    "stamps": set(),
    "startup": set(),
    "packed": set(),
    "yaml_keys": set(),
    "whole_file": set(),
    "wording": set(),
    "rotations": {"hamilton"},
    "baselines": {"errors", "rotations", "solver", "view_graph"},
    "solver": {"baselines", "errors", "hamilton", "odometry_route", "rotations", "view_graph", "wording"},
    "datasets": {"errors", "packed", "rotations", "view_graph", "whole_file"},
    "metrics": {"rotations", "view_graph"},
    "results": {"errors", "version"},
    "reports": {"errors", "metrics", "online", "replay", "version", "view_graph", "whole_file", "wording"},
    "evaluation": {
        *("baselines", "datasets", "errors", "metrics", "online", "reports", "results"),
        *("rotations", "solver", "stamps", "training", "version", "view_graph", "wording"),
    },
    "training": {
        "datasets",
        "errors",
        "metrics",
        "results",
        "rotations",
        "solver",
        "version",
        "view_graph",
        "whole_file",
        "yaml_keys",
    },
    "online": {
        "errors",
        "hamilton",
        "odometry_route",
        "option",
        "rotations",
        "solver",
        "stamps",
        "startup",
        "view_graph",
        "whole_file",
        "wording",
    },
    "inputs": {"online", "stamps", "view_graph"},
    "settings": {"inputs", "online", "option", "view_graph", "yaml_keys"},
}
# Inside a wing, the rooms (modules and folders) that a room may import; "" is what the folder's own name gives.
ROOMS: dict[str, dict[str, set[str]]] = {
    "solver": {
        "solution": {"algebra"},
        "devices": set(),
        "running": set(),
        "algebra": {"running"},
        "estimate": {"neurora"},
        "learning": {"diagnosis", "neurora", "slam"},
        "diagnosis": {"neurora", "slam"},
        "positions": {"algebra"},
        "warnings": {"algebra", "running", "slam"},
        "neurora": {"algebra", "running"},
        "networks": {"neurora", "slam"},
        "methods": {"sfm", "slam"},
        "batch": {"methods", "pipeline", "solution", "warnings"},
        "slam": {"algebra", "estimate", "neurora", "running"},
        "sfm": {"algebra", "estimate", "neurora", "running"},
        "": {"batch", "methods", "pipeline", "running", "solution"},
        "pipeline": {
            *(
                "devices",
                "estimate",
                "kept_labels",
                "methods",
                "neurora",
                "running",
                "sfm",
                "slam",
                "solution",
                "warnings",
            ),
        },
    },
    "solver/warnings": {
        "": {"flagged", "whole_solve"},
        "odometry": set(),
        "flagged": set(),
        "conventions": {"odometry"},
        "lone_places": {"odometry"},
        "whole_solve": {"conventions", "flagged", "lone_places", "odometry"},
    },
    "solver/neurora": {
        "": set(),
        "numbers": set(),
        "network_store": set(),
        "message_passing": set(),
        "cleaned": {"numbers"},
        "scores": {"numbers"},
        "tree": {"cleaned", "numbers"},
        "clean_net": {"message_passing", "network_store"},
        "fine_net": {"message_passing", "network_store", "numbers"},
        "stages": {"clean_net", "cleaned", "fine_net", "tiled"},
        "paper": {"clean_net", "cleaned", "message_passing", "network_store", "tiled"},
        "tiled": {"clean_net", "cleaned", "fine_net", "message_passing", "numbers"},
    },
    "solver/sfm": {
        "": set(),
        "priors": set(),
        "options": set(),
        "symmetric_rows": set(),
        "laplacians": {"noise_shape", "symmetric_rows"},
        "noise_shape": {"priors", "symmetric_rows"},
        "noise_density": {"priors"},
        "refinement": {"noise_density", "noise_shape", "priors", "step", "symmetric_rows"},
        "step": {"laplacians", "noise_density", "noise_shape", "priors", "series", "symmetric_rows"},
        "series": set(),
        "rejected": set(),
        "stated": {"noise_shape", "priors", "refinement", "step"},
        "cycles": {"priors"},
        "consensus": {"cycles", "priors"},
        "starts": {"cycles", "priors", "refinement", "step"},
        "certainty": {"laplacians", "priors", "starts"},
        "solve": {
            *("certainty", "consensus", "cycles", "options", "priors", "refinement", "rejected", "series"),
            *("starts", "stated", "step"),
        },
    },
    "solver/slam": {
        "": set(),
        "options": set(),
        "graph": set(),
        "noise": {"graph"},
        "preparation": {"graph", "noise"},
        "network": {"graph", "noise"},
        "poses": {"graph", "noise", "posterior", "preparation", "stages"},
        "fine_net": {"graph", "posterior"},
        "update": {"fine_net", "graph", "links", "network", "noise", "poses", "posterior", "stages"},
        "stages": {"graph", "network", "noise", "preparation"},
        "posterior": {"graph", "network", "noise", "preparation", "stages"},
        "hung_nodes": {"graph"},
        "links": {"graph", "hung_nodes", "noise"},
        "solve": {
            *("fine_net", "graph", "links", "network", "noise", "options", "poses"),
            *("posterior", "preparation", "stages", "update"),
        },
        "live": {"fine_net", "graph", "links", "network", "options", "poses", "posterior", "solve", "update"},
    },
    "solver/slam/fine_net": {
        "": set(),
        "evidence": set(),
        "scale": set(),
        "sparse_solve": set(),
        "features": {"evidence"},
        "network": {"features"},
        "tuning": {"evidence", "features", "network", "scale"},
        "sample": {"evidence", "features", "scale", "sparse_solve", "tuning"},
        "robot_noise": {"evidence", "network", "tuning"},
    },
    "solver/slam/poses": {
        "": set(),
        "priors": set(),
        "state": set(),
        "displacements": set(),
        "even": set(),
        "closures": {"even"},
        "problem": {"closures", "displacements", "even", "priors", "state"},
        "row_errors": {"closures", "displacements", "even", "problem", "state"},
        "rows": {"closures", "displacements", "problem", "row_errors", "state"},
        "repeats": {"closures", "priors", "problem"},
        "places": {"closures", "priors", "repeats"},
        "solved": {"closures", "displacements", "problem", "repeats", "rows", "state"},
        "em": {
            *("closures", "displacements", "even", "places", "problem", "repeats", "row_errors", "rows"),
            *("solved", "state"),
        },
        "search": {"closures", "em", "places", "problem", "repeats", "row_errors", "rows", "solved"},
        "publishing": {"closures", "displacements", "problem", "row_errors", "rows", "solved"},
        "memory": {"closures", "em", "problem", "publishing", "row_errors", "solved", "state"},
        "solve": {"em", "memory", "problem", "publishing", "search", "solved"},
    },
    "solver/slam/posterior": {
        "": set(),
        "priors": set(),
        "state": set(),
        "system": set(),
        "calibration": {"priors", "state", "system"},
        "problem": {"calibration", "priors", "state", "system"},
        "densities": {"priors"},
        "labels": {"densities", "priors", "problem", "state"},
        "rows": {"densities", "problem", "state", "system"},
        "objective": {"densities", "labels", "priors", "problem", "rows", "state", "system"},
        "left_out": {"densities", "labels", "problem", "rows", "state", "system"},
        "em": {"left_out", "objective", "problem", "rows", "state", "system"},
        "mode": {"left_out", "objective", "problem", "state"},
        "moves": {"densities", "em", "labels", "left_out", "mode", "objective", "priors", "problem", "rows", "state"},
        "inference": {"em", "mode", "moves", "problem", "rows", "state"},
        "publishing": {"em", "left_out", "mode", "problem", "rows", "state", "system"},
        "solve": {"calibration", "em", "inference", "mode", "moves", "priors", "problem", "state"},
    },
    "online": {
        "free_memory": set(),
        "solver_process": {"free_memory"},
        "growing_array": set(),
        "quaternion": set(),
        "options": {"odometry"},
        "measurements": {"quaternion"},
        "compaction": {"measurements"},
        "odometry": {"growing_array", "measurements", "quaternion"},
        "content": {"answer", "graph", "measurements", "options", "quaternion"},
        "current_content": {"content", "measurements", "odometry", "options", "state"},
        "ticks": {"answer", "content", "current_content", "free_memory", "options"},
        "": {"answer", "estimator", "measurements", "options", "state"},
        "answer": {"compaction", "graph", "measurements", "odometry", "quaternion"},
        "graph": {"compaction", "growing_array", "measurements", "odometry", "options", "quaternion"},
        "state": {"answer", "compaction", "content", "graph", "measurements", "odometry", "options"},
        "estimator": {
            *("answer", "content", "current_content", "graph"),
            *("measurements", "options", "quaternion", "state", "ticks"),
        },
    },
    "ros": {
        "": set(),
        "node": set(),
        "harness": {"node"},
    },
    "ros/node": {
        "worker": set(),
        "": set(),
        "message_counting": set(),
        "solver": set(),
        "topics": set(),
        "parameter_server": set(),
        "diagnostics": {"health"},
        "main": {"estimator_node"},
        "health": {"message_counting"},
        "output": {"topics"},
        "services": {"solving", "worker"},
        "solving": {"diagnostics", "health", "intake", "output", "tick_budget"},
        "tick_budget": set(),
        "intake": {"health", "message_counting", "output", "topics"},
        "estimator_node": {
            "diagnostics",
            "health",
            "intake",
            "output",
            "parameter_server",
            "services",
            "solver",
            "solving",
            "worker",
        },
    },
    "evaluation": {
        "": set(),
        "names": set(),
        "common": set(),
        "benchmark": {"common"},
        "sfm": {"common"},
        "live": {"common"},
        "slam": {"common", "live"},
    },
    "datasets": {
        "dead_reckoning": set(),
        "planar": set(),
        "worlds": set(),
        "files": {"dead_reckoning", "planar"},
        "interpolation": {"files"},
        "simulation": {"files", "worlds"},
    },
}
# What those outside may import from the inside of a wing, besides its face.
FACES = {
    "solver": {"batch", "learning", "devices", "diagnosis", "methods", "networks", "pipeline", "positions", "solution"}
}
INSIDERS = {"baselines": {"algebra", "neurora"}, "training": {"algebra", "neurora"}}
# What a robot runs needs no more.
NODE_MAY_USE = {
    "errors",
    "inputs",
    "online",
    "option",
    "settings",
    "solver",
    "stamps",
    "startup",
    "version",
    "view_graph",
    "whole_file",
}
# Others' packages that only one wing may know.
BORDERS = {"rclpy": "ros", "rosbags": "bags", "mcap": "bags"}
# Who imports by name what no arrow is about: subcommands, message packages, peers that may not be installed.
BY_NAME = {
    "cli.main",
    "evaluation.common.peers.running",
    "ros.harness.player",
    "ros.node.intake.adapters",
    "ros.node.intake.serialized_array",
}
MAX_ROOMS, MAX_PARAMETERS = 16, 6
# Columns of a table and options of a public call, by keyword, most of which nobody gives.
BY_KEYWORD = {"solver.pipeline.solve", "view_graph.create", "datasets.files.graph_file.from_ids"}


def files(folder: str = "") -> list[Path]:
    """Modules below a folder of the package, or one module."""
    path = PACKAGE / folder
    return sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]


def module_name(file: Path) -> str:
    """Dotted name below the package; a folder's own for its ``__init__``."""
    return ".".join(file.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__").removesuffix("__init__")


MODULES = {module_name(file): file for file in files()}


@cache
def nodes_of(file: Path) -> list[ast.AST]:
    """All that a file's syntax is made of."""
    return list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))


def imported(file: Path) -> Iterator[str]:
    """Full names of all modules that a file imports, anywhere in it, also for type checking only."""
    for node in nodes_of(file):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = node.module.partition(".")[2] if node.module.split(".")[0] == TOP else None
            for alias in node.names:
                is_module = inside is not None and f"{inside}.{alias.name}".strip(".") in MODULES
                yield f"{node.module}.{alias.name}" if is_module else node.module


def imported_inside(file: Path) -> Iterator[str]:
    """Names below the package of what a file imports from it."""
    yield from (name.partition(".")[2] for name in imported(file) if name.split(".")[0] == TOP)


@pytest.mark.parametrize("wing", INWARD)
def test_no_wing_imports_outward(wing: str) -> None:
    for file in files(wing):
        for name in imported(file):
            top, _, inner = name.partition(".")
            if top == TOP:
                assert inner.partition(".")[0] in {wing, *INWARD[wing]}, f"{file} imports {name}"
            else:
                assert top not in BORDERS and not top.endswith("_msgs"), f"{file} imports {name}"


def test_the_node_stands_by_itself() -> None:
    """What demonstrates and measures a node may use its parts, and never the other way round."""
    for file in files("ros/node"):
        for name in imported_inside(file):
            assert name.partition(".")[0] in {"", *NODE_MAY_USE} or name.startswith("ros.node"), (
                f"{file} imports {name}"
            )


def test_borders() -> None:
    wings = {module_name(file).partition(".")[0] for file in files()}
    assert set(INWARD) < wings
    for file in files():
        wing = module_name(file).partition(".")[0]
        for name in imported(file):
            top = name.partition(".")[0]
            owner = "ros" if top.endswith("_msgs") else BORDERS.get(top, wing)
            assert wing == owner, f"{file} imports {name}, which only {owner} may know"


@pytest.mark.parametrize("folder", ROOMS)
def test_no_room_imports_outward(folder: str) -> None:
    rooms: Mapping[str, set[str]] = ROOMS[folder]
    prefix = folder.replace("/", ".")
    present = {module_name(file).removeprefix(prefix).strip(".").partition(".")[0] for file in files(folder)}
    assert present - {""} == set(rooms) - {""}, folder
    for file in files(folder):
        room = module_name(file).removeprefix(prefix).strip(".").partition(".")[0]
        for name in imported_inside(file):
            if name == prefix or name.startswith(f"{prefix}."):
                other = name.removeprefix(prefix).strip(".").partition(".")[0]
                assert other in {room, *rooms[room]}, f"{file} imports {name}"


@pytest.mark.parametrize("wing", FACES)
def test_others_import_from_the_face(wing: str) -> None:
    for file in files():
        own = module_name(file).partition(".")[0]
        for name in imported_inside(file):
            first, _, rest = name.partition(".")
            if first == wing != own and rest:
                allowed = FACES[wing] | (INSIDERS.get(own, set()) if wing == "solver" else set())
                assert rest.partition(".")[0] in allowed, f"{file} imports {name}, which is no face of {wing}"


def test_no_module_reaches_itself() -> None:
    graph = {}
    for name, file in MODULES.items():
        if file.name != "__init__.py":  # what a folder gathers for others reaches all that it gathers
            graph[name] = {other for other in imported_inside(file) if MODULES.get(other, file).name != "__init__.py"}
    TopologicalSorter(graph).prepare()


def test_profiles_do_not_reach_each_other() -> None:
    """From the start of either profile's solve."""
    for profile, other in (("sfm", "slam"), ("slam", "sfm")):
        reached, waiting = set(), [f"solver.{profile}.solve"]
        while waiting:
            name = waiting.pop()
            if name in MODULES and name not in reached and MODULES[name].name != "__init__.py":
                reached.add(name)
                waiting += imported_inside(MODULES[name])
        assert not [name for name in reached if name.startswith(f"solver.{other}.")]


def test_only_others_packages_and_subcommands_are_imported_by_name() -> None:
    by_name = {
        module_name(file) for file in files() if re.search(r"\b(import_module|__import__)\(", file.read_text("utf-8"))
    }
    assert by_name <= BY_NAME


def test_a_folder_holds_no_more_than_can_be_held_in_the_head() -> None:
    for folder in {file.parent for file in files()} - {PACKAGE, PACKAGE / "cli"}:
        rooms = [path for path in folder.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()]
        assert len(rooms) - 1 <= MAX_ROOMS, f"{folder} has {len(rooms) - 1} rooms"


def test_parameters_that_travel_together_are_a_class() -> None:
    for name, file in MODULES.items():
        for node in nodes_of(file):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                given = [*node.args.posonlyargs, *node.args.args]
                if f"{name}.{node.name}" not in BY_KEYWORD:
                    given += node.args.kwonlyargs
                count = sum(argument.arg not in ("self", "cls") for argument in given)
                assert count <= MAX_PARAMETERS, f"{file}: {node.name} takes {count} parameters"


def test_a_seconds_nanoseconds_are_defined_once() -> None:
    defining = re.compile(r"^_?NANOSECONDS\b.*=", re.MULTILINE)
    assert [name for name, file in MODULES.items() if defining.search(file.read_text("utf-8"))] == ["stamps"]
