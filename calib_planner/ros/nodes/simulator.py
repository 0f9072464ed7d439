# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Node ``tracker_simulator``: a robot with hidden true errors, and a tracker that watches it.

It publishes joint states (what the controller believes) and tracker points (where the true robot is seen), and
executes plans as the node of a real robot does (see docs/connecting.md). Where ``control_msgs`` is installed it
stands in for a robot's controller, too: it follows trajectories as a ``joint_trajectory_controller`` does.

What the messages hold, and what goes wrong with them, is in ``simulation``: at every tick the node asks there for
what has arrived by now. A tick that comes late makes up for what it missed, so that a busy machine delays
messages and loses none. The truth is never published.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from calib_planner_msgs.action import ExecutePlan
from geometry_msgs.msg import PointStamped
from rclpy.action import GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from calib_planner.errors import CalibPlannerError, InputError
from calib_planner.io import config_folder, read_instrument
from calib_planner.planning import Trajectory
from calib_planner.ros.cell import cell_of, error_model_of, instrument_of
from calib_planner.ros.executor import ACTION, NewestPlan, check_executable, dwell_of, feedback_message
from calib_planner.ros.lifecycle import OK, WARN, Finding, ManagedNode, OneAtATime, reason_of
from calib_planner.ros.messages import (
    joints_message,
    nanoseconds,
    plan_from_message,
    point_message,
)
from calib_planner.ros.model import load_shipped
from calib_planner.ros.parameters import SENSOR_OUT
from calib_planner.ros.rclpy_ext.run import run
from calib_planner.ros.settings import SimulatorParameters
from calib_planner.ros.ways import FollowJointTrajectory, way_from_message
from calib_planner.simulation import (
    NANO,
    Followed,
    Itinerary,
    Rates,
    SimulatedCell,
    Streams,
    Tour,
    World,
    make_tour,
    random_deviations,
)
from calib_planner.units import counted, cut, listed

LOCKED_PERIOD = 0.1
"""Time between two messages about the beam, if nothing changes [s]."""
LONGEST_JUMP = 0.05
"""How far from the robot a trajectory may begin, unless the goal has tolerances of its own [rad | m]."""
PREEMPTED = "Current goal cancelled due to new incoming action."
"""What a joint_trajectory_controller says."""
FEEDBACK_PERIOD = 0.1
"""Time between two looks at the execution [s]."""
PATIENCE = 2.0
"""Time that an execution gets to end when it is stopped [s]."""


