# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A context of its own with the node under test and a client node, spun in a thread.

Nothing sleeps and hopes: ``wait`` waits for a condition up to a deadline, and calls are repeated because an
answer can be published before discovery has matched its reader.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Log
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

from calib_planner.errors import CalibPlannerError
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.processes import own_domain
from calib_planner.ros.rclpy_ext.run import spin_once


def overrides(values: Mapping[str, Any]) -> list[Parameter]:
    return [Parameter(k, value=v) for k, v in values.items()]


class Client(ActionClient):
    """As rclpy's, used by one thread and spun by another: an answer waits until its request is noted.

    Else it is thrown away when it comes at once, and its future never ends: https://github.com/ros2/rclpy/issues/1123,
    mended by pull request 1308, which the wheels do not have.
    """

    def __init__(self, *args: Any, **named: Any) -> None:
        self._turn = threading.RLock()
        super().__init__(*args, **named)

    def send_goal_async(self, *args: Any, **named: Any) -> Any:
        with self._turn:
            return super().send_goal_async(*args, **named)

    def _get_result_async(self, goal_handle: Any) -> Any:
        with self._turn:
            return super()._get_result_async(goal_handle)

    def _cancel_goal_async(self, goal_handle: Any) -> Any:
        with self._turn:
            return super()._cancel_goal_async(goal_handle)

    async def execute(self, taken_data: Any) -> None:
        with self._turn:
            await super().execute(taken_data)


FORESEEN = ("made for this test", "Transition is not registered", "is not a valid Parameter.Type")
"""Parts of what is raised on purpose: by tests, and by rclpy where a test asks for what there is not."""


class Bench:
    def __init__(self) -> None:
        self._kept = ExitStack()
        self.context, self.domain = Context(), self._kept.enter_context(own_domain())
        rclpy.init(args=[], context=self.context, domain_id=self.domain)
        self.client = Node("test_client", context=self.context)
        self.nodes: list[Node] = []
        self.actions: list[ActionClient] = []
        self._callers: dict[str, Any] = {}
        self._action_clients: dict[str, ActionClient] = {}
        self.stopping = False
        self.unforeseen: list[Exception] = []
        self._spinning: list[tuple[Executor, threading.Thread]] = []
        self._spin(self.client, 1)

    def _spin(self, node: Node, threads: int) -> None:
        """Spin the node by an executor and in a thread of its own."""
        executor: Executor = SingleThreadedExecutor(context=self.context)
        if threads > 1:
            executor = MultiThreadedExecutor(num_threads=threads, context=self.context)
        executor.add_node(node)

        def work() -> None:
            while self.context.ok() and not self.stopping:
                try:
                    spin_once(executor, 0.1)
                except ExternalShutdownException:
                    return

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        self._spinning.append((executor, thread))

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        for node in self.nodes:
            node.close() if hasattr(node, "close") else None
        self.stopping = True
        for executor, thread in self._spinning:
            executor.wake()
            thread.join(timeout=60.0)
        for executor, _ in self._spinning:
            executor.shutdown()
            if isinstance(executor, MultiThreadedExecutor):
                executor._executor.shutdown()  # rclpy leaves its threads at work on what is destroyed next
        for client in self.actions:
            client.destroy()
        # Without this the DDS participant lives on: beyond some 30 of them discovery fails.
        for node in (*self.nodes, self.client):
            node.destroy_node()
        rclpy.shutdown(context=self.context)
        self._kept.close()
        assert not self.unforeseen, f"a node caught what it did not foresee: {self.unforeseen}"

    def _noting(self, say: Callable[[Exception], None]) -> Callable[[Exception], None]:
        """``say`` of a node, which goes on after any exception; a test must not leave it an unforeseen one."""

        def noted(error: Exception) -> None:
            if not isinstance(error, CalibPlannerError) and not any(text in str(error) for text in FORESEEN):
                self.unforeseen.append(error)
            say(error)

        return noted

    def start(self, kind: Callable[..., Node], **parameters: Any) -> Any:
        """The node, spinning; one that starts by itself has done so, or has said why not in ``failure``."""
        node = kind(context=self.context, overrides=overrides(parameters))
        self.nodes.append(node)
        if isinstance(node, ManagedNode):
            node._say = self._noting(node._say)
        self._spin(node, getattr(kind, "THREADS", 1))
        if isinstance(node, ManagedNode) and node.settings.value.autostart:
            self.wait(lambda: node.autostarted)
        return node

    def wait(self, condition: Callable[[], Any], seconds: float = 60.0) -> None:
        """Until ``condition``; ``seconds`` are what a busy machine may take, not what is expected."""
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, f"not within {seconds} s"
            time.sleep(0.005)

    def future(self, future: Any, seconds: float = 60.0) -> Any:
        self.wait(future.done, seconds)
        return future.result()

    def call(self, kind: Any, name: str, request: Any, seconds: float = 10.0, attempts: int = 3) -> Any:
        client = self._callers.get(name)
        if client is None:
            client = self._callers[name] = self.client.create_client(kind, name)
        self.wait(client.service_is_ready)
        for attempt in range(attempts):
            future = client.call_async(request)
            try:
                return self.future(future, seconds)
            except AssertionError:
                client.remove_pending_request(future)
                if attempt == attempts - 1:
                    raise

    def change_state(self, name: str, transition: int, label: str = "") -> bool:
        """Whether the node ``name`` made the transition; not asked twice, since it can be made only once."""
        node = next(n for n in self.nodes if n.get_name() == name)
        request = ChangeState.Request(transition=Transition(id=transition, label=label))
        before = node.state
        try:
            return bool(self.call(ChangeState, f"{name}/change_state", request, attempts=1).success)
        except AssertionError:
            return bool(node.state != before)

    def action(self, kind: Any, name: str) -> ActionClient:
        """The client of an action, one for all: a new one may be answered before discovery has matched it."""
        client = self._action_clients.get(name)
        if client is None:
            client = self._action_clients[name] = Client(self.client, kind, name)
            self.actions.append(client)
        self.wait(client.server_is_ready)
        return client

    def goal(self, client: ActionClient, goal: Any, **options: Any) -> Any:
        """The handle of an accepted goal."""
        for _ in range(3):
            sent = client.send_goal_async(goal, **options)
            try:
                handle = self.future(sent, 20.0)
            except AssertionError:
                continue
            assert handle.accepted
            return handle
        raise AssertionError("goal not answered")

    def said(self, logs: list[Log], node: Node, send: Callable[[], None], *words: str) -> str:
        """Send until ``node`` warns on its log in these words; the line.

        Args:
            logs: What is heard on ``/rosout``.
        """
        known = len(logs)
        for context in list(node.get_logger().contexts.values()):
            context["throttle_last_logged"] = 0  # or a line that is said once a second is not said this time

        def line() -> str:
            mine = (m.msg for m in logs[known:] if m.name == node.get_name() and m.level >= 30)
            return next((m for m in mine if all(word in m for word in words)), "")

        for _ in range(10):
            send()
            try:
                self.wait(line, 2.0)
            except AssertionError:
                continue
            assert len(line()) < 3000
            return line()
        raise AssertionError(f"{node.get_name()} did not say {words}: {[m.msg[:200] for m in logs[known:]][-5:]}")

    def hear(self, kind: Any, topic: str, qos: QoSProfile) -> list[Any]:
        """A list that grows with the messages of a topic."""
        heard: list[Any] = []
        self.client.create_subscription(kind, topic, heard.append, qos)
        return heard
