"""Records everything that the node would have published into one MCAP file, on the bag's clock."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from types import TracebackType

import numpy as np

from rotavg_ros.bags import answer_messages as messages
from rotavg_ros.bags.writer import BagWriter
from rotavg_ros.inputs import OdometryRecord
from rotavg_ros.online import Answer, OnlineEstimator
from rotavg_ros.online.answer.drawing import draw
from rotavg_ros.settings.parameters import NODE_NAME, NodeParameters
from rotavg_ros.version import __version__
from rotavg_ros.view_graph import EdgeKind

_DIAGNOSTICS_PERIOD_NS = 1_000_000_000
_RECENT_TICKS = 1000
_OK, _WARN = 0, 1


class Recording:
    """The unfinished file; it gets its name when the ``with`` block ends without an error.

    Args:
        path: of the file.
        parameters: of the node.
        estimator: whose answers these are.
        answer_period_ns: least bag time between recorded answers, since they grow with the run; the last one is always
            recorded.

    Raises:
        BagWriteError: the place cannot be written.
    """

    def __init__(
        self, path: Path, parameters: NodeParameters, estimator: OnlineEstimator, answer_period_ns: int
    ) -> None:
        self._path = path
        self._bag = BagWriter(path.with_suffix(""), compressed=True)
        self._parameters, self._estimator = parameters, estimator
        self._frame_id = parameters.world_frame
        self._answer_period_ns = answer_period_ns
        self._next_answer_ns = self._next_diagnostics_ns = 0
        self._tick_seconds: deque[float] = deque(maxlen=_RECENT_TICKS)
        self._answer: Answer | None = None
        self._prefix = {robot: f"/{prefix}" for robot, prefix in parameters.prefixes().items()}

    def __enter__(self) -> Recording:
        self._bag.__enter__()
        add = self._bag.add_topic
        add("/abs_orientations", messages.ORIENTATIONS, latched=True)
        add("/outlier_flags", messages.FLAGS, latched=True)
        add(f"/{NODE_NAME}/markers", messages.MARKERS, latched=True)
        add("/diagnostics", messages.DIAGNOSTICS)
        for prefix in self._prefix.values():
            add(f"{prefix}orientation", messages.ORIENTATION)
            add(f"{prefix}corrected_path", messages.PATH, latched=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bag.__exit__(kind, error, trace)
        if error is None:
            folder = self._path.with_suffix("")
            (folder / self._path.name).replace(self._path)
            (folder / "metadata.yaml").unlink()
            folder.rmdir()

    def orientation(self, time_ns: int, robot: str, odometry: OdometryRecord) -> None:
        """Record the corrected orientation at an odometry message."""
        orientation = self._estimator.current_orientation(robot)
        if orientation is not None:
            message = messages.orientation_message(odometry.stamp_ns, orientation, self._frame_id)
            self._bag.write(f"{self._prefix[robot]}orientation", time_ns, message)

    def answer(self, time_ns: int, answer: Answer, *, is_last: bool = False) -> None:
        """Record an answer, unless the previous one was recorded less than a period ago."""
        self._tick_seconds.append(answer.seconds)
        self._answer = answer
        if time_ns < self._next_answer_ns and not is_last:
            return
        self._next_answer_ns = time_ns + self._answer_period_ns
        self._bag.write("/abs_orientations", time_ns, messages.orientations_message(answer, self._frame_id))
        self._bag.write("/outlier_flags", time_ns, messages.flags_message(answer, self._frame_id))
        trajectories = self._estimator.trajectories(answer)
        for robot, trajectory in trajectories.items():
            if robot in self._prefix:
                path = messages.path_message(trajectory, self._frame_id)
                self._bag.write_bulk(f"{self._prefix[robot]}corrected_path", time_ns, path)
        drawing = draw(answer, trajectories.values())
        self._bag.write_bulk(f"/{NODE_NAME}/markers", time_ns, messages.markers_message(drawing, self._frame_id))

    def diagnostics(self, time_ns: int) -> None:
        """Record diagnostics once a second, without those that only a live node has (latencies, lost messages)."""
        if time_ns < self._next_diagnostics_ns:
            return
        self._next_diagnostics_ns = time_ns + _DIAGNOSTICS_PERIOD_NS
        answer, counts = self._answer, self._estimator.counts()
        closures = np.zeros(0, dtype=bool) if answer is None else answer.outlier[answer.kind == EdgeKind.LOOP_CLOSURE]
        p50, p95 = np.percentile(list(self._tick_seconds) or [np.nan], [50, 95]) * 1e3
        values = {
            "keyframes": str(counts.keyframes),
            "edges": str(counts.edges),
            "loop closures": str(len(closures)),
            "outliers": str(int(closures.sum())),
            "components": str(0 if answer is None else answer.num_components),
            "pending": str(counts.pending),
            "answer version": str(0 if answer is None else answer.version),
            "answer cold": "nan" if answer is None else str(answer.was_cold).lower(),
            "tick p50 ms": f"{p50:.1f}",
            "tick p95 ms": f"{p95:.1f}",
            "dropped": str(sum(counts.rejected.values())),
        }
        values |= {f"dropped {reason}": str(count) for reason, count in sorted(counts.rejected.items())}
        values |= {"device": "none" if answer is None else answer.device, "version": __version__}
        joined = answer is None or answer.num_components <= 1
        level, text = (_OK, "ok") if joined else (_WARN, f"the graph is in {values['components']} components")
        message = messages.diagnostics_message(time_ns, level, f"{NODE_NAME}: estimator", text, values)
        self._bag.write("/diagnostics", time_ns, message)
