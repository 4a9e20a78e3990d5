"""The term of F for systematic errors that all measurements of a kind share.

A gyroscope's bias β turns every step of odometry too far, and a mounting error c of the sensor affects every closure
(:mod:`rotavg_ros.solver.slam.noise.gyro_bias`, :mod:`rotavg_ros.solver.slam.noise.mounting`). Both are removed from the
measurements before the graph is contracted. The remainder of p = (β, c) turns the residual of an edge by D p in the
world's frame, so p is a further unknown of the normal equations, with prior N(0, Σ). A sensor is either mounted about
as stated, with the accuracy of a closure, or in any orientation; the likelier of the two at c is used, so that the
components of a small c that closures do not determine stay small. Eliminating the corrections leaves

    S = Dᵀ W (D − J H⁻¹ Jᵀ W D) + Σ⁻¹,       −log p = ½ pᵀ Σ⁻¹ p + ½ log det Σ + ½ log det S

(Laplace's method). F is the least of the values with either, both or none of them.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.slam.noise.calibration import Calibration
from rotavg_ros.solver.slam.noise.gyro_bias import drift_per_bias
from rotavg_ros.solver.slam.noise.mounting import ANY_TURN, is_about_as_said, turned_per_mounting
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.solver.slam.posterior.system import Factorised
from rotavg_ros.solver.slam.preparation import Prepared
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class Calibrated:
    """The calibration of a graph with E edges.

    Attributes:
        calibration: what was removed.
        axes: ``(d, 6)`` axes of :attr:`Calibration.vector` that closures can determine: all three of each part, or for
            the bias only the one axis of all turns.
        design: ``(E, 3, d)`` D under the odometry's orientations; zero where a part turns no edge.
    """

    calibration: Calibration
    axes: np.ndarray
    design: np.ndarray

    @classmethod
    def of(cls, graph: ViewGraph, prepared: Prepared, calibration: Calibration, parts: Collection[str]) -> Calibrated:
        """Some parts, for a graph from whose measurements ``calibration`` was removed before it was prepared."""
        is_planar = prepared.noise.components == 1
        nothing = np.zeros((0, 6)), np.zeros((len(prepared.closure_graph.source), 3, 0))
        found = [nothing]
        if "bias" in parts:
            found.append(_of_bias(graph, prepared, is_planar, calibration.axis))
        if "mounting" in parts and not is_planar:
            found.append(_of_mounting(graph, prepared))
        axes, design = (
            np.concatenate(each, axis=axis) for axis, each in zip((0, -1), zip(*found, strict=True), strict=True)
        )
        return cls(calibration, axes, design)

    @property
    def value(self) -> np.ndarray:
        """``(d,)`` rad per step or rad that was removed, along the axes."""
        return np.asarray(self.axes @ self.calibration.vector)

    def precision(self, priors: SlamPriors) -> np.ndarray:
        """``(d,)`` diagonal of Σ⁻¹."""
        is_bias = self.axes[:, :3].any(axis=1)
        near = np.radians(priors.closure_deg)
        of_mounting = near**-2 if is_about_as_said(self.calibration.mounting, near) else 1 / ANY_TURN
        return np.asarray(np.where(is_bias, np.radians(priors.bias_deg) ** -2, of_mounting))

    def information(
        self, source: np.ndarray, state: State, residual: np.ndarray, factorised: Factorised, priors: SlamPriors
    ) -> tuple[np.ndarray, np.ndarray]:
        """S ``(d, d)`` and the p ``(d,)`` that minimises F, beyond what was removed.

        Args:
            source: ``(E,)`` source key nodes of the edges.
            state: the state at its optimum.
            residual: ``(E + R, 3)`` rad, there.
            factorised: H there.
            priors: give Σ.
        """
        num_edges, num_axes = len(source), len(self.axes)
        turned = rotations.to_matrix(torch.from_numpy(np.ascontiguousarray(state.correction.T))).numpy()[source]
        design = np.zeros((len(residual), 3, num_axes))
        design[:num_edges] = np.swapaxes(turned, 1, 2) @ self.design
        left = design.copy()
        for axis in range(num_axes):
            left[:, :, axis] -= factorised.system.rows @ factorised.fit(np.ascontiguousarray(design[:, :, axis]))
        weighted = design * factorised.weight[:, None, None]
        precision = self.precision(priors)
        information = np.einsum("rca,rcb->ab", weighted, left) + np.diag(precision)
        slope = np.einsum("rca,rc->a", weighted, residual) - precision * self.value
        return information, np.linalg.solve(information, slope)

    def cost(self, information: np.ndarray, priors: SlamPriors) -> float:
        """−log p, nats, with the remainder of p integrated."""
        precision = self.precision(priors)
        occam = (np.linalg.slogdet(information)[1] - np.log(precision).sum()) / 2
        either = np.log(2) * bool(self.axes[:, 3:].any())
        return float((precision * self.value**2).sum() / 2 + occam + either)


def _of_bias(
    graph: ViewGraph, prepared: Prepared, is_planar: bool, axis: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Axes ``(d, 6)`` and design ``(E, 3, d)``."""
    closure_graph = prepared.closure_graph
    axes = np.eye(3)
    if is_planar:
        turns = rotations.log(graph.target_from_source[graph.tells_dimension])
        axes = torch.linalg.eigh(turns.T @ turns)[1][:, -1:].numpy().T
    elif axis is not None:
        axes = axis[None]
    drift = drift_per_bias(graph, prepared.forest, closure_graph)[closure_graph.nodes] @ axes.T
    design = np.zeros((len(closure_graph.source), 3, len(axes)))
    segments = np.arange(closure_graph.num_segments)
    design[segments] = drift[closure_graph.target[segments]] - drift[closure_graph.source[segments]]
    return np.concatenate((axes, np.zeros_like(axes)), axis=1), design


def _of_mounting(graph: ViewGraph, prepared: Prepared) -> tuple[np.ndarray, np.ndarray]:
    """The same for the mounting, which has three axes."""
    closure_graph = prepared.closure_graph
    edge = np.flatnonzero(closure_graph.is_closure)
    source = torch.from_numpy(closure_graph.nodes[closure_graph.source[edge]])
    measured = graph.target_from_source[closure_graph.view_graph_edge[edge - closure_graph.num_segments]]
    world_from_source = rotations.to_matrix(rotations.inverse(closure_graph.odometry_orientation[source])).numpy()
    design = np.zeros((len(closure_graph.source), 3, 3))
    design[edge] = world_from_source @ turned_per_mounting(measured)
    return np.eye(6)[3:], design
