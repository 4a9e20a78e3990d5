"""A pose graph that is played edge by edge."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.evaluation.common.scoring import score
from rotavg_ros.evaluation.live import incremental

from ..laps import NUM_NODES, answer_of, spoiled


def test_incremental_run_ends_like_the_batch_solve() -> None:
    case = spoiled()
    run = incremental.play(case)
    assert run.keyframes.tolist() == list(range(10, NUM_NODES + 1, 10))
    assert run.false_seen[-1] == case.is_false.sum()
    assert run.good_seen[-1] == case.is_good.sum()
    batch = score(case, "neurora", answer_of("neurora", case))
    assert run.error_deg[-1] == pytest.approx(batch.mean_deg, abs=0.1)
    assert np.isnan(run.worst_excess_deg)  # a short run settles nothing
