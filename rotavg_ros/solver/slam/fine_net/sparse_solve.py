"""The sparse solve as a function of its weights that torch can differentiate.

With H = Jᵀ W J and δ = H⁻¹ Jᵀ W r, a change dw_e of one weight gives dδ = H⁻¹ j_e (r_e − j_eᵀ δ) dw_e (implicit
differentiation of H δ = Jᵀ W r). So the gradient of a loss, given its gradient g at δ, is

    dL/dw_e = (J H⁻¹ g)_e · (r_e − (J δ)_e)

which takes one more solve with the existing factor, for all weights together.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rotavg_ros.solver.slam.posterior.system import NormalEquations


class _SparseSolve(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weight: Tensor, system: NormalEquations, residual: Tensor) -> Tensor:
        factorised = system.factorise(weight.detach().numpy())
        step = factorised.fit(residual.numpy())
        ctx.factorised, ctx.left = factorised, residual.numpy() - system.rows @ step
        return torch.from_numpy(step)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        adjoint = ctx.factorised.system.rows @ ctx.factorised.solve(gradients[0].numpy())
        return torch.from_numpy((adjoint * ctx.left).sum(axis=1)), None, None


def sparse_solve(system: NormalEquations, weight: Tensor, residual: Tensor) -> Tensor:
    """The least-squares solution δ ``(K + R, k)``.

    Args:
        system: the rows J.
        weight: ``(E + R,)`` float64, positive; differentiable.
        residual: ``(E + R, k)`` float64, constant.
    """
    step: Tensor = _SparseSolve.apply(weight, system, residual)  # type: ignore[no-untyped-call]
    return step
