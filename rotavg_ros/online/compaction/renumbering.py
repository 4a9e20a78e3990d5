"""What a compaction of the graph does to indices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True)
class Renumbering:
    """From N nodes and M edges to N' and M'. The order is kept, so the first n of either remain the first.

    Attributes:
        kept: ``(N',)`` the nodes that are left, ascending.
        edge_of: ``(M,)`` the edge that each edge has become a part of, -1 for dropped ones.
        last: ``(M',)`` the last edge that each edge consists of, ascending.
        num_dropped: closures that were dropped.
    """

    kept: NDArray[np.int64]
    edge_of: NDArray[np.int64]
    last: NDArray[np.int64]
    num_dropped: int

    def nodes(self, values: Tensor) -> Tensor:
        """Values of the first n nodes ``(n, …)``, restricted to those that are left ``(n', …)``."""
        left = self.kept[: int(np.searchsorted(self.kept, len(values)))]
        return values[torch.from_numpy(left)]

    def flags(self, flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Flags of the first m edges ``(m,)``: an edge is flagged if one of its parts was."""
        flagged = np.zeros(int(np.searchsorted(self.last, len(flags))), dtype=bool)
        parts = self.edge_of[: len(flags)][flags]
        flagged[parts[(parts >= 0) & (parts < len(flagged))]] = True
        return flagged

    def then(self, later: Renumbering) -> Renumbering:
        """Both, one after the other, as one renumbering of the nodes and edges before the first."""
        edge_of = np.where(self.edge_of >= 0, later.edge_of[self.edge_of], -1)
        return Renumbering(
            self.kept[later.kept[later.kept < len(self.kept)]],
            edge_of,
            self.last[later.last[later.last < len(self.last)]],
            self.num_dropped + later.num_dropped,
        )
