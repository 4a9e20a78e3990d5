"""Preconditioned conjugate gradients (Hestenes & Stiefel 1952), for several systems at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from rotavg_ros.solver.running.work import stop_if_abandoned


class Systems(Protocol):
    """How vectors are divided into the S systems that are solved at once."""

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """Inner products ``(S,)``."""

    def largest(self, x: Tensor) -> Tensor:
        """Largest absolute entries ``(S,)``, or ``(1,)`` where all systems end together."""

    def spread(self, value: Tensor) -> Tensor:
        """One number per system ``(S,)`` → a factor for vectors."""


class Stop(NamedTuple):
    """When iterations end.

    Attributes:
        tolerance: largest entry of the preconditioned residual, in the unknowns' unit.
        relative_tolerance: the same, as a share of its value at zero; the larger of the two counts.
        max_iterations: largest number of iterations.
    """

    tolerance: float
    relative_tolerance: float
    max_iterations: int


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    right_hand_side: Tensor,
    systems: Systems,
    stop: Stop,
) -> tuple[Tensor, Tensor | None]:
    """``L⁻¹ b``, and which systems ``(S,)`` meet the tolerance; None: all do, so that nobody waits for an accelerator.

    Args:
        product, precondition: ``L x`` and ``M⁻¹ x`` of vectors like ``b``; L positive semidefinite, M near L.
        right_hand_side: ``b``, of any shape that ``systems`` can divide.
    """
    solution, residual = torch.zeros_like(right_hand_side), right_hand_side.clone()
    scaled = precondition(residual)
    largest = systems.largest(scaled)
    goal = (stop.relative_tolerance * largest).clamp(min=stop.tolerance)
    direction, energy = scaled.clone(), systems.dot(residual, scaled)
    for _ in range(stop.max_iterations):
        stop_if_abandoned()
        is_open = ~(largest <= goal)  # numbers that are not finite meet nothing
        if not bool(is_open.any()):
            return solution, None
        image = product(direction)
        # A system that is solved to the last bit has no curvature: it would be 0/0.
        curvature = systems.dot(direction, image)
        length = systems.spread(torch.where(is_open & (curvature > 0), energy / curvature, 0.0))
        solution.addcmul_(length, direction)
        residual.addcmul_(length, image, value=-1)
        scaled = precondition(residual)
        largest = systems.largest(scaled)
        previous, energy = energy, systems.dot(residual, scaled)
        ratio = systems.spread(torch.where(previous > 0, energy / previous, 0.0))
        direction = torch.addcmul(scaled, ratio, direction)
    return solution, largest <= goal
