"""Functions on numbers and arrays that numba compiles: loops over entries for which NumPy has no operation.

Their machine code is cached beside the module, or in the user's cache folder; the first run on a machine compiles it.
They release the interpreter's lock. Sums keep the order in which they are written, so every machine gets the same
numbers. A program that calls none of them does not load numba, which takes a quarter of a second and 60 MB.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import update_wrapper
from typing import Any, Generic, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """The function, compiled on its first call with arguments of their types."""
    return cast(Function, _Compiled(function))


class _Compiled(Generic[Function]):
    """Stands in for a function and compiles it on the first call."""

    def __init__(self, function: Function) -> None:
        self._function = function
        self._dispatcher: Function | None = None
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> object:
        return self.dispatcher(*arguments)

    @property
    def dispatcher(self) -> Function:
        """Numba's dispatcher of the function."""
        if self._dispatcher is None:
            import numba

            function = self._function
            # The functions that it calls must be dispatchers as well.
            for name in function.__code__.co_names:
                called = function.__globals__.get(name)
                if isinstance(called, _Compiled):
                    function.__globals__[name] = called.dispatcher
            njit: Any = numba.njit  # its types lack the last option: no C code calls a kernel
            made = njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function)
            with suppress(RuntimeError):  # neither folder can be written to: it is compiled in every process
                made._cache = _kept(function)
            self._dispatcher = cast(Function, made)
        return self._dispatcher


def _kept(function: Callable[..., object]) -> object:
    """Numba's cache; a file damaged by a power cut or a full disk stops no solve: the function is compiled again."""
    from numba.core import caching

    numbas: Any = caching.FunctionCache  # without types

    class Kept(numbas):  # type: ignore[misc]
        def load_overload(self, sig: Any, target_context: Any) -> Any:
            try:
                return super().load_overload(sig, target_context)
            except Exception:  # a pickle cut short, or of zeros, may raise anything
                with suppress(OSError):
                    self.flush()
                return None

        def save_overload(self, sig: Any, data: Any) -> None:
            with suppress(OSError):
                super().save_overload(sig, data)

    kept: Any = Kept
    return cast(object, kept(function))
