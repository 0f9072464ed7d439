# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Node ``plan_executor``: executes plans with a real robot's ``FollowJointTrajectory`` controller.

What happens when is in ``execution``, as a value; this file carries its messages. Everything that feeds that
value runs in the node's own callback group, one callback at a time: joint states, what the tracker says, a timer,
and the clients of controller and MoveIt. Whoever is in another thread (a goal, ``~/stop``, an answer) leaves a
note, which the timer reads within ``PERIOD``. A goal of the action and ``~/stop`` wait in threads of their own.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from calib_planner_msgs.action import ExecutePlan
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from unique_identifier_msgs.msg import UUID

from calib_planner.acquisition import NANO, JointReader
from calib_planner.errors import CalibPlannerError
from calib_planner.ros.execution import (
    Action,
    Answered,
    Beam,
    Cancel,
    Confirmed,
    Event,
    Execution,
    Finished,
    Halted,
    Job,
    Joined,
    Looked,
    Outcome,
    Phase,
    PlanWay,
    Send,
    View,
    Watch,
    WayPlanned,
    advance,
    begin,
    job_of,
)
from calib_planner.ros.executor import ACTION, NewestPlan, check_executable, dwell_of, feedback_message
from calib_planner.ros.lifecycle import ERROR, OK, WARN, Finding, ManagedNode
from calib_planner.ros.messages import nanoseconds, plan_from_message
from calib_planner.ros.model import TOPIC, Model, ModelSource
from calib_planner.ros.parameters import STREAM_IN
from calib_planner.ros.planning import plan_pace
from calib_planner.ros.rclpy_ext.polling import Stream, StreamPoller
from calib_planner.ros.rclpy_ext.run import run
from calib_planner.ros.settings import ExecutorParameters
from calib_planner.ros.ways import (
    NO_CONTROL,
    NO_MOVEIT,
    FollowJointTrajectory,
    GetMotionPlan,
    failure_of,
    planned_way,
    planning_request,
    way_to_message,
)
from calib_planner.units import counted, cut, duration

PERIOD = 0.02
"""Time between two looks at the notes and at the clock [s]."""
FEEDBACK_PERIOD = 0.1
"""Time between two messages of feedback [s]."""
LAST_LOOK = 4.0
"""Time that the robot gets to stand still when the node is deactivated or ends [s]."""
STATUS = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_CANCELED: "cancelled",
    GoalStatus.STATUS_ABORTED: "aborted",
}
DONE = {"SUCCESS", "CANCELLED"}


@dataclass(eq=False)
class Run:
    """One goal of the action, from its request to its end.

    Attributes:
        goal: What is wanted.
        since: When it came [s].
        execution: Its execution, once it has begun; replaced by the timer.
        outcome: How it ended, once ``ended`` is set.
    """

    goal: ExecutePlan.Goal
    since: float
    execution: Execution | None = None
    outcome: Outcome | None = None
    ended: threading.Event = field(default_factory=threading.Event)