class SimulatorNode(ManagedNode[SimulatorParameters]):
    """The simulated cell as a node.

    Attributes:
        world: Robot, tracker and faults, once configured: for tests, which may know the truth.
    """

    THREADS = 5

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        self._work = OneAtATime()
        self._halts = self._halts_before = 0  # calls of ~/stop, and those before the present motion was wanted
        self._following: ServerGoalHandle | None = None
        self._locked, self._lost, self._said = True, False, 0
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
        self._locked_publishers = [
            self.create_publisher(Bool, topic, SENSOR_OUT) for topic in chosen.tracker_state_topics if topic
        ]

    def activate(self) -> None:
        """Publish, and take plans."""
        self._work.closing.clear()
        chosen = self.settings.value
        rates = Rates(chosen.joint_rate, chosen.tracker_rate)
        self._streams = Streams(self.world, self._itinerary.at, rates, self.now)
        self.create_timer(1.0 / max(chosen.joint_rate, chosen.tracker_rate), self._publish)
        self.create_action_server(ExecutePlan, ACTION, self._on_goal)
        self._newest = NewestPlan(self, chosen.plan_topic, self._check)
        self.create_trigger("~/stop", self._halt)
        self.create_trigger("~/restore_beam", self._restore_beam)
        if FollowJointTrajectory is not None:
            self.create_action_server(
                FollowJointTrajectory,
                chosen.controller_action,
                self._follow,
                goal_callback=self._on_trajectory,
                handle_accepted_callback=self._on_accepted,
            )
        log = self.get_logger()
        log.info(f"{self.world.robot.name} with hidden errors stands still")
        if FollowJointTrajectory is not None:
            log.info(f"it follows trajectories that come by the action {chosen.controller_action}")

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
        self._publish_locked()

    def _publish_locked(self) -> None:
        """Say whether the tracker holds its targets: at every change, and now and then."""
        now, before = self.now, self._locked
        with self._present:
            self._locked, self._lost = self._streams.locked(now)
        if self._locked != before or not 0 <= now - self._said < LOCKED_PERIOD * NANO:
            self._said = now
            for publisher in self._locked_publishers:
                publisher.publish(Bool(data=self._locked))

    # ── plans ────────────────────────────────────────────────────────────────────────────────────────

    def _check(self, goal: ExecutePlan.Goal) -> str:
        """What ``~/execute`` answers.

        Raises:
            CalibPlannerError: The goal would not be executed.
        """
        if not self._work.ended or self._following is not None:
            raise CalibPlannerError("the robot moves already: wait, or call ~/stop")
        plan = plan_from_message(goal.plan).plan
        check_executable(plan, self.world.robot)
        return counted(len(plan.configurations), "configuration")

    def _halt(self) -> str:
        """End what the robot does."""
        if self._work.ended and self._following is None:
            return "the robot stands already"
        self._halts += 1
        return "the robot stops"

    @property
    def _halted(self) -> bool:
        """Whether somebody called ``~/stop`` since the present motion was wanted."""
        return self._halts != self._halts_before

    def _restore_beam(self) -> str:
        with self._present:
            lost = self._streams.restore_beam(self.now)
        return "the tracker holds the target again" if lost else "the beam was not lost"

    def _on_goal(self, goal: ServerGoalHandle) -> ExecutePlan.Result:
        kind, halts = ExecutePlan.Result, self._halts
        with self._work.turn() as mine:
            if not mine or self._following is not None:
                goal.abort()
                return kind(status=kind.BUSY, message="another plan is being executed: wait for it or cancel it")
            self._halts_before = halts
            try:
                result = self._execute(goal)
                self.outcome("newest plan", OK, result.message or "ended")
                return result
            except CalibPlannerError as error:
                result = kind(status=kind.INVALID_PLAN, message=cut(error))
                self.get_logger().warning(f"plan refused: {result.message}")
            except Exception as error:
                result = kind(status=kind.ABORTED, message=reason_of(error))
                if not self.context.ok():
                    return result  # the process is ending, and the result is not sent
                self.get_logger().error(result.message)
            self.outcome("newest plan", WARN, result.message)
            goal.abort()
            return result

    def findings(self) -> Sequence[Finding]:
        """What the simulated robot does, and what came of the newest plan."""
        moving = not self._work.ended or self._following is not None
        words = "executes a plan or a trajectory" if moving else "stands still"
        return (Finding("robot", OK, words), *self.newest)

    @property
    def robot_name(self) -> str:
        """The simulated robot."""
        return self.world.robot.name

    def _execute(self, goal: ServerGoalHandle) -> ExecutePlan.Result:
        plan = plan_from_message(goal.request.plan).plan
        dwell = dwell_of(goal.request)
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
        early = seconds < tour.seconds
        if early and goal.is_cancel_requested:
            result.status, result.message = ExecutePlan.Result.CANCELLED, "stopped on request"
            goal.canceled()
        elif early and self._halted:
            result.status, result.message = ExecutePlan.Result.STOPPED, "somebody called ~/stop"
            goal.abort()
        elif early:
            words = (
                "the tracker has lost the reflector: bring it back (~/restore_beam), send the rest of the plan"
            )
            result.status, result.message = ExecutePlan.Result.BEAM_LOST, words
            goal.abort()
        else:
            result.status, result.message = ExecutePlan.Result.SUCCESS, "every configuration was visited"
            goal.succeed()
        return result

    def _watch(self, goal: ServerGoalHandle, tour: Tour, began: int, total: int) -> None:
        """Send feedback until the tour that began at ``began`` [ns] ends, by itself or early."""
        while (seconds := (self.now - began) / NANO) < tour.seconds:
            if goal.is_cancel_requested or self._work.closing.is_set() or self._halted or self._lost:
                return
            phase = tour.at(seconds)
            word = "MEASURING" if phase.measuring else "MOVING"
            done = tour.standstills(seconds)
            goal.publish_feedback(feedback_message(word, phase.index, total, done, seconds))
            self.rest(FEEDBACK_PERIOD, self._work.closing)

    # ── trajectories, as a joint_trajectory_controller follows them ─────────────────────────────────────

    def _way(self, goal: Any) -> tuple[Trajectory, int]:
        """What a goal means now: a trajectory, and when it begins [ns].

        Raises:
            InputError: It is none for this robot.
        """
        message, now = goal.trajectory, self.now
        here = self._itinerary.at(np.array([now])).joints[0]
        way, names = way_from_message(message, self.world.robot.joint_names, here), list(message.joint_names)
        if len(names) != len(self.world.robot.joint_names):
            raise InputError("trajectory.joint_names", listed(names), ", ".join(self.world.robot.joint_names))
        if any(message.points[-1].velocities):
            raise InputError("trajectory.points", "a last point that moves", "one at rest")
        began = nanoseconds(message.header.stamp) or now
        if began + way.seconds * NANO < now:
            raise InputError("trajectory.header.stamp", "an end in the past", "zero, or a time to come")
        return way, began

    def _on_trajectory(self, goal: Any) -> GoalResponse:
        """Accept a trajectory, or refuse it; as a controller does, without telling the client why."""
        refused = "" if self._work.ended else "a plan is being executed"
        try:
            self._way(goal)
        except CalibPlannerError as error:
            refused = str(error)
        if refused:
            self.get_logger().error(f"trajectory refused: {cut(refused)}")
        return GoalResponse.REJECT if refused else GoalResponse.ACCEPT

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        """Begin; a goal that is under way ends, since there is a newer one."""
        self._halts_before = self._halts
        self._following = handle
        handle.execute()

    def _follow(self, goal: ServerGoalHandle) -> Any:
        kind = FollowJointTrajectory.Result
        try:
            way, began = self._way(goal.request)
        except CalibPlannerError as error:  # the robot moved since it was accepted
            return self._left(goal, kind(error_code=kind.INVALID_GOAL, error_string=cut(error)))
        here, start = self._itinerary.at(np.array([self.now])).joints[0], way.at([(self.now - began) / NANO])[0]
        names = self.world.robot.joint_names
        given = {t.name: t.position for t in goal.request.path_tolerance if t.position > 0}
        off = np.abs(start - here) - np.array([given.get(name, LONGEST_JUMP) for name in names])
        if off.max() > 0:
            words = f"{names[int(off.argmax())]} is {off.max():.4f} beyond its path tolerance at the beginning"
            return self._left(goal, kind(error_code=kind.PATH_TOLERANCE_VIOLATED, error_string=words))
        with self._present:
            if self._is_newest(goal):
                self._itinerary.begin(Followed(way), began)
        while (seconds := (self.now - began) / NANO) < way.seconds and self._is_newest(goal):
            if goal.is_cancel_requested or self._work.closing.is_set() or self._halted:
                break
            goal.publish_feedback(self._trajectory_feedback(way, seconds))
            self.rest(min(FEEDBACK_PERIOD, way.seconds - seconds), self._work.closing)
        with self._present:
            if not self._is_newest(goal):
                return self._left(goal, kind(error_code=kind.INVALID_GOAL, error_string=PREEMPTED))
            self._itinerary.halt(self.now)
        if goal.is_cancel_requested or self._halted or self._work.closing.is_set():
            return self._left(goal, kind(error_code=kind.INVALID_GOAL, error_string="stopped on request"))
        return self._left(goal, kind())

    def _is_newest(self, goal: ServerGoalHandle) -> bool:
        """Whether the robot still follows the trajectory of that goal."""
        return self._following is goal

    def _left(self, goal: ServerGoalHandle, result: Any) -> Any:
        """End a goal with its result."""
        if self._is_newest(goal):
            self._following = None
        if self.context.ok():
            if goal.is_cancel_requested:
                goal.canceled()
            elif result.error_code == result.SUCCESSFUL:
                goal.succeed()
            else:
                self.get_logger().warning(f"trajectory given up: {result.error_string}")
                goal.abort()
        return result

    def _trajectory_feedback(self, way: Trajectory, seconds: float) -> Any:
        q = way.at([seconds])[0].tolist()
        feedback = FollowJointTrajectory.Feedback(joint_names=list(self.world.robot.joint_names))
        feedback.desired.positions = feedback.actual.positions = q
        feedback.error.positions = [0.0] * len(q)
        return feedback


def make_world(chosen: SimulatorParameters) -> World:
    """A robot with true errors (given, or drawn from the seed), a tracker and faults.

    Raises:
        InputError: A robot, parameter or true deviation that does not exist.
        FileFormatError: The file of the error model is not readable.
    """
    own = cell_of(chosen)
    robot = load_shipped(chosen.robot, chosen.parameters) if own is None else own.load_robot()
    robot = robot.with_parameters(chosen.parameters)
    given = chosen.deviations(robot.available_parameters)
    errors = given or random_deviations(robot, chosen.seed, chosen.length_error, chosen.angle_error)
    instrument = instrument_of(chosen)
    if chosen.instrument != "sigma":
        instrument = read_instrument(config_folder() / "instruments" / f"{chosen.instrument}.yaml")
    model = error_model_of(chosen, robot)
    cell = SimulatedCell(robot, errors, chosen.sigma, instrument, model, chosen.seed)
    return World(cell, chosen, chosen.seed)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(SimulatorNode, SimulatorNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
