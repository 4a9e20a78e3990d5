"""The trained networks that come with the package: safetensors files with a model card beside each, never unpickled."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import nn

from rotavg_ros.errors import UserError
from rotavg_ros.solver.clean_net import CleanNet
from rotavg_ros.solver.fine_net import FineNet
from rotavg_ros.solver.slam_clean_net import SlamCleanNet

# Raised when a network's definition changes so that older weights no longer fit it.
ARCHITECTURE_VERSION = "1"
WEIGHTS_FOLDER = Path(__file__).parent / "weights"
_REMEDY = "reinstall the package or train it with `rotavg train`"

NETWORKS: dict[str, type[nn.Module]] = {
    "sfm-clean-net": CleanNet,
    "sfm-fine-net": FineNet,
    "slam-clean-net": SlamCleanNet,
}


class WeightsError(UserError):
    """Weights that cannot be used; the message names the file and the remedy."""


def metadata(name: str) -> dict[str, str]:
    """What a weights file says of itself."""
    return {"network": name, "architecture_version": ARCHITECTURE_VERSION}


@functools.cache
def load_network(name: str, device: str = "cpu", folder: Path = WEIGHTS_FOLDER) -> nn.Module:
    """A network in evaluation mode; loaded once per process and device.

    Raises:
        WeightsError: the file is missing, damaged, of another network or of another version.
    """
    return read_network(name, folder / f"{name}.safetensors").to(device)


def read_network(name: str, path: Path) -> nn.Module:
    """A network with the weights in a file, in evaluation mode and without gradients.

    Raises:
        WeightsError: as :func:`load_network`.
    """
    network = NETWORKS[name]()
    if path.is_dir():
        raise WeightsError(f"{path}: is a folder, need {name}.safetensors; {_REMEDY}")
    try:
        with safe_open(path, framework="pt") as file:
            stated = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
    except FileNotFoundError:  # safetensors' word for a file without permission, too
        if path.exists():
            raise WeightsError(f"{path}: permission denied; check the file's rights") from None
        raise WeightsError(f"{path}: missing; {_REMEDY}") from None
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: damaged ({error}); {_REMEDY}") from None
    if stated != metadata(name):
        raise WeightsError(f"{path}: holds {json.dumps(stated)}, need {json.dumps(metadata(name))}; {_REMEDY}")
    try:
        network.load_state_dict(tensors)
    except RuntimeError:
        raise WeightsError(f"{path}: the tensors do not fit {name}; {_REMEDY}") from None
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
        raise WeightsError(f"{path}: contains values that are not finite; {_REMEDY}")
    for parameter in network.parameters():
        parameter.requires_grad_(False)
    return network.eval()
