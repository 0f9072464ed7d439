# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m calib_planner.ros.demo``: a KUKA KR-270 is calibrated over ROS 2 from start to end.

Three processes (planner, identifier, simulated tracker) with DDS between them, and this one that asks for a plan,
has it measured, and compares what was identified with the truth that only the simulator knew. The truth follows
from the seed by the function that the simulator uses; no message carries it.

``DemoClient`` repeats calls after a time-out, since an answer can be published before discovery has matched its
reader. Every wait has a deadline.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rclpy
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import CalibrationEstimate, JointConfiguration, Measurement, PlanRequest
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import PlanCalibration
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from std_srvs.srv import Trigger

from calib_planner.demo import (
    ERROR_MODEL,
    PAGE,
    ROBOT,
    SEED,
    TEST_POSE,
    DemoResult,
    demo_cell,
    demo_report,
    draw,
    print_files,
    print_table,
)
from calib_planner.errors import CalibPlannerError, InfeasibleError
from calib_planner.identification import IdentificationProblem, identify
from calib_planner.io import fresh_folder, read_data, read_estimate
from calib_planner.planning import PlanProblem
from calib_planner.report import provenance, write_report
from calib_planner.robot import Robot
from calib_planner.ros.messages import duration_message, plan_from_message, seconds_of
from calib_planner.ros.parameters import EVENTS, LATCHED
from calib_planner.ros.processes import Nodes, own_domain, undisturbed
from calib_planner.units import length

ATTEMPT = 8.0
"""Seconds after which an unanswered call is repeated."""
PLANNING = 40.0
"""Longest search of the plan [s]; the planner answers when it has ended."""
NOT_YET = (PlanCalibration.Response.BUSY, PlanCalibration.Response.NOT_READY)
"""Answers of a planner that is still planning or not active yet: the call is repeated after ``PAUSE``."""
PAUSE = 0.3
"""Time between a call that came too early and the next one [s]."""
LEVEL = "lengths+offsets"
SIGMA = 3e-5
"""Standard deviation of one coordinate of one tracker point [m]."""
SAMPLES = 20
"""Points averaged per measurement."""


