"""Draws posterior.png: what a closure is, by how far it is off; run it in the folder where the picture is to be."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from rotavg_ros.solver.slam.posterior.densities import log_false, log_good
from rotavg_ros.solver.slam.posterior.priors import SlamPriors

priors = SlamPriors()
figure = Figure(figsize=(10, 3.6), dpi=150, facecolor="white", layout="constrained")
angle = np.radians(np.linspace(0, 60, 600))
for axes, components, title in zip(figure.subplots(1, 2), (1, 3), ("in the plane", "in space"), strict=True):
    false = log_false(angle**2, components, priors)
    axes.plot(np.degrees(angle), false, color="#b3392f", label="false")
    for predicted_deg, style in ((0.0, "-"), (3.0, "--"), (10.0, ":")):
        variance = np.full(len(angle), np.radians(priors.closure_deg) ** 2)
        good = log_good(angle**2, variance, np.radians(predicted_deg) ** 2, components, priors)[0]
        label = f"good, predicted to {predicted_deg:g}°"
        axes.plot(np.degrees(angle), good, style, color="#2f6db3", label=label)
        flips = np.flatnonzero(np.diff(np.sign(good - false)))
        axes.plot(np.degrees(angle[flips]), good[flips], "o", color="#444444", markersize=4)
    axes.set_ylim(-14, 1.05 * float(good.max()) + 9)
    axes.set_xlabel("leave-one-out discrepancy of a closure, degrees")
    axes.set_ylabel("log density, nats")
    axes.set_title(title)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
figure.savefig("posterior.png")
