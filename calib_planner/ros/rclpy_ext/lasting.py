# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Services and action servers that one thread may destroy while other threads use them.

*What rclpy does.* A transition (``cleanup``) runs in one thread of the executor while another thread collects
what to wait for and a third is about to answer. rclpy counts the users of a handle and destroys it after the last
one has left, but not every user is counted. The executor adds an action server to the wait set even if it could
not enter the server's handle; worker threads enter neither the handle of an action server nor, while the callback
runs, that of a service. They then use a handle that is gone, and ``InvalidHandle`` ends the process or leaves the
client without an answer.

*What is done here.* Every user enters the handle and leaves it, and an answer that is owed counts as a user.

*Upstream.* ros2/rclpy#1385 and #1355 (open), #1284; ros2/rclpy#319 made ``destroy_*`` safe against other threads
and left action servers out. This file may go when the executor skips a waitable that it could not enter, and when
services and action servers stay until they have answered.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.service import Service


class LastingActionServer(ActionServer):
    """An action server that stays until its last answer is sent; otherwise as rclpy's, which calls these
    methods."""

    def __init__(self, node: Node, *args: Any, **named: Any) -> None:
        self._entered = False  # whether the executor that collects now has entered the handle
        # rclpy sets the logger after the executor has been told of the server and may already use it.
        self._logger = node.get_logger().get_child("action_server")
        super().__init__(node, *args, **named)

    def destroy(self) -> None:
        """Nobody waits for it any more; the handle goes with its last user."""
        self._node.remove_waitable(self)
        for goal in list(self._goal_handles.values()):  # a copy: another thread may be adding a goal
            goal.destroy()
        self._handle.destroy_when_not_in_use()

    def __enter__(self) -> Any:
        self._entered = False
        entered = super().__enter__()
        self._entered = True
        return entered

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Nothing, if the handle could not be entered."""
        if self._entered:
            super().add_to_wait_set(wait_set)

    def is_ready(self, wait_set: Any) -> bool:
        """Whether something has come; no, if the handle could not be entered."""
        return self._entered and bool(super().is_ready(wait_set))

    def take_data(self) -> dict[str, Any]:
        """What has come; nothing, if the server is gone."""
        try:
            with self._handle:
                return dict(super().take_data())
        except InvalidHandle:
            return {}

    async def execute(self, taken_data: dict[str, Any]) -> None:
        """Work on what has come, unless the server is gone."""
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
            self._handle.__enter__()  # left by _send_result_response
        await super()._execute_get_result_request(request_header_and_message)

    def _send_result_response(self, request_header: Any, future: Any) -> None:
        try:
            super()._send_result_response(request_header, future)
        finally:
            self._handle.__exit__(None, None, None)


def lasting(service: Service) -> Service:
    """The same service, which from now on stays until every request that it took is answered."""
    callback, handle = service.callback, service.handle

    def enter_and_call(request: Any, response: Any) -> Any:
        handle.__enter__()  # left by send
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

    service.callback, service.send_response = enter_and_call, send
    return service
