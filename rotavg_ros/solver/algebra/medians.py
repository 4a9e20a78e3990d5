"""Medians and other quantiles of many groups at once."""

from __future__ import annotations

import torch
from torch import Tensor


def median_by_group(value: Tensor, group: Tensor, num_groups: int) -> Tensor:
    """Lower median (torch's) ``(num_groups,)`` of the values ``(M,)`` of each group; infinite for an empty group."""
    if num_groups == 1 and len(value):
        return value.median()[None]
    return quantile_by_group(value, group, torch.full((num_groups,), 0.5, dtype=torch.float64, device=value.device))


def quantile_by_group(value: Tensor, group: Tensor, share: Tensor) -> Tensor:
    """Lower quantiles ``(G,)`` of the values ``(M,)`` of each group; infinite for an empty group.

    Args:
        share: ``(G,)`` share of each group's values below its quantile, from 0 to 1.
    """
    by_value = value.sort()
    by_group = group[by_value.indices].sort(stable=True).indices
    count = torch.bincount(group, minlength=len(share))
    last = (count - 1).clamp(min=0)
    chosen = count.cumsum(0) - count + (share * last).long()
    ordered = torch.cat((by_value.values[by_group], value.new_full((1,), torch.inf)))
    return torch.where(count > 0, ordered[chosen], torch.inf)
