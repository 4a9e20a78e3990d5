"""Draws markers.png: what ~/markers show of a simulated run, from its replay; run it in the folder of the picture.

rotavg simulate --laps 4 --seed 5 --output run && rotavg replay run --output replayed
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from rosbags.highlevel import AnyReader

with AnyReader([Path("replayed/run.mcap")]) as bag:
    topics = [each for each in bag.connections if each.topic.endswith("/markers")]
    for connection, _, content in bag.messages(topics):
        markers = bag.deserialize(content, connection.msgtype).markers
keyframes, lines = markers
xy = np.array([(point.x, point.y) for point in lines.points]).reshape(-1, 2, 2)
colors = np.array([(each.r, each.g, each.b, each.a) for each in lines.colors])[::2]
figure = Figure(figsize=(9, 5), dpi=130, facecolor="#303030", layout="constrained")
axes = figure.subplots()
axes.set_facecolor("#303030")
is_red = colors[:, 0] > 0.5
for chosen, width in ((~is_red, 0.8), (is_red, 1.2)):
    axes.add_collection(LineCollection(xy[chosen], colors=colors[chosen], linewidths=width))
dots = np.array([(point.x, point.y) for point in keyframes.points])
blue = (keyframes.color.r, keyframes.color.g, keyframes.color.b)
axes.scatter(dots[:, 0], dots[:, 1], s=6, color=np.clip(np.array(blue) * 1.4, 0, 1), zorder=3)
axes.set_aspect("equal")
axes.grid(color="#606060", linewidth=0.4)
axes.tick_params(colors="#c0c0c0")
axes.spines[:].set_color("#606060")
figure.savefig("markers.png")
