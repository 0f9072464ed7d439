"""Services and action servers that one thread may destroy while others use them.

A transition (``cleanup``) runs in one thread of the executor; another collects what to wait for, and a third may
be about to answer. rclpy counts who uses a handle and destroys it after the last one. But its executor puts an
action server into the wait set even when it could not take hold of it, its worker threads hold neither action
servers nor, while a callback runs, services: what they then touch is gone, which ends the process or leaves
whoever asked without an answer. Here everyone who uses a handle holds it, an answer that is owed included.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.service import Service


class LastingActionServer(ActionServer):
    """See the module; otherwise as rclpy's."""

    def __init__(self, node: Node, *args: Any, **named: Any) -> None:
        self._held = False
        # rclpy lets the executor know of the server before it gives it this.
        self._logger = node.get_logger().get_child("action_server")
        super().__init__(node, *args, **named)

    def destroy(self) -> None:
        """Nobody waits for it any more; it goes when the last answer is out."""
        self._node.remove_waitable(self)
        for goal in list(self._goal_handles.values()):  # a copy: one may just be arriving in another thread
            goal.destroy()
        self._handle.destroy_when_not_in_use()

    # ── the executor waits ───────────────────────────────────────────────────────────────────────────

    def __enter__(self) -> Any:
        self._held = False
        entered = super().__enter__()
        self._held = True
        return entered

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Called by rclpy, also when ``__enter__`` said that it is gone."""
        if self._held:
            super().add_to_wait_set(wait_set)

    def is_ready(self, wait_set: Any) -> bool:
        """Called by rclpy."""
        return self._held and bool(super().is_ready(wait_set))

    # ── its threads work ─────────────────────────────────────────────────────────────────────────────

    def take_data(self) -> dict[str, Any]:
        """Called by rclpy."""
        try:
            with self._handle:
                return dict(super().take_data())
        except InvalidHandle:
            return {}

    async def execute(self, taken_data: dict[str, Any]) -> None:
        """Called by rclpy."""
        try:
            with self._handle:
                await super().execute(taken_data)
        except InvalidHandle:
            return

    async def _execute_goal(self, execute_callback: Callable[..., Any], goal_handle: Any) -> None:
        try:
            with self._handle:
                await super()._execute_goal(execute_callback, goal_handle)
        except InvalidHandle:
            return

    async def _execute_get_result_request(self, request_header_and_message: Any) -> None:
        _, request = request_header_and_message
        if bytes(request.goal_id.uuid) in self._goal_handles:
            self._handle.__enter__()  # until it is sent
        await super()._execute_get_result_request(request_header_and_message)

    def _send_result_response(self, request_header: Any, future: Any) -> None:
        try:
            super()._send_result_response(request_header, future)
        finally:
            self._handle.__exit__(None, None, None)


def lasting(service: Service) -> Service:
    """The service, which from now on lasts until what its callback was asked is answered."""
    callback, handle = service.callback, service.handle

    def held(request: Any, response: Any) -> Any:
        handle.__enter__()
        try:
            return callback(request, response)
        except BaseException:
            handle.__exit__(None, None, None)
            raise

    def send(response: Any, header: Any) -> None:
        try:
            handle.service_send_response(response, getattr(header, "request_id", header))
        finally:
            handle.__exit__(None, None, None)

    service.callback, service.send_response = held, send
    return service
