"""Node ``tracker_simulator``: a robot with hidden true errors and a tracker that watches it.

It publishes joint states (what the controller believes) and tracker points (where the true robot is seen), and
executes plans as a real robot's node does (see docs/connecting.md). What the messages hold, and what goes wrong
with them, is in ``simulation``: every tick asks there for what has arrived by now. A tick that comes late makes
up for what it missed, so that a busy machine delays messages and loses none. The truth is never published.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from calib_planner_msgs.action import ExecutePlan
from geometry_msgs.msg import PointStamped
from rclpy.action import CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from calib_planner.errors import CalibPlannerError, InputError
from calib_planner.io import config_folder, read_instrument
from calib_planner.ros.executor import check_executable
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.messages import joints_message, plan_from_message, point_message
from calib_planner.ros.model import load_shipped
from calib_planner.ros.qos import SENSOR_OUT
from calib_planner.ros.rclpy_ext.run import run
from calib_planner.ros.settings import SimulatorParameters
from calib_planner.simulation import (
    NANO,
    Itinerary,
    Rates,
    SimulatedCell,
    Streams,
    Tour,
    World,
    make_tour,
    random_deviations,
)
from calib_planner.units import cut

FEEDBACK_PERIOD = 0.1
"""Time between two looks at the execution [s]."""
PATIENCE = 2.0
"""Time that an execution gets to end when it is stopped [s]."""


@dataclass(frozen=True)
class Execution:
    """A tour and when it began [ns]."""

    tour: Tour
    began: int

    def seconds(self, stamp: int) -> float:
        """Time since it began [s]."""
        return (stamp - self.began) / NANO


class SimulatorNode(ManagedNode[SimulatorParameters]):
    """See the module.

    Attributes:
        world: Robot, tracker and faults, once configured: for tests, which may know the truth.
    """

    THREADS = 3

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        self._busy, self._closing = threading.Lock(), threading.Event()
        self._present = threading.Lock()  # what was sampled is past: a tour begins and ends after it
        super().__init__("tracker_simulator", SimulatorParameters(), context, overrides)

    # ── lifecycle ────────────────────────────────────────────────────────────────────────────────────

    def configure(self) -> None:
        """Draw the true errors, make the publishers."""
        chosen = self.settings.value
        self.world = make_world(chosen)
        robot = self.world.robot
        if len(chosen.tracker_topics) != len(robot.targets):
            expected = f"{len(robot.targets)} topics, as the robot has targets"
            raise InputError("tracker_topics", f"{len(chosen.tracker_topics)} topics", expected)
        self._itinerary = Itinerary(robot.joint_limits.mean(axis=1))
        self._joint_publisher = self.create_publisher(JointState, "joint_states", SENSOR_OUT)
        self._point_publishers = [
            self.create_publisher(PointStamped, topic, SENSOR_OUT) for topic in chosen.tracker_topics
        ]

    def activate(self) -> None:
        """Publish, and take plans."""
        self._closing.clear()
        chosen = self.settings.value
        rates = Rates(chosen.joint_rate, chosen.tracker_rate)
        self._streams = Streams(self.world, self._itinerary.at, rates, self._now())
        self.create_timer(1.0 / max(chosen.joint_rate, chosen.tracker_rate), self._publish)
        self.create_action_server(
            ExecutePlan,
            "~/execute_plan",
            self._on_goal,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        self.get_logger().info(f"{self.world.robot.name} with hidden errors stands still")

    def deactivate(self) -> None:
        """End an execution that is under way."""
        self._closing.set()
        if self._busy.acquire(timeout=PATIENCE):
            self._busy.release()

    def close(self) -> bool:
        """End everything; whether an execution ended in time."""
        super().close()
        return not self._busy.locked()

    # ── the world ────────────────────────────────────────────────────────────────────────────────────

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _publish(self) -> None:
        names, frame = self.world.robot.joint_names, self.settings.value.frame_id
        with self._present:
            messages = self._streams.advance(self._now())
        for message in messages:
            if message.stream:
                point = point_message(message.values, message.stamp, frame)
                self._point_publishers[message.stream - 1].publish(point)
            else:
                self._joint_publisher.publish(joints_message(names, message.values, message.stamp))

    # ── execution ────────────────────────────────────────────────────────────────────────────────────

    def _on_goal(self, goal: ServerGoalHandle) -> ExecutePlan.Result:
        result = ExecutePlan.Result()
        if not self._busy.acquire(blocking=False):
            goal.abort()
            result.status = ExecutePlan.Result.BUSY
            result.message = "another plan is being executed: wait for it or cancel it"
            return result
        try:
            return self._execute(goal, result)
        except CalibPlannerError as error:
            goal.abort()
            result.status, result.message = ExecutePlan.Result.INVALID_PLAN, cut(error)
            self.get_logger().warning(f"plan refused: {result.message}")
            return result
        except Exception as error:
            if not self.context.ok():
                return result  # the process is ending: nobody hears
            goal.abort()
            result.status, result.message = ExecutePlan.Result.ABORTED, f"{type(error).__name__}: {error}"
            self.get_logger().error(result.message)
            return result
        finally:
            self._busy.release()

    def _execute(self, goal: ServerGoalHandle, result: ExecutePlan.Result) -> ExecutePlan.Result:
        plan = plan_from_message(goal.request.plan).plan
        dwell = float(goal.request.dwell)
        if not 0 <= dwell <= 600:
            raise InputError("dwell", dwell, "0 (the node's default) to 600 s")
        check_executable(plan, self.world.robot)
        tour = make_tour(
            self._itinerary.at(np.array([self._now()])).joints[0],
            plan.configurations,
            plan.repetitions,
            self.world.robot.joint_limits,
            self.settings.value.joint_speed,
            dwell or self.settings.value.dwell,
        )
        self.get_logger().info(f"executing {len(plan.configurations)} configurations, {tour.seconds:.1f} s")
        with self._present:
            execution = Execution(tour, self._now())
            self._itinerary.begin(tour, execution.began)
        self._watch(goal, execution, len(plan.configurations))
        with self._present:
            stopped = self._now()
            self._itinerary.stop(stopped)
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

    def _watch(self, goal: ServerGoalHandle, execution: Execution, total: int) -> None:
        """Send feedback until the end or a cancellation."""
        while True:
            seconds = execution.seconds(self._now())
            ended = seconds >= execution.tour.seconds or goal.is_cancel_requested
            if ended or self._closing.is_set():
                return
            phase = execution.tour.at(seconds)
            words = "measuring" if phase.measuring else "moving"
            goal.publish_feedback(
                ExecutePlan.Feedback(index=phase.index, total=total, phase=words, seconds=seconds)
            )
            self._closing.wait(FEEDBACK_PERIOD)


def make_world(chosen: SimulatorParameters) -> World:
    """Robot with its true errors, given or drawn from the seed, tracker and faults.

    Raises:
        InputError: A robot, parameter or true deviation that does not exist.
    """
    robot = load_shipped(chosen.robot, chosen.parameters)
    given = chosen.deviations(robot.available_parameters)
    errors = given or random_deviations(robot, chosen.seed, chosen.length_error, chosen.angle_error)
    instrument = None
    if chosen.instrument != "sigma":
        instrument = read_instrument(config_folder() / "instruments" / f"{chosen.instrument}.yaml")
    return World(SimulatedCell(robot, errors, chosen.sigma, instrument), chosen, chosen.seed)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(SimulatorNode, SimulatorNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
