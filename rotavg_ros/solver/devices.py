"""Where a solve runs: on a working GPU if there is one, else on the CPU, which is logged once."""

from __future__ import annotations

import functools
import logging
import warnings

import torch

# Errors of a GPU at work: out of memory, or an error of the driver.
GPU_ERRORS: tuple[type[Exception], ...] = (
    torch.OutOfMemoryError,
    getattr(torch, "AcceleratorError", torch.OutOfMemoryError),  # since torch 2.8
)

_log = logging.getLogger("rotavg_ros")
_said: set[str] = set()


def choose(device: str) -> str:
    """Resolves "auto", "cpu" or "cuda" to "cpu" or "cuda"; logs if a requested GPU is not available."""
    if device == "cpu":
        return "cpu"
    problem = gpu_problem()
    if problem is None:
        return "cuda"
    # With "auto" and no GPU there is nothing to log.
    if device == "cuda" or torch.version.cuda is not None:
        fall_back(problem)
    return "cpu"


def fall_back(problem: object) -> None:
    """Log that the CPU is used instead of a GPU; each problem once per process."""
    line = str(problem).strip().partition("\n")[0]
    if line not in _said:
        _said.add(line)
        _log.warning("solving on the CPU, not on a GPU: %s", line)


@functools.cache
def gpu_problem() -> str | None:
    """Why there is no usable GPU; None if there is one. Tried once per process."""
    if torch.version.cuda is None:
        return "this build of torch has no CUDA"
    with warnings.catch_warnings(record=True) as caught:  # torch warns of a driver that is too old
        warnings.simplefilter("always")
        try:
            if not torch.cuda.is_available():
                return str(caught[0].message) if caught else "torch finds none"
            torch.ones(1, device="cuda").add_(1).item()
        except RuntimeError as error:
            return str(error)
    return None
