"""Medians of many groups at once."""

from __future__ import annotations

import torch
from torch import Tensor


def median_by_group(value: Tensor, group: Tensor, num_groups: int) -> Tensor:
    """Lower median (torch's) ``(num_groups,)`` of the values ``(M,)`` of each group; infinite where there are none."""
    if num_groups == 1 and len(value):
        return value.median()[None]
    by_value = value.sort()
    by_group = group[by_value.indices].sort(stable=True).indices
    count = torch.bincount(group, minlength=num_groups)
    middle = count.cumsum(0) - count + (count - 1).clamp(min=0) // 2
    ordered = torch.cat((by_value.values[by_group], value.new_full((1,), torch.inf)))
    return torch.where(count > 0, ordered[middle], torch.inf)
