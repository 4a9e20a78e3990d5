"""A training run on disk: tensors of network and optimizer with the identity of their run, and atomic writes.

Files are written beside their place and moved into it, so that a run that is killed at any moment leaves complete files
behind, either the old ones or the new ones.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from rotavg_ros.errors import UserError
from rotavg_ros.whole_file import replacing

_NETWORK, _OPTIMIZER, _AVERAGE = "network.", "optimizer.", "average."


class CheckpointError(UserError):
    """A checkpoint that cannot be resumed; the message names the file, the reason and the remedy."""


def save_checkpoint(
    path: Path,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    average: dict[str, Tensor],
    identity: dict[str, Any],
    state: dict[str, Any],
) -> None:
    """Write what :func:`load_checkpoint` needs.

    Args:
        average: the mean weights so far by parameter; empty if none are kept.
        identity: identifies the run; only a run of equal identity may resume it. Plain values.
        state: its progress. Plain values.
    """
    tensors = {_NETWORK + key: value for key, value in network.state_dict().items()}
    tensors.update({_AVERAGE + key: value for key, value in average.items()})
    for number, moments in optimizer.state_dict()["state"].items():
        tensors.update({f"{_OPTIMIZER}{number}.{key}": value for key, value in moments.items()})
    save_tensors(path, tensors, {"identity": json.dumps(identity), "state": json.dumps(state)})


def check_checkpoint(path: Path, identity: dict[str, Any]) -> None:
    """Check that a checkpoint is one of the run of this identity.

    Raises:
        CheckpointError: not a checkpoint, or one of another run.
    """
    _read(path, identity)


def load_checkpoint(
    path: Path,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    average: dict[str, Tensor],
    identity: dict[str, Any],
) -> dict[str, Any]:
    """Restore network, optimizer and mean weights from a checkpoint; returns the state.

    Raises:
        CheckpointError: not a checkpoint, or one of another run.
    """
    state, tensors = _read(path, identity)
    moments: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith(_OPTIMIZER):
            number, entry = key.removeprefix(_OPTIMIZER).split(".")
            moments.setdefault(int(number), {})[entry] = value
    try:
        network.load_state_dict(
            {key.removeprefix(_NETWORK): value for key, value in tensors.items() if key.startswith(_NETWORK)}
        )
        optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})
        for key, value in average.items():
            value.copy_(tensors[_AVERAGE + key])
    except (RuntimeError, ValueError, KeyError):
        raise CheckpointError(f"{path}: of another network; choose another folder, or remove the file") from None
    return state


def _read(path: Path, identity: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """State and tensors of a checkpoint of the run of this identity."""
    try:
        with safe_open(path, framework="pt") as file:
            about = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
        saved_identity, state = json.loads(about["identity"]), json.loads(about["state"])
    except (SafetensorError, OSError, KeyError, json.JSONDecodeError):
        raise CheckpointError(f"{path}: not a checkpoint; remove the file to start anew") from None
    changed = _differences(saved_identity, json.loads(json.dumps(identity)))
    if changed:
        raise CheckpointError(
            f"{path}: of a run with another {', '.join(changed)}; choose another folder, or remove the file"
        )
    assert isinstance(state, dict)
    return state, tensors


def save_tensors(path: Path, tensors: dict[str, Tensor], about: dict[str, str]) -> None:
    """Write a safetensors file, whole or not at all."""
    content = save({key: value.detach().cpu().contiguous() for key, value in tensors.items()}, about)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def save_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text)


def _differences(saved: dict[str, Any], present: dict[str, Any]) -> list[str]:
    """Keys whose values differ; those of inner dictionaries are named by themselves."""
    changed = []
    for key in {**present, **saved}:
        before, now = saved.get(key), present.get(key)
        if before == now:
            continue
        if isinstance(before, dict) and isinstance(now, dict):
            changed += _differences(before, now)
        else:
            changed.append(key)
    return changed
