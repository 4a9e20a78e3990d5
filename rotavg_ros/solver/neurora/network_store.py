"""The trained networks that come with the package: safetensors files with a model card beside each, never unpickled."""

from __future__ import annotations

import functools
import json
from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TypeVar, cast

import torch
from safetensors import SafetensorError, safe_open
from torch import nn

from rotavg_ros.errors import UserError, asking_about

# Incremented when a network's definition changes so that older weights no longer fit it.
ARCHITECTURE_VERSION = "1"
WEIGHTS_FOLDER = Path(__file__).parents[1] / "weights"
_REMEDY = "reinstall the package or train it with `rotavg train`"


class WeightsError(UserError):
    """Weights that cannot be used; the message names the file and the remedy."""


class StoredNetwork(nn.Module):
    """A network whose weights are kept in a file.

    Attributes:
        NAME: of the file, without its extension.
    """

    NAME: ClassVar[str]


Network = TypeVar("Network", bound=StoredNetwork)


@dataclass(frozen=True)
class Networks:
    """The device on which networks run, and the folder that holds the user's own."""

    device: str
    folder: Path | None = None

    def load(self, kind: type[Network]) -> Network:
        """The user's network if there is one of this kind, else the package's."""
        if self.folder is not None and (self.folder / f"{kind.NAME}.safetensors").exists():
            return load_network(kind, self.device, self.folder)
        return load_network(kind, self.device)


def check_folder(folder: Path) -> None:
    """Check that a user's folder has a network; otherwise the package's networks would be used without a word.

    Raises:
        WeightsError: the folder has none.
    """
    names = sorted(path.name for path in WEIGHTS_FOLDER.glob("*.safetensors"))
    with asking_about(folder, WeightsError):
        has_any = any((folder / name).is_file() for name in names)
    if not has_any:
        raise WeightsError(
            f"{folder}: has no weights ({', '.join(names)}); `rotavg train` writes them into its --output"
        )


def metadata(name: str) -> dict[str, str]:
    """Metadata of a weights file."""
    return {"network": name, "architecture_version": ARCHITECTURE_VERSION}


def load_network(kind: type[Network], device: str = "cpu", folder: Path = WEIGHTS_FOLDER) -> Network:
    """A network in evaluation mode; loaded once per process, folder and device.

    Raises:
        WeightsError: the file is missing, damaged, of another network or of another version.
    """
    return cast(Network, _load(cast(Hashable, kind), device, folder))


def forget_networks() -> None:
    """Read all files again when their networks are next asked for."""
    _load.cache_clear()


@functools.cache
def _load(kind: type[StoredNetwork], device: str, folder: Path) -> StoredNetwork:
    return read_network(kind, folder / f"{kind.NAME}.safetensors").to(device)


def read_network(kind: type[Network], path: Path) -> Network:
    """A network with the weights in a file, in evaluation mode and without gradients.

    Raises:
        WeightsError: as :func:`load_network`.
    """
    name, network = kind.NAME, kind()
    if path.is_dir():
        raise WeightsError(f"{path}: is a folder, need {name}.safetensors; {_REMEDY}")
    try:
        with safe_open(path, framework="pt") as file:
            stated = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
    except FileNotFoundError:  # safetensors raises this also for a file without permission
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
