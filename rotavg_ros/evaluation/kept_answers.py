"""Answers on disk: an evaluation of hours goes on where it was interrupted, and repeats only what has changed."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import os
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.evaluation.source_files import source_files
from rotavg_ros.evaluation.tables import ReportError
from rotavg_ros.solver.neurora import network_store

QuestionT = TypeVar("QuestionT")
AnswerT = TypeVar("AnswerT")
# Whose versions an answer may depend on, whoever gives it.
_LIBRARIES = ("numpy", "scipy", "torch")
# What reading a file that is missing or damaged may end in.
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile)
_ANSWERED = "answered"


def kept(
    name: str,
    solver: Callable[[QuestionT], AnswerT | None],
    answer_type: Callable[..., AnswerT],
    folder: Path | None,
    module: str,
    peer_package: str | None = None,
) -> Callable[[QuestionT], AnswerT | None]:
    """The solver, but for questions that it has answered before; a file that cannot be read is no answer.

    An answer is found again by the solver's name, the contents of the question, and all that the answer may depend on
    besides: the sources that ``module`` reaches, the networks' weights if they are among what it reads, the versions
    of the libraries, and the number of threads, by which CPU times differ.

    Args:
        answer_type: a dataclass of tensors, arrays, numbers and None.
        folder: where answers are kept; None: nowhere.
        module: dotted name of the module that defines the solver.
        peer_package: the library that does the work, for a peer.
    """
    if folder is None:
        return solver
    keeping = folder
    libraries = (*_LIBRARIES, peer_package) if peer_package else _LIBRARIES
    version = f"{_version(module, libraries)}, {torch.get_num_threads()} threads"

    def answer(question: QuestionT) -> AnswerT | None:
        path = keeping / f"{name.replace('/', '_')}-{_digest(question, name, version)}.npz"
        with suppress(*_UNREADABLE):
            return _read(path, answer_type)
        found = solver(question)
        _write(path, found)
        return found

    return answer


def _write(path: Path, answer: Any) -> None:
    """All at once: whoever is interrupted leaves no half of a file."""
    given = {} if answer is None else {field.name: getattr(answer, field.name) for field in dataclasses.fields(answer)}
    arrays = {name: np.asarray(value) for name, value in given.items() if value is not None}
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished.open("wb") as file:
            np.savez(file, allow_pickle=False, **{_ANSWERED: np.asarray(answer is not None), **arrays})
        unfinished.replace(path)
    except OSError as error:
        raise ReportError(f"{path.parent}: an answer cannot be kept here ({error.strerror})") from None
    finally:
        with suppress(OSError):
            unfinished.unlink()


def _read(path: Path, answer_type: Callable[..., AnswerT]) -> AnswerT | None:
    with path.open("rb") as file, np.load(file) as archive:
        if not archive[_ANSWERED]:
            return None
        values: dict[str, Any] = {}
        for field in dataclasses.fields(answer_type):  # type: ignore[arg-type]
            kinds = str(field.type).split(" | ")
            if field.name not in archive and "None" in kinds:
                values[field.name] = None
                continue
            value = archive[field.name]
            is_tensor = Tensor.__name__ in kinds
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
def _version(module: str, libraries: tuple[str, ...]) -> str:
    found = hashlib.sha256(" ".join(map(importlib.metadata.version, libraries)).encode())
    sources = source_files(module)
    reads_weights = any(source.samefile(network_store.__file__) for source in sources)
    weights = sorted(network_store.WEIGHTS_FOLDER.glob("*.safetensors")) if reads_weights else []
    for file in (*sources, *weights):
        found.update(file.read_bytes())
    return found.hexdigest()
