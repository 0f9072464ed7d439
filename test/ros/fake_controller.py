# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot, its controller and its tracker as a node, on a clock of their own that runs faster than the real one.

The node publishes ``/clock``: everybody who uses simulated time lives in its time. It offers the real action
``FollowJointTrajectory``; how it treats a goal says a ``Manner`` of ``arm``. Its module needs ``control_msgs``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from arm import GOOD, NEVER, Arm, Manner
from control_msgs.action import FollowJointTrajectory
from rclpy.action import CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from calib_planner.acquisition import NANO
from calib_planner.ros.messages import stamp_message
from calib_planner.ros.parameters import SENSOR_OUT
from calib_planner.ros.rclpy_ext.lasting import LastingActionServer
from calib_planner.ros.ways import way_from_message

NAMES = ("q1", "q2")
STEP = 0.04
"""Simulated time between two joint states [s]."""
ACTION = "joint_trajectory_controller/follow_joint_trajectory"
PREEMPTED = "Current goal cancelled due to new incoming action."


class FakeController(Node):
    """``locked``: what the tracker says, ``None``: nothing; ``deaf``: whether joint states are missing."""

    THREADS = 6

    def __init__(self, context: Context | None = None, overrides: object = (), speed: float = 10.0) -> None:
        super().__init__("fake_controller", context=context)
        self.arm, self.manner, self.now = Arm(np.array([0.1, 0.2])), GOOD, 1000.0
        self.locked: bool | None = None
        self.deaf = False
        self.goals: list[Any] = []
        self.cancels = 0
        self._pause, self._turn, self._closing = STEP / speed, threading.Condition(), threading.Event()
        self._current: Any = None
        self._clock_out = self.create_publisher(Clock, "/clock", 10)
        self._joints = self.create_publisher(JointState, "joint_states", SENSOR_OUT)
        self._locked = self.create_publisher(Bool, "tracker/locked", SENSOR_OUT)
        self._server = LastingActionServer(
            self,
            FollowJointTrajectory,
            ACTION,
            self._execute,
            callback_group=ReentrantCallbackGroup(),
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        with self._turn:
            self._turn.notify_all()
        self._thread.join(5.0)
        self._server.destroy()

    @property
    def joints(self) -> np.ndarray:
        """(joints,) where the arm is now [rad]."""
        with self._turn:
            return self.arm.joints(self.now)

    def _live(self) -> None:
        while not self._closing.wait(self._pause) and self.context.ok():
            with self._turn:
                self.now += STEP
                stamp = stamp_message(round(self.now * NANO))
                q = self.arm.joints(self.now)
                self._turn.notify_all()
            if not self.deaf:
                message = JointState(name=["q2", "other", "q1"], position=[q[1], 9.0, q[0]])
                message.header.stamp = stamp
                self._joints.publish(message)
            if self.locked is not None:
                self._locked.publish(Bool(data=self.locked))
            self._clock_out.publish(Clock(clock=stamp))

    def _until(self, condition: Callable[[], bool]) -> None:
        """Wait, in the controller's time."""
        with self._turn:
            self._turn.wait_for(lambda: condition() or self._closing.is_set())

    def _wait(self, seconds: float) -> None:
        end = self.now + seconds
        self._until(lambda: self.now >= end)

    def _on_goal(self, goal: Any) -> GoalResponse:
        self.goals.append(goal)
        self._wait(self.manner.answer)
        return GoalResponse.REJECT if self.manner.refuse else GoalResponse.ACCEPT

    def _on_accepted(self, handle: Any) -> None:
        self._current = handle
        handle.execute()

    def _on_cancel(self, _: Any) -> CancelResponse:
        self.cancels += 1
        return CancelResponse.ACCEPT if self.manner.halts else CancelResponse.REJECT

    def _execute(self, goal: Any) -> Any:
        manner = self.manner
        self._wait(manner.delay)
        with self._turn:
            way = way_from_message(goal.request.trajectory, NAMES, self.arm.joints(self.now))
            self.arm.follow(way, self.now, manner)
        self._until(lambda: self._done(goal))
        with self._turn:
            if self._current is goal:
                self.arm.halt(self.now)
        if goal.is_cancel_requested:
            self._wait(0.0 if manner.confirms else NEVER)
            goal.canceled()
            return FollowJointTrajectory.Result()
        if self._current is not goal:
            goal.abort()
            return FollowJointTrajectory.Result(error_code=-1, error_string=PREEMPTED)
        self._wait(manner.result)
        if manner.failure:
            goal.abort()
            return FollowJointTrajectory.Result(error_code=-4, error_string=manner.failure)
        goal.succeed()
        return FollowJointTrajectory.Result()

    def _done(self, goal: Any) -> bool:
        return goal.is_cancel_requested or self._current is not goal or self.arm.done(self.now)


__all__ = ["ACTION", "PREEMPTED", "FakeController", "Manner"]
