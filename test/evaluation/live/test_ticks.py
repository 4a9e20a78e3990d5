"""Ticks beside iSAM2."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.evaluation.live import ticks
from rotavg_ros.metrics import body_from_world, orientation_errors
from rotavg_ros.solver import solve


@pytest.mark.large
def test_errors_are_those_of_every_other_page() -> None:
    """After one robust rotation; after the first keyframe's alignment they are three times as large on this drive."""
    pytest.importorskip("gtsam")
    drive = ticks.Drive(keyframes=300, ticks=3)
    rows = ticks.run(drive)
    run = drive.simulated()
    batch = orientation_errors(solve(run.graph).body_from_world, body_from_world(run.world_from_body))
    for row in rows:
        assert row.error_deg == pytest.approx(np.degrees(float(batch.mean())), rel=0.1), row.name
        assert len(row.answer_ms) == 3 and (row.answer_ms > 0).all(), row.name
    assert "after one robust global rotation" in ticks.table(rows).to_markdown()
