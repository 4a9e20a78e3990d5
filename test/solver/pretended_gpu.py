"""A GPU that is none: tensors that live on the CPU and say "cuda", and that refuse what a real GPU would refuse.

Inside :func:`pretended_gpu`, what is moved or made there is a :class:`GpuTensor`. Operations on it run on the CPU, but
may not take a CPU tensor as well (one number may come as such; an index may not, though a real GPU would fetch it), nor
hand anything to numpy. What goes over the bus is written down, and so is whatever makes the CPU wait for the GPU.
Kernels that CUDA lacks, or has for fewer types, do not show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map_only

from rotavg_ros.solver.neurora.network_store import forget_networks

_GPU, _CPU = torch.device("cuda", 0), torch.device("cpu")
# What reads a number or a shape back from the GPU.
_WAITING = {"item", "__bool__", "__int__", "__float__", "__index__", "tolist", "nonzero", "equal", "unique", "bincount"}
_WAITING |= {"masked_select", "linalg_inv", "linalg_eigh"}
_MOVING = {"to", "cpu", "cuda"}
_TO_NUMPY = {"numpy", "__array__"}


@dataclass
class Traffic:
    """Shapes of the tensors that were moved to and from the GPU, and the operations for which the CPU waited."""

    to_gpu: list[tuple[int, ...]] = field(default_factory=list)
    from_gpu: list[tuple[int, ...]] = field(default_factory=list)
    waits: list[str] = field(default_factory=list)


_traffic = Traffic()


class GpuTensor(Tensor):
    """Says that it is on a GPU."""

    @classmethod
    def __torch_function__(
        cls, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return _call(func, args, kwargs or {})


class _Factories(TorchFunctionMode):
    """Catches what has no GPU tensor among its arguments: ``torch.zeros(…, device="cuda")`` and ``x.to("cuda")``."""

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return _call(func, args, kwargs or {})


@contextmanager
def pretended_gpu() -> Iterator[Traffic]:
    """Let "cuda" be the pretended GPU; what goes over the bus meanwhile."""
    global _traffic
    _traffic = Traffic()
    with _Factories():
        yield _traffic
    forget_networks()  # those with pretended weights


def _call(func: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    leaves = tree_flatten((args, kwargs))[0]
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    is_on_gpu = any(isinstance(tensor, GpuTensor) for tensor in tensors)
    name = getattr(func, "__name__", "")
    if name == "__get__":
        if is_on_gpu and func == Tensor.device.__get__:  # type: ignore[attr-defined]
            return _GPU
    elif name == "_has_compatible_shallow_copy_type":  # asked by a module that is moved: it is to take new tensors
        return False
    elif name in _MOVING:
        return _move(func, args, kwargs, leaves)
    elif is_on_gpu:
        _refuse_and_count(name, args, kwargs, tensors)
    goes_to_gpu = is_on_gpu or any(_names_gpu(leaf) for leaf in leaves)
    # What asks for the GPU gets the CPU, and its result is marked.
    args, kwargs = tree_map_only(torch.device, lambda _: _CPU, (args, kwargs))
    if _names_gpu(kwargs.get("device")):
        kwargs["device"] = _CPU
    with torch._C.DisableTorchFunction():
        result = func(*_plain(args), **_plain(kwargs))
    return _marked(result) if goes_to_gpu else result


def _move(func: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any], leaves: list[Any]) -> Any:
    tensor, wanted = args[0], leaves[1:]
    was_on_gpu = is_on_gpu = isinstance(tensor, GpuTensor)
    if func == Tensor.cpu or any(_names(leaf, "cpu") for leaf in wanted):
        is_on_gpu = False
    elif any(_names_gpu(leaf) or isinstance(leaf, GpuTensor) for leaf in wanted):
        is_on_gpu = True
    elif any(isinstance(leaf, Tensor) for leaf in wanted):
        is_on_gpu = False
    if was_on_gpu != is_on_gpu:
        (_traffic.to_gpu if is_on_gpu else _traffic.from_gpu).append(tuple(tensor.shape))
    dtype = next((getattr(leaf, "dtype", leaf) for leaf in wanted if isinstance(leaf, Tensor | torch.dtype)), None)
    with torch._C.DisableTorchFunction():
        # A copy, so that writing on one side is not seen on the other.
        moved = _plain(tensor).to(dtype=dtype, copy=was_on_gpu != is_on_gpu)
    return _marked(moved) if is_on_gpu else moved


def _refuse_and_count(name: str, args: tuple[Any, ...], kwargs: dict[str, Any], tensors: list[Tensor]) -> None:
    with torch._C.DisableTorchFunction():
        strangers = [tensor for tensor in tensors if not isinstance(tensor, GpuTensor) and tensor.dim() > 0]
        by_mask = name in ("__getitem__", "__setitem__") and any(
            isinstance(leaf, Tensor) and leaf.dtype == torch.bool for leaf in tree_flatten(args[1])[0]
        )
    if strangers:
        raise RuntimeError(f"{name}: expected all tensors to be on the same device, found cuda:0 and cpu")
    if name in _TO_NUMPY:
        raise TypeError("can't convert cuda:0 device type tensor to numpy; use Tensor.cpu() first")
    is_unsized = name == "repeat_interleave" and kwargs.get("output_size") is None
    if name in _WAITING or by_mask or is_unsized:
        _traffic.waits.append(name)


def _names(leaf: object, kind: str) -> bool:
    return (isinstance(leaf, torch.device) and leaf.type == kind) or (isinstance(leaf, str) and leaf.startswith(kind))


def _names_gpu(leaf: object) -> bool:
    return _names(leaf, "cuda")


def _plain(tree: Any) -> Any:
    return tree_map_only(GpuTensor, lambda tensor: tensor.as_subclass(Tensor), tree)


def _marked(tree: Any) -> Any:
    return tree_map_only(Tensor, _mark, tree)


def _mark(tensor: Tensor) -> Any:
    return _SparseMatrix(tensor) if tensor.layout == torch.sparse_csr else tensor.as_subclass(GpuTensor)


@dataclass(frozen=True)
class _SparseMatrix:
    """Of which torch allows no subclass; all that is done with one is to multiply."""

    on_cpu: Tensor

    def __matmul__(self, columns: Tensor) -> Any:
        assert isinstance(columns, GpuTensor)
        return _marked(self.on_cpu @ _plain(columns))
