"""The node's services. Slow ones run on workers; none blocks the executor."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rotavg_msgs.srv import LabelEdge
from std_srvs.srv import SetBool, Trigger

from rotavg_ros.ros.node.solving import Solving
from rotavg_ros.ros.node.worker import Worker, Workers
from rotavg_ros.view_graph import EdgeLabel


class Services:
    """``~/reset``, ``~/solve_now``, ``~/save``, ``~/load``, ``~/pause`` and ``~/label_edge``."""

    def __init__(
        self,
        node: Node,
        label_edge: Callable[[str, int, EdgeLabel], int],
        solving: Solving,
        workers: Workers,
        default_robot: str,
    ) -> None:
        self._label_edge = label_edge
        self._solving = solving
        self._workers = workers
        self._default_robot = default_robot
        for name, job, thread in (
            ("solve_now", solving.solve_now, workers.solver),
            ("save", solving.save, workers.saver),
            ("load", self._load, workers.saver),
        ):
            # The default group runs one callback at a time, and would run nothing else while one of these waits.
            on_trigger = partial(self._on_trigger, job, thread)
            node.create_service(Trigger, f"~/{name}", on_trigger, callback_group=ReentrantCallbackGroup())
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_service(SetBool, "~/pause", self._on_pause)
        node.create_service(LabelEdge, "~/label_edge", self._on_label_edge)

    async def _on_trigger(
        self, job: Callable[[], str], worker: Worker, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Do a job on a worker, without blocking the executor meanwhile."""
        try:
            response.message = await worker.submit(job)
            response.success = True
        except Exception as error:
            response.message = str(error)
            response.success = False
        return response

    def _load(self) -> str:
        message = self._solving.load()
        self._workers.solver.submit_once(self._solving.tick_quietly)
        return message

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = self._solving.reset()
        response.success = True
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.message = self._solving.pause(request.data)
        response.success = True
        return response

    def _on_label_edge(self, request: LabelEdge.Request, response: LabelEdge.Response) -> LabelEdge.Response:
        robot = request.source_robot or self._default_robot
        try:
            label = EdgeLabel(request.label)
        except ValueError:
            response.success, response.message = False, f"label {request.label} is none of 0, 1, 2"
            return response
        number = self._label_edge(robot, request.edge_id, label)
        response.success = number > 0
        edges = f"edge {request.edge_id} of {robot}"
        response.message = f"{edges}: {label.name.lower()} ({number} found)" if number else f"{edges} is not known"
        return response
