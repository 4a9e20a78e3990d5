"""Warnings for the user about a labelling: large slips, and a sensor mounted differently from what is stated."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.slam.posterior.left_out import slipped_or_tailed
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.wording import between_nodes

# Slips of more than this, rad, are reported.
_FAR_SLIP = np.radians(10.0)


def notes_of(mode: Mode, suspected: np.ndarray | None = None) -> tuple[str, ...]:
    """Warnings about large slips, and about a sensor that is, or may be, mounted differently from what is stated.

    Args:
        mode: the labelling.
        suspected: ``(3,)`` rad, apparent rotation between the axes of closures and odometry that was not corrected.
    """
    return (*_of_slips(mode), *_of_mounting(mode), *_of_suspected(suspected))


def _of_slips(mode: Mode) -> tuple[str, ...]:
    """A sentence about large slips in a labelling, or none."""
    graph, off = mode.problem.graph, slipped_or_tailed(mode.problem, mode.state, mode.left_out)
    turned = np.sqrt((mode.evaluation.residual[off] ** 2).sum(axis=1))
    far = off[turned > _FAR_SLIP]
    if len(far) == 0:
        return ()
    largest = off[int(turned.argmax())]
    first, last = sorted((int(graph.nodes[graph.source[largest]]), int(graph.nodes[graph.target[largest]])))
    times = "once" if len(far) == 1 else f"{len(far)} times"
    slipped = (
        f"Odometry seems to have slipped {times}, by up to {np.degrees(turned.max()):.0f}° "
        f"({between_nodes(first, last)})"
    )
    if bool(graph.is_odometry.all()):
        return (f"{slipped}: other odometry between the same nodes disagrees with it, so one of the two is wrong.",)
    remedy = "label the closures that you know"
    if "slips" not in mode.problem.without:
        remedy = f"solve without slips (neurora~slips), or {remedy}"
    elif "tails" not in mode.problem.without:
        remedy = f"solve without tails of its noise as well (neurora~slips,tails), or {remedy}"
    return (
        f"{slipped}: closures agree on that. False closures in a building that looks the same after a turn would agree "
        f"in the same way: if no step of the odometry can be off by that much, {remedy}.",
    )


def _of_mounting(mode: Mode) -> tuple[str, ...]:
    """A sentence about the estimated mounting of the closures' sensor where it differs from the stated one, or none."""
    calibrated = mode.problem.calibrated
    mounting = np.zeros(3) if calibrated is None else calibrated.calibration.mounting
    if not mounting.any():
        return ()
    about_one = mode.problem.components == 1
    unknown = " (a further turn about the axis that all rotations share cannot be seen)" if about_one else ""
    return (
        f"Closures agree if their sensor is mounted {np.degrees(np.linalg.norm(mounting)):.0f}° differently from what "
        f"is stated: its orientation in the body's frame is then {_in_body(mounting)}{unknown}. The answer assumes "
        "that. If the sensor is mounted so, set edge_sensor_orientations to this orientation times the one that is set "
        "now, or correct the transform or the edges. If it is not, solve without this correction (neurora~mounting).",
    )


def _of_suspected(mounting: np.ndarray | None) -> tuple[str, ...]:
    """A sentence about an apparent, uncorrected rotation between the axes of closures and odometry, or none."""
    if mounting is None:
        return ()
    degrees = np.degrees(np.linalg.norm(mounting))
    return (
        f"Closures and odometry seem to turn about axes that differ by {degrees:.0f}°. Nothing was corrected, because "
        "odometry's own axes may be wrong. If instead the closures' sensor is mounted differently from what is stated, "
        f"its orientation in the body's frame is {_in_body(mounting)}: set edge_sensor_orientations to this "
        "orientation times the one that is set now, or correct the transform or the edges.",
    )


def _in_body(mounting: np.ndarray) -> str:
    """The sensor's orientation in the body's frame, in words."""
    quaternion = rotations.exp(torch.from_numpy(-mounting)).tolist()
    return "x, y, z, w = " + ", ".join(f"{component:.4f}" for component in quaternion)
