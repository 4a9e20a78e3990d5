from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch


@pytest.fixture(autouse=True)
def _keep_threads() -> Iterator[None]:
    """Commands with --threads set them for the whole process."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)
