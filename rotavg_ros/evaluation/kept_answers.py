"""Answers on disk: an evaluation of hours goes on where it was interrupted, and repeats only what has changed."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import os
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

import rotavg_ros

CaseT = TypeVar("CaseT")
AnswerT = TypeVar("AnswerT")
_PACKAGE = Path(rotavg_ros.__file__).parent
# What an answer of ours may depend on besides the case.
_SOURCES = ("solver", "baselines", "rotations.py", "view_graph.py", "evaluation/least_squares.py")
_PEER_SOURCES = ("evaluation/peers.py",)
_ANSWERED = "answered"


def kept(
    name: str,
    contender: Callable[[CaseT], AnswerT | None],
    answer_type: Callable[..., AnswerT],
    folder: Path,
    peer_package: str | None = None,
) -> Callable[[CaseT], AnswerT | None]:
    """The contender, but for cases that it has answered before.

    An answer is found again by the contents of the case, the contender's name and its version: for ours that of every
    source file and weight of the solver, for a peer that of its package.

    Args:
        answer_type: a dataclass of tensors, arrays and numbers.
        peer_package: whose version counts, for a peer.
    """
    version = _version(_PEER_SOURCES, peer_package) if peer_package else _version(_SOURCES, "torch")

    def answer(case: CaseT) -> AnswerT | None:
        path = folder / f"{name.replace('/', '_')}-{_digest(case, name, version)}.npz"
        if path.exists():
            return _read(path, answer_type)
        found = contender(case)
        _write(path, found)
        return found

    return answer


def _write(path: Path, answer: Any) -> None:
    """All at once: whoever is interrupted leaves no half of a file."""
    fields = {} if answer is None else {f.name: np.asarray(getattr(answer, f.name)) for f in dataclasses.fields(answer)}
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    with unfinished.open("wb") as file:
        np.savez(file, allow_pickle=False, **{_ANSWERED: np.asarray(answer is not None), **fields})
    unfinished.replace(path)


def _read(path: Path, answer_type: Callable[..., AnswerT]) -> AnswerT | None:
    with np.load(path) as archive:
        if not archive[_ANSWERED]:
            return None
        values: dict[str, Any] = {}
        for field in dataclasses.fields(answer_type):  # type: ignore[arg-type]
            value = archive[field.name]
            is_tensor = field.type == Tensor.__name__
            values[field.name] = torch.from_numpy(value) if is_tensor else value if value.ndim else value.item()
        return answer_type(**values)


def _digest(case: object, *more: str) -> str:
    found = hashlib.sha256()
    for part in (*more, *_parts(case)):
        found.update(part.encode() if isinstance(part, str) else part)
        found.update(b"|")
    return found.hexdigest()[:32]


def _parts(value: Any) -> Iterator[str | bytes]:
    """What a value consists of, dataclasses taken apart."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield field.name
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, (Tensor, np.ndarray)):
        array = np.ascontiguousarray(value)
        yield f"{array.dtype} {array.shape}"
        yield array.tobytes()
    else:
        yield repr(value)


@cache
def _version(sources: tuple[str, ...], package: str) -> str:
    found = hashlib.sha256(importlib.metadata.version(package).encode())
    for source in sources:
        path = _PACKAGE / source
        files = sorted(p for p in path.rglob("*") if p.suffix in (".py", ".safetensors")) if path.is_dir() else [path]
        for file in files:
            found.update(file.read_bytes())
    return found.hexdigest()
