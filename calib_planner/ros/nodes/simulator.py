"""Node ``tracker_simulator``: a robot with hidden true errors, and a tracker that watches it.

It publishes joint states (what the controller believes) and tracker points (where the true robot is seen), and
executes plans as the node of a real robot does (see docs/connecting.md). What the messages hold, and what goes
wrong with them, is in ``simulation``: at every tick the node asks there for what has arrived by now. A tick that
comes late makes up for what it missed, so that a busy machine delays messages and loses none. The truth is never
published.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from calib_planner_msgs.action import ExecutePlan
from geometry_msgs.msg import PointStamped
from rclpy.action.server import ServerGoalHandle
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from calib_planner.arrays import check_number
from calib_planner.errors import CalibPlannerError, InputError
from calib_planner.io import config_folder, read_error_model, read_instrument
from calib_planner.ros.executor import check_executable
from calib_planner.ros.lifecycle import ManagedNode, OneAtATime, reason_of
from calib_planner.ros.messages import (
    duration_message,
    joints_message,
    plan_from_message,
    point_message,
    seconds_of,
)
from calib_planner.ros.model import load_shipped
from calib_planner.ros.parameters import SENSOR_OUT
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


class SimulatorNode(ManagedNode[SimulatorParameters]):
    """The simulated cell as a node.

    Attributes:
        world: Robot, tracker and faults, once configured: for tests, which may know the truth.
    """

    THREADS = 3

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        self._work = OneAtATime()
        self._present = threading.Lock()  # a tour begins and ends after everything that was sampled
        super().__init__("tracker_simulator", SimulatorParameters(), context, overrides)

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
        self._work.closing.clear()
        chosen = self.settings.value
        rates = Rates(chosen.joint_rate, chosen.tracker_rate)
        self._streams = Streams(self.world, self._itinerary.at, rates, self.now)
        self.create_timer(1.0 / max(chosen.joint_rate, chosen.tracker_rate), self._publish)
        self.create_action_server(ExecutePlan, "~/execute_plan", self._on_goal)
        self.get_logger().info(f"{self.world.robot.name} with hidden errors stands still")

    def deactivate(self) -> None:
        """End an execution that is under way."""
        self._work.end(PATIENCE)

    def close(self) -> bool:
        """End everything; returns whether an execution ended in time."""
        super().close()
        return self._work.ended

    def _publish(self) -> None:
        names, frame = self.world.robot.joint_names, self.settings.value.frame_id
        with self._present:
            messages = self._streams.advance(self.now)
        for message in messages:
            if message.stream:
                point = point_message(message.values, message.stamp, frame)
                self._point_publishers[message.stream - 1].publish(point)
            else:
                self._joint_publisher.publish(joints_message(names, message.values, message.stamp))

    def _on_goal(self, goal: ServerGoalHandle) -> ExecutePlan.Result:
        kind = ExecutePlan.Result
        with self._work.turn() as mine:
            if not mine:
                goal.abort()
                return kind(status=kind.BUSY, message="another plan is being executed: wait for it or cancel it")
            try:
                return self._execute(goal)
            except CalibPlannerError as error:
                result = kind(status=kind.INVALID_PLAN, message=cut(error))
                self.get_logger().warning(f"plan refused: {result.message}")
            except Exception as error:
                result = kind(status=kind.ABORTED, message=reason_of(error))
                if not self.context.ok():
                    return result  # the process is ending, and the result is not sent
                self.get_logger().error(result.message)
            goal.abort()
            return result

    def _execute(self, goal: ServerGoalHandle) -> ExecutePlan.Result:
        plan = plan_from_message(goal.request.plan).plan
        asked = seconds_of(goal.request.dwell)
        dwell = check_number("dwell", asked, low=0.0, high=600.0, unit="s; 0: the node's default")
        check_executable(plan, self.world.robot)
        tour = make_tour(
            self._itinerary.at(np.array([self.now])).joints[0],
            plan.configurations,
            plan.repetitions,
            self.world.robot.own_limits,
            self.settings.value.joint_speed,
            dwell or self.settings.value.dwell,
            self.world.robot.coupling,
            shortest=1.0 / self.settings.value.joint_rate,
        )
        self.get_logger().info(f"executing {len(plan.configurations)} configurations, {tour.seconds:.1f} s")
        with self._present:
            began = self.now
            self._itinerary.begin(tour, began)
        self._watch(goal, tour, began, len(plan.configurations))
        with self._present:
            stopped = self.now
            self._itinerary.halt(stopped)
        seconds = (stopped - began) / NANO
        result = ExecutePlan.Result(executed=tour.standstills(seconds))
        if self._work.closing.is_set():
            return result
        if goal.is_cancel_requested and seconds < tour.seconds:
            result.status, result.message = ExecutePlan.Result.CANCELLED, "stopped on request"
            goal.canceled()
        else:
            result.status, result.message = ExecutePlan.Result.SUCCESS, "every configuration was visited"
            goal.succeed()
        return result

    def _watch(self, goal: ServerGoalHandle, tour: Tour, began: int, total: int) -> None:
        """Send feedback until the tour that began at ``began`` [ns] ends or is cancelled."""
        while (seconds := (self.now - began) / NANO) < tour.seconds:
            if goal.is_cancel_requested or self._work.closing.is_set():
                return
            phase = tour.at(seconds)
            kind = ExecutePlan.Feedback
            feedback = kind(index=phase.index, total=total, executed=tour.standstills(seconds))
            feedback.phase = kind.MEASURING if phase.measuring else kind.MOVING
            feedback.elapsed = duration_message(seconds)
            goal.publish_feedback(feedback)
            self.rest(FEEDBACK_PERIOD, self._work.closing)


def make_world(chosen: SimulatorParameters) -> World:
    """A robot with true errors (given, or drawn from the seed), a tracker and faults.

    Raises:
        InputError: A robot, parameter or true deviation that does not exist.
        FileFormatError: The file of the error model is not readable.
    """
    robot = load_shipped(chosen.robot, chosen.parameters)
    given = chosen.deviations(robot.available_parameters)
    errors = given or random_deviations(robot, chosen.seed, chosen.length_error, chosen.angle_error)
    instrument = None
    if chosen.instrument != "sigma":
        instrument = read_instrument(config_folder() / "instruments" / f"{chosen.instrument}.yaml")
    model = read_error_model(chosen.error_model)
    cell = SimulatedCell(robot, errors, chosen.sigma, instrument, model, chosen.seed)
    return World(cell, chosen, chosen.seed)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(SimulatorNode, SimulatorNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
