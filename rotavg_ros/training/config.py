"""The configuration of a training run: a YAML file whose keys are the fields of :class:`TrainingConfig`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from rotavg_ros.datasets.simulation.stress.family import RobotFamily, RobotFamilyError
from rotavg_ros.errors import UserError
from rotavg_ros.yaml_keys import repeated_keys

# Number of seeds that torch tells apart.
_SEEDS = 1 << 64
# Cameras or keyframes of a graph. Of more cameras, a list of all pairs takes more than 10 GB.
_NODES = 10, 20_000


class TrainingConfigError(UserError):
    """A training configuration that cannot be used; the message names the file and the key."""


@dataclass(frozen=True)
class TrainingConfig:
    """Everything that decides the outcome of a training run, apart from the machine.

    Attributes:
        family: "sfm" or "slam", the networks' profile, or "paper": SfM as the paper's text has it.
        recipe: SfM: "released", "released-spatial" (axes anywhere), "paper", "wide" (small and large noise, mostly on
            topologies of dense clusters with a sparse fringe), "released-round" (noise axes alone anywhere), "mixture"
            (the first three), "broad" or "mostly-released" (the first four), "any-axes" (all five); SLAM: "wide", or
            "robots", runs whose noise is uneven, as ``robots`` has it.
        nodes: cameras or keyframes of the training graphs, drawn uniformly (SLAM: in the logarithm).
        graphs: number of training graphs; each epoch sees all of them once.
        validation_nodes, validation_graphs: the same for the graphs that decide which weights are kept.
        epochs: passes over the training graphs.
        batch_graphs: graphs per step, joined into one disjoint graph.
        learning_rate, weight_decay: of Adam; the rate falls to zero along a cosine.
        warmup_epochs: number of epochs at the start over which the rate grows.
        averaging: the weights that are validated and kept are an exponential mean over the steps; this is the weight
            of each step relative to the next; 0 for the last step's own weights.
        edge_dropout: share of each graph's edges left out anew in every epoch; FineNet of robots' graphs has none.
        passes: FineNet: largest number of passes in a row, as in NeuRoRA-v2; it learns from the last pass, and fewer
            passes are more likely; at most 2 in the family slam, 1 in the family paper.
        seed: of data, initial weights and order.
        goes_on_from: the configuration whose weights this one starts from (``rotavg train --start``); empty: none.
        robots: for the recipe "robots": worlds, noise, false closures and how uneven they are; None: the defaults.
    """

    family: str = "sfm"
    recipe: str = "released"
    nodes: tuple[int, int] = (60, 200)
    graphs: int = 1000
    validation_nodes: tuple[int, int] = (400, 400)
    validation_graphs: int = 8
    epochs: int = 250
    batch_graphs: int = 8
    learning_rate: float = 5e-5
    weight_decay: float = 1e-4
    warmup_epochs: int = 0
    averaging: float = 0.0
    edge_dropout: float = 0.25
    passes: int = 1
    seed: int = 0
    goes_on_from: str = ""
    robots: RobotFamily | None = None

    def __post_init__(self) -> None:
        of_photos = (
            *("released", "released-spatial", "released-round", "paper", "wide"),
            *("mixture", "broad", "mostly-released", "any-axes"),
        )
        recipes = {"sfm": of_photos, "slam": ("wide", "robots"), "paper": of_photos}
        if self.family not in recipes:
            raise TrainingConfigError(f"family is {self.family!r}; choose from {', '.join(recipes)}")
        if self.recipe not in recipes[self.family]:
            raise TrainingConfigError(
                f"recipe is {self.recipe!r}; the family {self.family} has {', '.join(recipes[self.family])}"
            )
        for name in ("graphs", "validation_graphs", "epochs", "batch_graphs", "passes"):
            if getattr(self, name) < 1:
                raise TrainingConfigError(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("nodes", "validation_nodes"):
            low, high = getattr(self, name)
            if not _NODES[0] <= low <= high <= _NODES[1]:
                bounds = f"{_NODES[0]} to {_NODES[1]}"
                raise TrainingConfigError(f"{name} is [{low}, {high}]; use an ascending pair of {bounds}")
        if self.robots is not None and self.recipe != "robots":
            raise TrainingConfigError("robots is for `family: slam` and `recipe: robots`; add these two lines")
        if self.warmup_epochs < 0:
            raise TrainingConfigError(f"warmup_epochs is {self.warmup_epochs}; it must not be negative")
        if not 0 < self.learning_rate < math.inf:
            raise TrainingConfigError(f"learning_rate is {self.learning_rate}; it must be positive")
        if not 0 <= self.weight_decay < math.inf:
            raise TrainingConfigError(f"weight_decay is {self.weight_decay}; it must not be negative")
        if not 0 <= self.seed < _SEEDS:
            raise TrainingConfigError(f"seed is {self.seed}; it must be a whole number from 0 to 2⁶⁴ - 1")
        if not 0 <= self.averaging < 1:
            raise TrainingConfigError(f"averaging is {self.averaging}; a share in [0, 1)")
        if not 0 <= self.edge_dropout < 1:
            raise TrainingConfigError(f"edge_dropout is {self.edge_dropout}; a share in [0, 1)")

    @classmethod
    def load(cls, path: Path) -> TrainingConfig:
        """Read a YAML file.

        Raises:
            TrainingConfigError: unreadable, unknown or repeated key, or a value of the wrong type or range.
        """
        try:
            text = path.read_text()
            content = yaml.safe_load(text)
            repeated = next(repeated_keys(text), None)
        except OSError as error:
            raise TrainingConfigError(f"{path}: cannot be read ({error.strerror}); give a YAML file") from None
        except (ValueError, yaml.YAMLError) as error:  # not UTF-8, a date that does not exist
            reason = " ".join(str(error).split())
            raise TrainingConfigError(f"{path}: not a readable YAML file ({reason})") from None
        except RecursionError:
            raise TrainingConfigError(f"{path}: is nested too deeply; expected `key: value` lines") from None
        if repeated is not None:
            raise TrainingConfigError(repeated.told(path))
        if not isinstance(content, dict):
            raise TrainingConfigError(f"{path}: expected `key: value` lines, found {type(content).__name__}")
        return cls.from_dict(content, str(path))

    @classmethod
    def from_dict(cls, content: dict[str, Any], origin: str = "configuration") -> TrainingConfig:
        """Build from plain values; ``origin`` names them in errors."""
        defaults: dict[str, Any] = {field.name: field.default for field in fields(cls)}
        values: dict[str, Any] = {}
        for key, value in content.items():
            if key not in defaults:
                raise TrainingConfigError(f"{origin}: unknown key {key!r}; known are {', '.join(defaults)}")
            kind = type(defaults[key])
            if key == "robots":
                values[key] = None if value is None else _family(value, origin)
                continue
            try:
                values[key] = _CONVERSIONS[kind](value)
            except (TypeError, ValueError, OverflowError):
                raise TrainingConfigError(f"{origin}: {key} is {value!r}, expected like {defaults[key]!r}") from None
            if kind is tuple and len(values[key]) != 2:
                raise TrainingConfigError(f"{origin}: {key} is {value!r}, expected a pair")
        try:
            return cls(**values)
        except TrainingConfigError as error:
            raise TrainingConfigError(f"{origin}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as :meth:`from_dict` takes them."""
        plain = {key: value for key, value in asdict(self).items() if key != "robots" or value is not None}
        return {key: _plain(value) for key, value in plain.items()}


def _text(value: Any) -> str:
    """The text; ``str`` would take a key without a value for 'None'."""
    if not isinstance(value, str):
        raise TypeError(value)
    return value


def _pair(value: Any) -> tuple[int, ...]:
    """A list's whole numbers; ``tuple`` would take the digits of a text, and the keys of a mapping."""
    if not isinstance(value, list | tuple):
        raise TypeError(value)
    return tuple(_whole(item) for item in value)


def _whole(value: Any) -> int:
    """The number, if it is whole; ``int`` would drop a fraction and take ``true`` for 1."""
    if isinstance(value, bool) or (isinstance(value, float) and not value.is_integer()):
        raise ValueError(value)
    return int(value)


def _number(value: Any) -> float:
    if isinstance(value, bool):
        raise ValueError(value)
    return float(value)


_CONVERSIONS: dict[type, Callable[[Any], Any]] = {int: _whole, float: _number, str: _text, tuple: _pair}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    return list(value) if isinstance(value, tuple) else value


def _family(content: Any, origin: str) -> RobotFamily:
    try:
        return RobotFamily.of(content)
    except RobotFamilyError as error:
        raise TrainingConfigError(f"{origin}: robots: {error}") from None
