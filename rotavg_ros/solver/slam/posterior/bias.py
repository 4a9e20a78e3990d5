"""A constant turn that every step of odometry has too much, a gyroscope's bias β: what F makes of it.

A bias is taken out of the measured odometry before the graph is drawn together. What is left of it turns the residual
of a segment by D β in the world's frame (:func:`rotavg_ros.solver.slam.noise.gyro_bias.drift_per_bias`), so β is a
further unknown of the normal equations, with N(0, σ_β²) as its prior. Eliminating the corrections leaves

    S = Dᵀ W (D − J H⁻¹ Jᵀ W D) + 1/σ_β²,       −log p = |β|² / 2 σ_β² + d log σ_β + ½ log det S

(Laplace's method; d components that closures can tell). F is with it or without it, whichever is less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.slam.noise.gyro_bias import drift_per_bias
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.solver.slam.posterior.system import Factorised
from rotavg_ros.solver.slam.preparation import Prepared
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class Bias:
    """Of a graph with E edges.

    Attributes:
        rate: ``(d,)`` rad per step that was taken out, along the axes.
        axes: ``(d, 3)`` of the body that closures can tell: all three, or the one about which all turns are.
        design: ``(E, 3, d)`` D under the odometry's orientations; zero for closures.
    """

    rate: np.ndarray
    axes: np.ndarray
    design: np.ndarray

    @classmethod
    def of(cls, graph: ViewGraph, prepared: Prepared, vector: np.ndarray) -> Bias:
        """That of a graph whose odometry ``vector`` ``(3,)`` rad per step was taken out of before it was prepared."""
        closure_graph = prepared.closure_graph
        axes = np.eye(3)
        if prepared.noise.components == 1:
            turns = rotations.log(graph.target_from_source)
            axes = torch.linalg.eigh(turns.T @ turns)[1][:, -1:].numpy().T
        drift = drift_per_bias(graph, prepared.forest, closure_graph)[closure_graph.nodes] @ axes.T
        design = np.zeros((len(closure_graph.source), 3, len(axes)))
        segments = np.arange(closure_graph.num_segments)
        design[segments] = drift[closure_graph.target[segments]] - drift[closure_graph.source[segments]]
        return cls(axes @ vector, axes, design)

    @property
    def vector(self) -> np.ndarray:
        """``(3,)`` rad per step that was taken out."""
        return np.asarray(self.rate @ self.axes)

    def information(
        self, source: np.ndarray, state: State, residual: np.ndarray, factorised: Factorised, priors: SlamPriors
    ) -> tuple[np.ndarray, np.ndarray]:
        """S ``(d, d)`` and the bias ``(d,)`` rad per step by which F would fall most, beyond what was taken out.

        Args:
            source: ``(E,)`` key nodes of the edges.
            state: at its optimum.
            residual: ``(E + R, 3)`` rad, there.
            factorised: H there.
            priors: of σ_β.
        """
        num_edges, num_axes = len(source), len(self.axes)
        turned = rotations.to_matrix(torch.from_numpy(np.ascontiguousarray(state.correction.T))).numpy()[source]
        design = np.zeros((len(residual), 3, num_axes))
        design[:num_edges] = np.swapaxes(turned, 1, 2) @ self.design
        left = design.copy()
        for axis in range(num_axes):
            left[:, :, axis] -= factorised.system.rows @ factorised.fit(np.ascontiguousarray(design[:, :, axis]))
        weighted = design * factorised.weight[:, None, None]
        precision = np.radians(priors.bias_deg) ** -2
        information = np.einsum("rca,rcb->ab", weighted, left) + precision * np.eye(num_axes)
        slope = np.einsum("rca,rc->a", weighted, residual) - precision * self.rate
        return information, np.linalg.solve(information, slope)

    def cost(self, information: np.ndarray, priors: SlamPriors) -> float:
        """−log p of the bias, nats, the rest of S integrated."""
        sigma = np.radians(priors.bias_deg)
        occam = len(self.rate) * np.log(sigma) + np.linalg.slogdet(information)[1] / 2
        return float((self.rate**2).sum() / (2 * sigma**2) + occam)
