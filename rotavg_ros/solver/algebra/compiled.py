"""Functions of numbers and arrays that numba compiles: loops over entries that NumPy has no operation for.

Their machine code is kept beside the module, or in the user's cache; the first run on a machine compiles it. They let
go of the interpreter's lock. Sums stay in the order in which they are written, so every machine comes to the same
numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """The function, compiled when it is first called with arguments of their types."""
    try:
        dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # neither folder can be written to: it is compiled in every process
        dispatcher = numba.njit(nogil=True, error_model="numpy")(function)
    return cast(Function, dispatcher)