class DemoClient:
    """Talks to the three nodes; its node is spun while it waits.

    Args:
        domain: ROS domain id.
        check: Called while waiting; raises if something is wrong, for example a node has ended.
        name: Name of its node.
    """

    def __init__(
        self, domain: int, check: Callable[[], None] = lambda: None, name: str = "calibration_demo"
    ) -> None:
        self._check = check
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self._node = Node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.estimate: CalibrationEstimate | None = None
        self.measurements: list[Measurement] = []
        create = self._node.create_subscription
        create(CalibrationEstimate, "calibration_identifier/estimate", self._on_estimate, LATCHED)
        create(Measurement, "calibration_identifier/measurements", self.measurements.append, EVENTS)
        self._plan = self._node.create_client(PlanCalibration, "calibration_planner/request_plan")
        self._save = self._node.create_client(Trigger, "calibration_identifier/save")
        self._execute = ActionClient(self._node, ExecutePlan, "tracker_simulator/execute_plan")

    def close(self) -> None:
        """Leave the graph."""
        self._execute.destroy()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait(self, condition: Callable[[], bool], seconds: float, what: str = "") -> bool:
        """Spin until ``condition``; after ``seconds`` return ``False``, or raise if ``what`` names a thing."""
        deadline = time.monotonic() + seconds
        while not condition():
            self._check()
            if time.monotonic() > deadline:
                if what:
                    raise CalibPlannerError(f"no {what} within {seconds:g} s")
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def request_plan(self, request: PlanCalibration.Request, seconds: float = 180.0) -> PlanMessage:
        """The plan for ``request``.

        Raises:
            InfeasibleError: The planner refused; the error says why.
        """
        response = self._call(self._plan, request, seconds, "plan", PLANNING + ATTEMPT)
        if response.status != PlanCalibration.Response.SUCCESS:
            raise InfeasibleError(response.field or "request", response.message)
        return response.plan

    def save(self, seconds: float = 20.0) -> str:
        """Have the identifier save; returns its answer."""
        response = self._call(self._save, Trigger.Request(), seconds, "answer from save")
        if not response.success:
            raise CalibPlannerError(f"saving failed: {response.message}")
        return str(response.message)

    def identifier_has(self, plan_id: str) -> bool:
        """Whether the identifier has taken the plan."""
        return self.estimate is not None and self.estimate.plan_id == plan_id

    def measured(self, plan: PlanMessage) -> list[int]:
        """Accepted measurements per configuration."""
        counts = [0] * len(plan.repetitions)
        for m in self.measurements:
            if m.plan_id == plan.plan_id and m.status == Measurement.ACCEPTED:
                counts[m.configuration_index] += 1
        return counts

    def complete(self, plan: PlanMessage) -> bool:
        """Whether the newest estimate covers the whole plan."""
        return self.identifier_has(plan.plan_id) and bool(self.estimate.complete)  # type: ignore[union-attr]

    def execute(self, plan: PlanMessage, seconds: float, on_progress: Callable[[], None] = lambda: None) -> None:
        """Have a plan measured until the estimate covers it; what was not accepted is measured again.

        Raises:
            CalibPlannerError: The simulator refused, or time ran out.
        """
        deadline = time.monotonic() + seconds

        def progressing() -> bool:
            on_progress()
            return self.complete(plan)

        self.wait(self._execute.server_is_ready, 30.0, "simulator (tracker_simulator/execute_plan)")
        while not self.complete(plan) and time.monotonic() < deadline:
            result = self._run(self._missing(plan), progressing, deadline)
            if result is not None and result.status == ExecutePlan.Result.INVALID_PLAN:
                raise CalibPlannerError(f"the simulator refused the plan: {result.message}")
            self.wait(progressing, 2.0)
        if not self.complete(plan):
            reasons = {m.reason for m in self.measurements if m.reason}
            text = f"only {sum(self.measured(plan))} measurements after {seconds:g} s"
            raise CalibPlannerError(f"{text}; {'; '.join(sorted(reasons))}")

    def _run(self, plan: PlanMessage, done: Callable[[], bool], deadline: float) -> ExecutePlan.Result | None:
        """One execution to its end; ``None`` if nobody answered."""
        sent = self._execute.send_goal_async(ExecutePlan.Goal(plan=plan))
        self.wait(lambda: sent.done() or done(), ATTEMPT)
        if not sent.done() or sent.result() is None:
            # There was no answer; the goal may run all the same, and the estimates then show its end.
            self.wait(done, ATTEMPT)
            return None
        finished = sent.result().get_result_async()
        self.wait(lambda: finished.done() or done(), max(deadline - time.monotonic(), 0.0))
        return finished.result().result if finished.done() else None

    def _missing(self, plan: PlanMessage) -> PlanMessage:
        left = [max(r - c, 0) for r, c in zip(plan.repetitions, self.measured(plan), strict=True)]
        rows = [i for i, count in enumerate(left) if count] or list(range(len(left)))
        return PlanMessage(
            plan_id=plan.plan_id,
            robot=plan.robot,
            parameters=plan.parameters,
            joint_names=plan.joint_names,
            configurations=[plan.configurations[i] for i in rows],
            repetitions=[max(left[i], 1) for i in rows],
            sigma=plan.sigma,
        )

    def _call(self, client: Any, request: Any, seconds: float, what: str, attempt: float = ATTEMPT) -> Any:
        deadline = time.monotonic() + seconds
        self.wait(client.service_is_ready, seconds, f"service {client.srv_name}")
        while time.monotonic() < deadline:
            future = client.call_async(request)
            if self.wait(future.done, attempt):
                response = future.result()
                later = time.monotonic() + PAUSE < deadline
                if not later or getattr(response, "status", 0) not in NOT_YET:
                    return response
                self.wait(lambda: False, PAUSE)
            client.remove_pending_request(future)
        raise CalibPlannerError(f"no {what} within {seconds:g} s")

    def _on_estimate(self, message: CalibrationEstimate) -> None:
        self.estimate = message


class Screen:
    """Progress on stderr: a moving bar on a terminal, lines elsewhere."""

    def __init__(self) -> None:
        self.console = Console(stderr=True, highlight=False)
        self._began, self._text = time.monotonic(), ""
        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        self._bar = Progress(*columns, console=self.console, transient=True, disable=not self.console.is_terminal)
        self._task = self._bar.add_task("starting", total=None)
        self._bar.start()

    def say(self, text: str, done: int = 0, total: int | None = None) -> None:
        """Show what is being done, and how far it is."""
        self._bar.update(self._task, description=text, completed=done, total=total)
        if self._bar.disable and text != self._text:
            self.console.print(f"{time.monotonic() - self._began:5.1f} s  {text}")
        self._text = text

    def close(self) -> None:
        """Leave the terminal clean."""
        self._bar.stop()


