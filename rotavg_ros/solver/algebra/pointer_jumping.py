"""Pointer jumping: what lies along chains of pointers, in as many vectorised rounds as their length has bits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import numpy as np
from torch import Tensor

Pointers = TypeVar("Pointers", np.ndarray, Tensor)


def doublings(pointer: Pointers) -> Iterator[tuple[Pointers, Pointers]]:
    """Where pointers ``(N,)`` lead in 1, 2, 4, … steps, each with what leads twice as far, until no chain goes on.

    A chain ends in an element that points at itself.
    """
    while True:
        farther = pointer[pointer]
        if bool((farther == pointer).all()):
            return
        yield pointer, farther
        pointer = farther


def follow(pointer: np.ndarray) -> np.ndarray:
    """The end of every chain, ``(N,)``."""
    end = pointer
    for _, end in doublings(pointer):  # noqa: B007 (the last one counts)
        pass
    return end
