"""Answers on disk, so that a long evaluation resumes where it was interrupted, and repeats only what has changed."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import inspect
import os
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.source_files import source_files
from rotavg_ros.results import ResultError, make_folder
from rotavg_ros.solver import networks

QuestionT = TypeVar("QuestionT")
# Libraries whose versions any answer may depend on.
_LIBRARIES = ("numpy", "scipy", "torch")
# Exceptions on reading a missing or damaged file.
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile)
# Additional array in a file: the names of the answer's arrays, empty if there is no answer.
_FIELDS = "fields"


class KeptAnswers:
    """A folder of answers.

    An answer is found again by the solver's name, the content of the question, and everything else that the answer may
    depend on: the sources that the solver's modules reach, the networks' weights if it reads them, the versions of the
    libraries, and the number of threads, which affects CPU times. The sources are read once.

    Args:
        folder: created if missing.
        weights: folder of the networks' weights, with all below it.

    Raises:
        ResultError: nothing can be written to the folder.
    """

    def __init__(self, folder: Path, weights: Path = networks.WEIGHTS_FOLDER) -> None:
        make_folder(folder)
        self.folder, self._weights = folder, weights
        self._versions: dict[tuple[str, ...], str] = {}

    def keeping(
        self,
        solver: Callable[[QuestionT], Answer | None],
        name: str,
        modules: Sequence[str],
        library: str | None = None,
    ) -> Callable[[QuestionT], Answer | None]:
        """The solver with stored answers to earlier questions; a file that cannot be read is ignored.

        Args:
            solver: answers a question of tensors, arrays and plain values.
            name: of the solver.
            modules: dotted names of those that define it.
            library: the package that does the work, for a peer.
        """
        libraries = _LIBRARIES if library is None else (*_LIBRARIES, library)

        def answer(question: QuestionT) -> Answer | None:
            version = f"{self._version(tuple(modules), libraries)}, {torch.get_num_threads()} threads"
            path = self.folder / f"{name.replace('/', '_')}-{_digest(question, name, version)}.npz"
            with suppress(*_UNREADABLE):
                return _read(path)
            found = solver(question)
            _write(path, found)
            return found

        return answer

    def _version(self, modules: tuple[str, ...], libraries: tuple[str, ...]) -> str:
        key = (*modules, "", *libraries)
        if key not in self._versions:
            sources = sorted({file for module in modules for file in source_files(module)})
            reads_weights = any(source.samefile(inspect.getfile(networks.load_network)) for source in sources)
            weights = sorted(self._weights.rglob("*.safetensors")) if reads_weights else []
            found = hashlib.sha256(" ".join(map(importlib.metadata.version, libraries)).encode())
            for file in (*sources, *weights):
                found.update(file.read_bytes())
            self._versions[key] = found.hexdigest()
        return self._versions[key]


def _write(path: Path, answer: Answer | None) -> None:
    """Write an answer atomically, so that an interruption leaves no partial file."""
    given = {} if answer is None else {field.name: getattr(answer, field.name) for field in dataclasses.fields(answer)}
    arrays = {name: np.asarray(value) for name, value in given.items() if value is not None}
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with unfinished.open("wb") as file:
            np.savez(file, allow_pickle=False, **{_FIELDS: np.array([*arrays], dtype=str), **arrays})
        unfinished.replace(path)
    except OSError as error:
        raise ResultError(f"{path.parent}: an answer cannot be kept here ({error.strerror})") from None
    finally:
        with suppress(OSError):
            unfinished.unlink()


def _read(path: Path) -> Answer | None:
    with path.open("rb") as file, np.load(file) as archive:
        given = archive[_FIELDS].tolist()
        if {_FIELDS, *given} != set(archive.files):
            raise KeyError(path)
        if not given:
            return None
        values: dict[str, Any] = {}
        for field in dataclasses.fields(Answer):
            if field.name in given:
                value = archive[field.name]
                is_tensor = Tensor.__name__ in str(field.type).split(" | ")
                values[field.name] = torch.from_numpy(value) if is_tensor else value.item()
        return Answer(**values)


def _digest(question: object, *more: str) -> str:
    found = hashlib.sha256()
    for part in (*more, *_parts(question)):
        found.update(part.encode() if isinstance(part, str) else part)
        found.update(b"|")
    return found.hexdigest()[:32]


def _parts(value: Any) -> Iterator[str | bytes]:
    """The parts of a value; dataclasses are taken apart."""
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