def run_demo(configurations: int, seed: int, folder: Path, screen: Screen) -> DemoResult:
    """Plan, measure and identify; returns the comparison with the truth.

    Args:
        configurations: Configurations of the plan.
        seed: Seed of true errors, noise and search.
        folder: The folder for all files.
        screen: Shows the progress.

    Raises:
        CalibPlannerError: The error says what failed, with the last lines of a node that ended.
    """
    with own_domain() as domain, undisturbed() as signals, Nodes(folder / "log", domain) as nodes:

        def check() -> None:
            """Not in the middle of what rclpy does: there KeyboardInterrupt can become another exception."""
            if signals:
                raise KeyboardInterrupt
            nodes.check()

        screen.say("starting planner, identifier and simulated tracker")
        nodes.start("planner_node", {"robot": ROBOT, "error_model": ERROR_MODEL})
        save = {"save_folder": f"'{folder.resolve()}'", "samples": SAMPLES, "sigma": SIGMA}
        nodes.start("identifier_node", {"robot": ROBOT} | save)
        nodes.start("simulator_node", {"robot": ROBOT, "seed": seed, "sigma": SIGMA, "error_model": ERROR_MODEL})
        client = DemoClient(domain, check)
        try:
            plan = _measure(configurations, seed, client, screen)
            screen.say("saving")
            screen.console.print(client.save())
        finally:
            client.close()
    screen.say("comparing with random plans")
    robot = Robot.load(ROBOT).with_parameters(LEVEL)
    received = plan_from_message(plan).plan
    problem = PlanProblem(robot, [TEST_POSE], configurations, noise=received.sigma)
    saved = read_estimate(newest(folder, "estimate_*.yaml"))
    cell, learnt = demo_cell(robot, seed, received.sigma), (saved.knowledge(robot), saved.calibrated(robot))
    result = demo_report(problem, received, *learnt, cell, seed=seed, report=folder)
    draw(result, folder / "demo.png")
    screen.say("writing the report")
    report(folder, robot, seed)
    (folder / "demo.json").write_text(json.dumps(result.to_dict(), indent=2) + "\n")
    return result


def newest(folder: Path, pattern: str) -> Path:
    """The file written last of those whose names fit."""
    return max(folder.glob(pattern), key=lambda path: path.stat().st_mtime)


def report(folder: Path, robot: Robot, seed: int) -> None:
    """Write the page: the fit of all saved measurements, which the identifier makes when a plan is complete."""
    path = newest(folder, "measurements_*.csv")
    problem = IdentificationProblem(robot, read_data(path, robot).data, test_poses=[TEST_POSE])
    files: list[tuple[str, str | Path]] = [("robot", ROBOT), ("data", path)]
    made = provenance(files, seed=seed, estimate=str(newest(folder, "estimate_*.yaml")))
    write_report(folder / PAGE, problem, identify(problem), made)


def _measure(configurations: int, seed: int, client: DemoClient, screen: Screen) -> PlanMessage:
    """Have a plan made and measured; the client holds the estimate afterwards."""
    screen.say("waiting for the planner")
    request = PlanRequest(
        robot=ROBOT,
        parameters=[LEVEL],
        test_poses=[JointConfiguration(positions=list(TEST_POSE))],
        configurations=configurations,
        sigma=SIGMA / math.sqrt(SAMPLES),
        seed=seed,
        time_limit=duration_message(PLANNING),
    )
    screen.say(f"planning {configurations} configurations")
    plan = client.request_plan(PlanCalibration.Request(request=request))
    best = 1e3 * plan.predicted_accuracy
    screen.console.print(
        f"planned: ρ0 = {best:.4f} mm at the test pose, at least {100 * plan.efficiency:.0f} % of what any "
        f"plan could reach ({seconds_of(plan.search_time):.1f} s)"
    )
    client.wait(lambda: client.identifier_has(plan.plan_id), 30.0, "estimate from the identifier")

    def show() -> None:
        estimate, total = client.estimate, len(plan.repetitions)
        done = estimate.measurements if estimate else 0
        accuracy = list(estimate.predicted_accuracy) if estimate else []
        error = f", error at the test pose now {length(accuracy[0])} (1 std)" if accuracy else ""
        screen.say(f"measured {done} of {total}{error}", done, total)

    client.execute(plan, 60.0 + 5.0 * configurations, show)
    return plan


def main(args: Sequence[str] | None = None) -> int:
    """Command line of the demo; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m calib_planner.ros.demo",
        description="Calibrate a simulated KUKA KR-270 over ROS 2 and compare with the truth.",
    )
    parser.add_argument("--configurations", type=int, default=30, help="configurations (default 30)")
    parser.add_argument("--seed", type=int, default=SEED, help=f"seed of true errors, noise and search ({SEED})")
    parser.add_argument("--output", type=Path, default=Path("calib_planner_demo"), help="folder for files")
    parser.add_argument("--json", action="store_true", help="the result as one JSON object on stdout")
    chosen = parser.parse_args(args)
    if not 1 <= chosen.configurations <= 200:
        parser.error("--configurations: a whole number from 1 to 200")
    if not 0 <= chosen.seed < 2**31:
        parser.error("--seed: a whole number from 0 to 2147483647")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends the nodes, as Ctrl-C does
    screen = Screen()
    try:
        result = run_demo(chosen.configurations, chosen.seed, fresh_folder(chosen.output), screen)
    except (CalibPlannerError, OSError) as error:
        screen.close()
        print(f"demo: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        screen.close()
        print("demo: interrupted; all nodes were ended", file=sys.stderr)
        return 130
    screen.close()
    if chosen.json:
        print(json.dumps(result.to_dict()))
    else:
        console = Console()
        print_table(result, console)
        print_files(result.report, console)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
