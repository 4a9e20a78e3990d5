"""Working memory that is reused: with a small graph, touching fresh pages takes as long as a layer of messages."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

# Larger buffers go back to the system; there the share of this cost is small.
_KEPT_BYTES = 64 << 20
_lock = threading.Lock()
_kept: list[Tensor] = []


@contextmanager
def scratch(rows: int, columns: int, like: Tensor) -> Iterator[Tensor]:
    """An uninitialised matrix with the dtype and device of ``like``."""
    size = rows * columns
    if like.device.type != "cpu" or size * like.element_size() > _KEPT_BYTES:
        yield like.new_empty(rows, columns)  # torch itself keeps an accelerator's memory
        return
    with _lock:
        buffer = _kept.pop() if _kept else like.new_empty(0)
    if len(buffer) < size or buffer.dtype != like.dtype:
        buffer = torch.empty(size, dtype=like.dtype)
    try:
        yield buffer[:size].view(rows, columns)
    finally:
        with _lock:
            _kept[:] = [buffer]
