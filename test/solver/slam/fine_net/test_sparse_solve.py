"""The sparse solve's gradient against torch's own through a dense solve, and against differences."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rotavg_ros.solver.slam.fine_net.sparse_solve import sparse_solve
from rotavg_ros.solver.slam.posterior.system import NormalEquations


def system_of(seed: int) -> tuple[NormalEquations, torch.Tensor, torch.Tensor]:
    """A chain of 8 nodes, 7 further edges, two runs of them; weights and residuals of all rows."""
    rng = np.random.default_rng(seed)
    source = np.concatenate((np.arange(7), rng.integers(0, 8, 7)))
    target = np.concatenate((np.arange(1, 8), rng.integers(0, 8, 7)))
    target[7:] = np.where(target[7:] == source[7:], (target[7:] + 3) % 8, target[7:])
    run = np.concatenate((np.full(7, -1), [0, 0, 0, 1, 1, -1, -1]))
    sign = np.where(run >= 0, rng.choice([-1.0, 1.0], 14), 0.0)
    equations = NormalEquations(8, source, target, run, sign, np.array([0]))
    rows = equations.rows.shape[0]
    return equations, torch.from_numpy(rng.uniform(0.5, 40.0, rows)), torch.from_numpy(rng.normal(size=(rows, 3)))


def dense(equations: NormalEquations, weight: torch.Tensor, residual: torch.Tensor) -> torch.Tensor:
    """The same with the root's column left out."""
    rows = torch.from_numpy(equations.rows.toarray()[:, 1:])
    solved = torch.linalg.solve(rows.T @ (weight[:, None] * rows), rows.T @ (weight[:, None] * residual))
    return torch.cat((torch.zeros(1, residual.shape[1], dtype=torch.float64), solved))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_values_and_gradients_are_those_of_a_dense_solve(seed: int) -> None:
    equations, weight, residual = system_of(seed)
    at = torch.from_numpy(np.random.default_rng(seed + 1).normal(size=(equations.size, 3)))
    found = []
    for solve in (sparse_solve, dense):
        weight = weight.detach().clone().requires_grad_()
        step = solve(equations, weight, residual)
        loss = (at * step).sum() + (step**2).sum()
        loss.backward()  # type: ignore[no-untyped-call]
        assert weight.grad is not None
        found.append((step.detach(), weight.grad))
    for ours, other in zip(*found, strict=True):
        torch.testing.assert_close(ours, other, rtol=1e-6, atol=1e-8)


def test_gradient_is_the_limit_of_differences() -> None:
    equations, weight, residual = system_of(3)
    assert torch.autograd.gradcheck(
        lambda log_weight: sparse_solve(equations, log_weight.exp(), residual), (weight.log().requires_grad_(),)
    )
