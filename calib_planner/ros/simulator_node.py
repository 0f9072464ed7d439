"""Node ``tracker_simulator``: a robot with hidden true errors and a tracker that watches it.

It publishes joint states (what the controller believes) and tracker points (where the true robot is, with
noise), each stamped by the node's clock, and executes plans. The way it moves is in ``motion``.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from calib_planner_msgs.action import ExecutePlan
from geometry_msgs.msg import PointStamped
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from calib_planner._arrays import FloatArray
from calib_planner.design.plan import Plan
from calib_planner.errors import CalibPlannerError, InputError, UnknownNameError
from calib_planner.instrument.standstill import NANO
from calib_planner.robot.chain import Robot
from calib_planner.ros.conversions import joints_message, plan_from_message, point_message
from calib_planner.ros.parameters import NodeParameters
from calib_planner.ros.qos import SENSOR_OUT
from calib_planner.ros.run import run
from calib_planner.ros.settings import SimulatorParameters, load_shipped
from calib_planner.simulation import SimulatedCell, random_deviations
from calib_planner.simulation.motion import Tour, make_tour

FEEDBACK_PERIOD = 0.1
"""Time between two looks at the execution [s]."""


@dataclass(frozen=True)
class Execution:
    """A tour and when it began [ns]."""

    tour: Tour
    began: int

    def seconds(self, stamp: int) -> float:
        """Time since it began [s]."""
        return (stamp - self.began) / NANO


class SimulatorNode(Node):
    """See the module."""

    THREADS = 3

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        super().__init__("tracker_simulator", context=context, parameter_overrides=list(overrides))
        self.settings = NodeParameters(self, SimulatorParameters())
        chosen = self.settings.value
        self._robot = load_shipped(chosen.robot, chosen.parameters)
        if len(chosen.tracker_topics) != len(self._robot.targets):
            expected = f"{len(self._robot.targets)} topics, as the robot has targets"
            raise InputError("tracker_topics", f"{len(chosen.tracker_topics)} topics", expected)
        self._truth = SimulatedCell(self._robot, true_deviations(self._robot, chosen)).truth
        self._rng = np.random.default_rng([chosen.seed, 2])
        self._rest: FloatArray = self._robot.joint_limits.mean(axis=1)
        self._execution: Execution | None = None
        self._busy, self._closing = threading.Lock(), threading.Event()
        self._joint_publisher = self.create_publisher(JointState, "joint_states", SENSOR_OUT)
        self._point_publishers = [
            self.create_publisher(PointStamped, topic, SENSOR_OUT) for topic in chosen.tracker_topics
        ]
        self._timers_of_streams = [
            self.create_timer(1.0 / chosen.joint_rate, self._publish_joints),
            self.create_timer(1.0 / chosen.tracker_rate, self._publish_points),
        ]
        self._action = ActionServer(
            self,
            ExecutePlan,
            "~/execute_plan",
            self._on_goal,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        self.get_logger().info(f"{self._robot.name} with hidden errors stands still")

    def close(self) -> bool:
        """End an execution that is under way; whether it did within a moment."""
        self._closing.set()
        ended = self._busy.acquire(timeout=2.0)
        if ended:
            self._busy.release()
        return ended

    # ── the world ────────────────────────────────────────────────────────────────────────────────────

    def _joints_at(self, stamp: int) -> FloatArray:
        execution = self._execution
        if execution is None:
            return self._rest
        seconds = execution.seconds(stamp)
        return execution.tour.at(seconds).joints(seconds)

    def _publish_joints(self) -> None:
        stamp = self.get_clock().now().nanoseconds
        self._joint_publisher.publish(joints_message(self._robot.joint_names, self._joints_at(stamp), stamp))

    def _publish_points(self) -> None:
        stamp = self.get_clock().now().nanoseconds
        points = self._truth.positions(self._joints_at(stamp))[0]
        noisy = points + self.settings.value.sigma * self._rng.standard_normal(points.shape)
        for publisher, point in zip(self._point_publishers, noisy, strict=True):
            publisher.publish(point_message(point, stamp, self.settings.value.frame_id))

    # ── execution ────────────────────────────────────────────────────────────────────────────────────

    def _on_goal(self, goal: ServerGoalHandle) -> ExecutePlan.Result:
        result = ExecutePlan.Result()
        if not self._busy.acquire(blocking=False):
            goal.abort()
            result.status = ExecutePlan.Result.ABORTED
            result.message = "another plan is being executed: wait for it or cancel it"
            return result
        try:
            return self._execute(goal, result)
        except CalibPlannerError as error:
            goal.abort()
            result.status, result.message = ExecutePlan.Result.INVALID_PLAN, str(error)
            self.get_logger().warning(f"plan refused: {error}")
            return result
        finally:
            self._busy.release()

    def _execute(self, goal: ServerGoalHandle, result: ExecutePlan.Result) -> ExecutePlan.Result:
        plan = plan_from_message(goal.request.plan).plan
        dwell = float(goal.request.dwell)
        if not 0 <= dwell <= 600:
            raise InputError("dwell", dwell, "0 (the node's default) to 600 s")
        check_executable(plan, self._robot)
        tour = make_tour(
            self._rest,
            plan.configurations,
            plan.repetitions,
            self._robot.joint_limits,
            self.settings.value.joint_speed,
            dwell or self.settings.value.dwell,
        )
        self.get_logger().info(f"executing {len(plan.configurations)} configurations, {tour.seconds:.1f} s")
        began = self.get_clock().now().nanoseconds
        self._execution = execution = Execution(tour, began)
        stopped = self._watch(goal, execution, len(plan.configurations))
        self._rest = self._joints_at(stopped)
        self._execution = None
        result.executed = tour.standstills(execution.seconds(stopped))
        if self._closing.is_set():
            return result
        if goal.is_cancel_requested and execution.seconds(stopped) < tour.seconds:
            result.status, result.message = ExecutePlan.Result.CANCELLED, "stopped on request"
            goal.canceled()
        else:
            result.status, result.message = ExecutePlan.Result.SUCCESS, "every configuration was visited"
            goal.succeed()
        return result

    def _watch(self, goal: ServerGoalHandle, execution: Execution, total: int) -> int:
        """Send feedback until the end or a cancellation; returns the stamp [ns] of that."""
        while True:
            stamp = self.get_clock().now().nanoseconds
            seconds = execution.seconds(stamp)
            ended = seconds >= execution.tour.seconds or goal.is_cancel_requested
            if ended or self._closing.is_set():
                return stamp
            phase = execution.tour.at(seconds)
            words = "measuring" if phase.measuring else "moving"
            goal.publish_feedback(
                ExecutePlan.Feedback(index=phase.index, total=total, phase=words, seconds=seconds)
            )
            self._closing.wait(FEEDBACK_PERIOD)


def true_deviations(robot: Robot, settings: SimulatorParameters) -> dict[str, float]:
    """The hidden errors of the active parameters [m | rad]: given, or drawn from the seed."""
    given = settings.deviations(robot.available_parameters)
    return given or random_deviations(robot, settings.seed, settings.length_error, settings.angle_error)


def check_executable(plan: Plan, robot: Robot) -> None:
    """Refuse a plan that this robot cannot execute.

    Raises:
        InputError: Other robot or joints, or a configuration outside the limits.
    """
    if plan.robot != robot.name:
        raise UnknownNameError("plan.robot", plan.robot, [robot.name])
    if plan.joint_names != robot.joint_names:
        raise InputError("plan.joint_names", ", ".join(plan.joint_names), ", ".join(robot.joint_names))
    low, high = robot.joint_limits.T
    outside = (plan.configurations < low - 1e-6) | (plan.configurations > high + 1e-6)
    if outside.any():
        i, j = (int(k) for k in np.argwhere(outside)[0])
        expected = f"within the limits [{low[j]:.4f}, {high[j]:.4f}] of {robot.joint_names[j]}"
        raise InputError(f"plan.configurations, row {i}", f"{plan.configurations[i, j]:.4f}", expected)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(SimulatorNode, SimulatorNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
