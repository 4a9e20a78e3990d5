"""Values that are computed once, without a lock.

Until Python 3.12, ``functools.cached_property`` holds one lock for all objects of a class while it computes a value. A
solve that rests there (:mod:`~rotavg_ros.solver.running.resumable`) would block every other one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar, overload

Value = TypeVar("Value")


class cached_property(Generic[Value]):  # noqa: N801 - as functools names it
    """As ``functools.cached_property``, but two threads that ask at once may both compute the value."""

    def __init__(self, work_out: Callable[[Any], Value]) -> None:
        self._work_out, self._name = work_out, work_out.__name__
        self.__doc__ = work_out.__doc__

    @overload
    def __get__(self, instance: None, owner: type) -> cached_property[Value]: ...

    @overload
    def __get__(self, instance: object, owner: type) -> Value: ...

    def __get__(self, instance: object | None, owner: type) -> cached_property[Value] | Value:
        if instance is None:
            return self
        # Not a data descriptor: from now on the object's own value is found first.
        value = self._work_out(instance)
        instance.__dict__[self._name] = value
        return value
