# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A lifecycle node that leaves nothing behind, refuses impossible transitions and says what it was given.

*What rclpy does, and why that does not serve.*

- ``destroy_node`` leaves the state machine, action servers and action clients to the garbage collector. Each of
  them keeps the node alive below Python. When the collector destroys it at last, rcl removes the entry of the
  node's name from its table of log publishers, even if another node of that name owns the entry by then: that
  node works on, but nothing of what it logs is heard on ``/rosout`` any more (ros2/rcl#1088 describes the table).
- A transition that is impossible in the present state raises an exception in the callback of ``~/change_state``,
  which ends the process of the node (ros2/rclpy#1209).
- A service tells the present state; no method does.
- A parameter given at start (file, command line, launch) that no node declares is dropped without a word: a
  misspelt name leaves the default in place. No method lists what was given.

This file may go when rclpy destroys with the node what belongs to it (ros2/rclpy#1710), when ``change_state``
answers (ros2/rclpy#1319), and when a node tells its state and the parameters that it was given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rclpy.action import ActionClient, ActionServer
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter


class TidyLifecycleNode(LifecycleNode):
    """rclpy's lifecycle node, with what the module describes."""

    def guard_change_state(self, guard: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
        """Have the callback of ``~/change_state`` replaced by ``guard(callback)``, which does not raise."""
        service = self._service_change_state
        service.callback = guard(service.callback)

    @property
    def state(self) -> str:
        """``unconfigured``, ``inactive``, ``active``, ``finalized`` or the name of a transition.

        A destroyed node is ``finalized``; a thread that it left behind may ask.
        """
        try:
            with self._state_machine:
                return str(self._state_machine.current_state[1])
        except InvalidHandle:
            return "finalized"

    def destroy_node(self) -> None:
        """Destroy the node and what belongs to it."""
        for waitable in list(self.waitables):
            if isinstance(waitable, (ActionServer, ActionClient)):
                waitable.destroy()
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()


def given_parameters(node: Node) -> Mapping[str, Parameter]:
    """The parameters that were given at start, declared or not, by name."""
    given: Mapping[str, Parameter] = node._parameter_overrides
    return given
