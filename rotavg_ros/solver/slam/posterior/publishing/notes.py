"""What is to be known of a labelling, in sentences."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.slam.posterior.left_out import slipped_or_tailed
from rotavg_ros.solver.slam.posterior.mode import Mode

# Odometry that slipped by more than this, rad, is worth a word.
_FAR_SLIP = np.radians(10.0)
# A mounting that differs by less, rad, is worth no word.
_WORTH_A_WORD = np.radians(1.0)


def notes_of(mode: Mode) -> tuple[str, ...]:
    """Slips of the odometry by far, and a sensor that is mounted otherwise than said."""
    return (*_of_slips(mode), *_of_mounting(mode))


def _of_slips(mode: Mode) -> tuple[str, ...]:
    """What is to be known of a labelling by which odometry is off by far somewhere: a sentence, or none."""
    graph, off = mode.problem.graph, slipped_or_tailed(mode.problem, mode.state, mode.left_out)
    turned = np.sqrt((mode.evaluation.residual[off] ** 2).sum(axis=1))
    far = off[turned > _FAR_SLIP]
    if len(far) == 0:
        return ()
    largest = off[int(turned.argmax())]
    first, last = sorted((int(graph.nodes[graph.source[largest]]), int(graph.nodes[graph.target[largest]])))
    times = "once" if len(far) == 1 else f"{len(far)} times"
    return (
        f"Odometry is held to have slipped {times}, the farthest by {np.degrees(turned.max()):.0f}° between nodes "
        f"{first} and {last}, because closures agree that it has. In a building that looks alike turned false closures "
        "agree so, too: if no step of the odometry can be off by that much, solve without slips (neurora~slips), or "
        "label the closures that you know.",
    )


def _of_mounting(mode: Mode) -> tuple[str, ...]:
    """How closures' sensor is held to be mounted otherwise than said: a sentence, or none."""
    calibrated = mode.problem.calibrated
    mounting = np.zeros(3) if calibrated is None else calibrated.calibration.mounting
    degrees = float(np.degrees(np.linalg.norm(mounting)))
    if np.radians(degrees) < _WORTH_A_WORD:
        return ()
    body_from_sensor = rotations.exp(torch.from_numpy(-mounting)).tolist()
    quaternion = ", ".join(f"{component:.4f}" for component in body_from_sensor)
    about_one = mode.problem.components == 1
    unknown = " (and by any turn about the axis of all turns, which none of them tells)" if about_one else ""
    return (
        f"Closures agree once their sensor is held to be mounted {degrees:.0f}° otherwise than said: its orientation "
        f"in the body's frame is x, y, z, w = {quaternion}{unknown}. The answer is as if edges had been turned so; if "
        "that is how the sensor sits, set edge_sensor_orientations to it, times what it is now, or mend the transform "
        "or the edges. If it is not, solve without (neurora~mounting).",
    )