class ExecutorNode(ManagedNode[ExecutorParameters]):
    """The executor as a node."""

    THREADS = 6

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        self._notes: deque[Callable[[], None]] = deque()
        self._turn = threading.RLock()  # at the end of the process no callback group orders the threads any more
        self._run: Run | None = None
        self._number = 0
        self._names: dict[int, UUID] = {}
        super().__init__("plan_executor", ExecutorParameters(), context, overrides)

    # ── what the node is made of ─────────────────────────────────────────────────────────────────────

    def configure(self) -> None:
        """Load the robot, listen to it and to its tracker, find controller and MoveIt."""
        chosen = self.settings.value
        self._source = ModelSource(chosen)
        self._source.follow(self, self._on_model)
        topics = [t for t in chosen.tracker_state_topics if t]
        self._forget(tuple(Beam(t) for t in topics))
        joints = [Stream(JointState, t, self._on_joints, lambda _: None) for t in chosen.joint_topics]
        self._streams = StreamPoller(self, joints, STREAM_IN)
        for index, topic in enumerate(topics):
            self.create_subscription(Bool, topic, partial(self._on_locked, index), STREAM_IN)
        self._arm = self._ways = None
        if FollowJointTrajectory is not None:
            self._arm = self.create_action_client(FollowJointTrajectory, chosen.controller_action)
            name = f"{chosen.controller_action}/_action/cancel_goal"
            self._canceller = self.create_client(CancelGoal, name)
        if chosen.moveit_group and GetMotionPlan is not None:
            self._ways = self.create_client(GetMotionPlan, chosen.moveit_service)

    def activate(self) -> None:
        """Take plans; say loudly how the robot will move."""
        chosen = self.settings.value
        self._notes.clear()
        self.create_steady_timer(PERIOD, self._tick)
        self.create_action_server(ExecutePlan, ACTION, self._on_goal)
        self._newest = NewestPlan(self, chosen.plan_topic, self._check)
        self.create_trigger("~/confirm", self._confirm)
        self.create_trigger("~/stop", self._halt, callback_group=ReentrantCallbackGroup())
        log = self.get_logger()
        if self._arm is None:
            log.error(f"no plan can be executed: {NO_CONTROL}")
        if chosen.moveit_group and self._ways is None:
            log.error(f"no plan can be executed: moveit_group is set, but {NO_MOVEIT}")
        elif chosen.moveit_group:
            log.info(f"MoveIt plans every move, for its group {chosen.moveit_group}")
        else:
            log.warning(
                "THE ROBOT MOVES ALONG STRAIGHT LINES IN JOINT SPACE and nobody looks for obstacles: plan with "
                "constraints, begin slowly (speed_share), with a hand on the emergency stop, or set moveit_group"
            )

    def deactivate(self) -> None:
        """Stop the robot, if a plan is being executed, and look whether it stands.

        The executor of callbacks waits for this method, so that nothing but the streams is heard meanwhile.
        """
        run, began = self._run, self._time
        if run is None:
            return
        words, end = "the node was deactivated", time.monotonic() + LAST_LOOK
        self._notes.append(partial(self._feed_to, run, Halted("ABORTED", words)))
        stands = False
        while run.outcome is None and not stands and time.monotonic() < end:
            self._tick()
            time.sleep(PERIOD)
            self._streams.poll()
            view = self._view
            stands = view.stands and view.stamp is not None and view.stamp > began + 2.0 * view.watch.still_time
        if stands:
            self._finish(run, Outcome("ABORTED", f"{words}; the robot stands"))
        self._finish(run, Outcome("ABORTED", f"{words}; THE ROBOT WAS NOT SEEN TO STAND: look at it", alarm=True))

    def findings(self) -> Sequence[Finding]:
        """Whether there is a controller, what is being done, and what came of the newest plan."""
        run, name = self._run, self.settings.value.controller_action
        controller = Finding("controller", OK, f"{name} is there")
        if self._arm is None:
            controller = Finding("controller", ERROR, NO_CONTROL)
        elif not self._arm.server_is_ready():
            controller = Finding("controller", WARN, f"nobody offers the action {name}: start the controller")
        execution = None if run is None else run.execution
        words = "waits for a plan" if execution is None else execution.phase.name.lower()
        level = WARN if execution is not None and execution.phase is Phase.CONFIRMING else OK
        words += "; call ~/confirm" if level == WARN else ""
        return (controller, Finding("execution", level, words), *self.newest)

    @property
    def robot_name(self) -> str:
        """The robot that is moved."""
        model = self._source.model
        return model.robot.name if isinstance(model, Model) else ""

    def _forget(self, beams: tuple[Beam, ...]) -> None:
        chosen = self.settings.value
        watch = Watch(**{item.name: getattr(chosen, item.name) for item in fields(Watch)})
        self._view = View(watch, beams)
        self._reader: JointReader | None = None
        if isinstance(self._source.model, Model):
            names = self._source.model.robot.joint_names
            self._reader, self._joined = JointReader(names), Joined.of(len(names))

    # ── what is heard ────────────────────────────────────────────────────────────────────────────────

    def _on_model(self, model: Model) -> None:
        self.get_logger().info(f"{TOPIC}: {model.robot.name}, joints {', '.join(model.robot.joint_names)}")
        self._forget(self._view.beams)
        run, words = self._run, f"another robot was described on {TOPIC} meanwhile"
        if run is not None:
            self._notes.append(partial(self._feed_to, run, Halted("ABORTED", words)))

    def _on_joints(self, message: JointState) -> None:
        if self._reader is None:
            return
        try:
            columns, part = self._reader.read(message)
        except CalibPlannerError as error:
            self.get_logger().warning(f"joint_states: {cut(error, 500)}", throttle_duration_sec=5.0)
            return
        stamp = nanoseconds(message.header.stamp)
        if stamp > 0:
            self._joined, whole = self._joined.part(stamp / NANO, columns, part)
            if whole is not None:
                self._view = self._view.seen(whole, self._joined.joints)

    def _on_locked(self, index: int, message: Bool) -> None:
        self._view = self._view.beam(index, bool(message.data), self._time)

    @property
    def _time(self) -> float:
        return self.now / NANO

    # ── what is wanted ───────────────────────────────────────────────────────────────────────────────

    def _on_goal(self, goal: ServerGoalHandle) -> ExecutePlan.Result:
        wanted = Run(goal.request, self._time)
        self._notes.append(partial(self._want, wanted))
        cancelled = False
        while not wanted.ended.wait(FEEDBACK_PERIOD) and self.context.ok():
            if goal.is_cancel_requested and not cancelled:
                cancelled = True
                self._notes.append(partial(self._feed_to, wanted, Halted("CANCELLED", "stopped on request")))
            if wanted.execution is not None:
                goal.publish_feedback(_feedback(wanted.execution))
        outcome = wanted.outcome or Outcome("ABORTED", "the node is ending")
        executed = 0 if wanted.execution is None else wanted.execution.executed
        status = getattr(ExecutePlan.Result, outcome.status)
        result = ExecutePlan.Result(status=status, message=cut(outcome.message), executed=executed)
        if not self.context.ok():
            return result  # the process is ending, and the result is not sent
        if outcome.status == "SUCCESS":
            goal.succeed()
        elif goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return result

    def _want(self, wanted: Run) -> None:
        """Begin an execution, or refuse it."""
        if self._run is not None:
            self._finish(wanted, Outcome("BUSY", "another plan is being executed: wait for it or cancel it"))
            return
        self._run = wanted
        self._begin(wanted)

    def _begin(self, wanted: Run) -> None:
        """Begin, unless what has to be there is not; where the robot is is waited for."""
        lacking, silence = self._lacking(), self._view.silence(self._time)
        if silence and self._time - wanted.since > self._view.watch.patience:
            lacking = lacking or silence
        if lacking:
            self._finish(wanted, Outcome("NOT_READY", lacking))
            return
        if silence:
            return
        try:
            job = self._job(wanted.goal)
        except CalibPlannerError as error:
            self._finish(wanted, Outcome("INVALID_PLAN", cut(error)))
            return
        log = self.get_logger()
        log.info(f"executing plan {wanted.goal.plan.plan_id}: {self._described(job)}")
        for beam in self._view.beams:
            if beam.locked is None:
                log.warning(f"nothing was heard on {beam.topic}: a lost beam will not stop the robot")
        self._look_around()
        wanted.execution, actions = begin(job, self._view, self._time, self._number)
        self._act(actions)
        self._tell(wanted.execution)

    def _lacking(self) -> str:
        """Why no plan can be executed at all; empty if that is not so."""
        if self._arm is None:
            return NO_CONTROL
        if self.settings.value.moveit_group and self._ways is None:
            return NO_MOVEIT
        model = self._source.model
        return "" if isinstance(model, Model) else str(model)

    def _job(self, goal: ExecutePlan.Goal) -> Job:
        """What a goal means.

        Raises:
            CalibPlannerError: The robot cannot execute it.
        """
        chosen, model = self.settings.value, self._source.model
        assert isinstance(model, Model)
        plan = plan_from_message(goal.plan).plan
        check_executable(plan, model.robot)
        return job_of(
            plan,
            model.robot,
            plan_pace(chosen, model),
            self._view.joints,
            dwell=dwell_of(goal),
            step=chosen.step or goal.step,
            planning_time=chosen.planning_time if chosen.moveit_group else 0.0,
        )

    def _described(self, job: Job) -> str:
        visits, places = counted(len(job.visits), "standstill"), counted(job.total, "configuration")
        share = self.settings.value.speed_share
        return f"{places}, {visits}, about {duration(job.seconds)} at {share:.0%} of the speed"

    def _check(self, goal: ExecutePlan.Goal) -> str:
        """What ``~/execute`` answers.

        Raises:
            CalibPlannerError: The goal would not be executed.
        """
        refused = "another plan is being executed" if self._run is not None else self._lacking()
        refused = refused or self._view.silence(self._time)
        if refused:
            raise CalibPlannerError(refused)
        return self._described(self._job(goal))

    def _confirm(self) -> str:
        run = self._run
        if run is None or run.execution is None:
            raise CalibPlannerError("nothing is being executed: send a plan, or call ~/execute")
        if refused := run.execution.refused_confirmation():
            raise CalibPlannerError(refused)
        self._notes.append(partial(self._feed_to, run, Confirmed()))
        return "confirmed: the robot moves"

    def _halt(self) -> str:
        """Stop the robot; answers when it stands, or when it is not seen to."""
        run = self._run
        if run is None:
            return "nothing is being executed"
        self._notes.append(partial(self._feed_to, run, Halted("STOPPED", "somebody called ~/stop")))
        while not run.ended.wait(FEEDBACK_PERIOD) and self.context.ok() and self.is_active:
            pass
        outcome = run.outcome
        if outcome is None or outcome.alarm:
            raise CalibPlannerError("the node is ending" if outcome is None else outcome.message)
        return outcome.message

    # ── what is done ─────────────────────────────────────────────────────────────────────────────────

    def _tick(self) -> None:
        """Read the notes, look at the clock."""
        with self._turn:
            while self._notes:
                self._notes.popleft()()
            run = self._run
            if run is not None and run.execution is None:
                self._begin(run)
            elif run is not None:
                self._look_around()
                self._feed(Looked())

    def _look_around(self) -> None:
        """Note who is not there."""
        chosen, missing = self.settings.value, []
        if self._arm is not None and not self._arm.server_is_ready():
            missing.append(f"nobody offers {chosen.controller_action}: is the controller active?")
        if self._ways is not None and not self._ways.service_is_ready():
            missing.append(f"nobody offers {chosen.moveit_service}: start move_group, or empty moveit_group")
        self._view = replace(self._view, missing=tuple(missing))

    def _feed_to(self, run: Run, event: Event) -> None:
        """An event for this run, if it is still under way."""
        if run is not self._run:
            return
        if run.execution is None and isinstance(event, Halted):
            self._finish(run, Outcome(event.status, event.message))
        else:
            self._feed(event)

    def _feed(self, event: Event) -> None:
        run = self._run
        if run is None or run.execution is None:
            if isinstance(event, Answered) and event.accepted:
                self._act((Cancel(event.number),))  # nobody would watch the robot
            return
        before = run.execution.phase
        run.execution, actions = advance(run.execution, event, self._view, self._time)
        self._act(actions)
        if run.execution.phase is not before:
            self._tell(run.execution)
        if run.execution.outcome is not None:
            self._finish(run, run.execution.outcome)

    def _tell(self, execution: Execution) -> None:
        """Say where the robot goes, what a person has to do, or what ends the execution."""
        job, goal = execution.job, execution.goal
        if execution.phase is Phase.MOVING and goal is not None and not goal.arrived:
            words = f"configuration {execution.index}, standstill {execution.visit + 1} of {len(job.visits)}"
            self.get_logger().info(f"{words}: moving for {goal.way.seconds:.1f} s")
        if execution.phase is Phase.CONFIRMING:
            rows = job.visits[execution.visit].waypoints[-1].tolist()
            names = zip(job.joint_names, rows, strict=True)
            place = ", ".join(f"{name}={value:.4f}" for name, value in names)
            self.get_logger().warning(f"configuration {execution.index} ({place}) is next: call ~/confirm")
        elif execution.phase is Phase.STOPPING and execution.ending is not None:
            text = f"stopping the robot: {execution.ending.message}"
            if execution.ending.status == "CANCELLED":  # a campaign does so with what it has heard enough of
                self.get_logger().info(text)
            else:
                self.get_logger().warning(text)

    def _finish(self, run: Run, outcome: Outcome) -> None:
        if run.outcome is not None:
            return
        run.outcome = outcome
        if self._run is run:
            self._run = None
        run.ended.set()
        if self.context.ok():
            log, text = self.get_logger(), f"{outcome.status}: {outcome.message}"
            # A line of code logs at one severity only: rclpy refuses another one from the same place.
            if outcome.alarm:
                log.error(text)
            elif outcome.status in DONE:
                log.info(text)
            else:
                log.warning(text)
            level = ERROR if outcome.alarm else OK if outcome.status in DONE else WARN
            self.outcome("newest plan", level, text)

    def _act(self, actions: Sequence[Action]) -> None:
        for action in actions:
            self._number = max(self._number, action.number)
            if isinstance(action, Send):
                self._send(action)
            elif isinstance(action, Cancel):
                self._cancel(action.number)
            else:
                self._plan_way(action)

    def _send(self, action: Send) -> None:
        assert self._arm is not None and self._run is not None and self._run.execution is not None
        names = self._run.execution.job.joint_names
        goal = FollowJointTrajectory.Goal(trajectory=way_to_message(action.way, names))
        name = self._names[action.number] = UUID(uuid=list(uuid.uuid4().bytes))
        sent = self._arm.send_goal_async(goal, goal_uuid=name)
        sent.add_done_callback(lambda future: self._notes.append(partial(self._answered, action.number, future)))

    def _answered(self, number: int, future: Any) -> None:
        handle: Any = future.result() if future.exception() is None else None
        accepted = bool(handle and handle.accepted)
        if accepted:
            done = handle.get_result_async()
            done.add_done_callback(lambda future: self._notes.append(partial(self._over, number, future)))
        else:
            self._names.pop(number, None)
        self._feed(Answered(number, accepted))

    def _over(self, number: int, future: Any) -> None:
        self._names.pop(number, None)
        if future.exception() is not None:
            self._feed(Finished(number, succeeded=False, reason=str(future.exception())))
            return
        answer = future.result()
        failure = failure_of(STATUS.get(answer.status, "lost"), answer.result)
        self._feed(Finished(number, not failure, failure))

    def _cancel(self, number: int) -> None:
        """Cancel a goal of the controller by its name: that works before its answer is heard, too."""
        name = self._names.get(number)
        if name is not None:
            request = CancelGoal.Request()
            request.goal_info.goal_id = name
            self._canceller.call_async(request)

    def _plan_way(self, action: PlanWay) -> None:
        assert self._ways is not None and self._run is not None and self._run.execution is not None
        chosen, names = self.settings.value, self._run.execution.job.joint_names
        start = action.start
        request = planning_request(
            chosen.moveit_group, names, start, action.goal, chosen.planning_time, chosen.speed_share
        )

        def planned(future: Any) -> None:
            if future.exception() is not None:
                way, reason = None, str(future.exception())
            else:
                way, reason = planned_way(future.result(), names, start)
            self._feed(WayPlanned(action.number, way, reason))

        self._ways.call_async(request).add_done_callback(
            lambda future: self._notes.append(partial(planned, future))
        )


def _feedback(execution: Execution) -> ExecutePlan.Feedback:
    """What an execution does, as feedback."""
    words = {
        Phase.PLANNING: "PLANNING",
        Phase.CONFIRMING: "CONFIRMING",
        Phase.MEASURING: "MEASURING",
        Phase.LEAVING: "MEASURING",
    }
    phase, total = words.get(execution.phase, "MOVING"), execution.job.total
    return feedback_message(phase, execution.index, total, execution.executed, execution.elapsed)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(ExecutorNode, ExecutorNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
