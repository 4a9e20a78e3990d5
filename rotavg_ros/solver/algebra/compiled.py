"""Functions on numbers and arrays that numba compiles: loops over entries for which NumPy has no operation.

Their machine code is cached beside the module, or in the user's cache folder; the first run on a machine compiles it.
They release the interpreter's lock. Sums keep the order in which they are written, so every machine gets the same
numbers. A program that calls none of them does not load numba, which takes a quarter of a second and 60 MB.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import update_wrapper
from types import FunctionType
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
        self._inner: Function | None = None
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> object:
        return self.dispatcher(*arguments)

    @property
    def dispatcher(self) -> Function:
        """Numba's dispatcher of the function."""
        if self._dispatcher is None:
            made = self._made()
            with suppress(RuntimeError):  # neither folder can be written to: it is compiled in every process
                made._cache = _kept(made.py_func)
            self._dispatcher = cast(Function, made)
        return self._dispatcher

    @property
    def inner(self) -> Function:
        """The same for other kernels: Python cannot call it, and it is not cached, since their code contains it."""
        if self._inner is None:
            self._inner = cast(Function, self._made(no_cpython_wrapper=True))
        return self._inner

    def _made(self, **options: bool) -> Any:
        import numba

        function: Any = self._function
        # The functions that it calls must be dispatchers as well.
        names = dict(function.__globals__)
        for name in function.__code__.co_names:
            if isinstance(names.get(name), _Compiled):
                names[name] = names[name].inner
        own = FunctionType(function.__code__, names, function.__name__, function.__defaults__, function.__closure__)
        njit: Any = numba.njit  # its types lack options that leave out what only others call
        return njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options)(update_wrapper(own, function))


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
