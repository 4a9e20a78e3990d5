"""Some of many, evenly spread."""

from __future__ import annotations

import numpy as np


def evenly(values: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` of values ``(n,)``, evenly spread over their order, the first and the last among them."""
    if len(values) <= most:
        return values
    return np.asarray(values[np.linspace(0, len(values) - 1, most).astype(np.int64)])
