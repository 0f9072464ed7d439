"""``python -m calib_planner.ros.demo``: a KUKA KR-270 is calibrated over ROS 2, start to end.

Three processes (planner, identifier, simulated tracker) with DDS between them, and this one that asks for a
plan, has it measured, and compares what was identified with the truth that only the simulator knew. The truth
comes from the seed, by the function that the simulator uses; it never travels.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import PlanCalibration
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from calib_planner.demo import DemoResult, demo_report, draw, print_table
from calib_planner.errors import CalibPlannerError
from calib_planner.planning import PlanProblem
from calib_planner.robot import Robot
from calib_planner.ros.conversions import estimate_from_message, plan_from_message
from calib_planner.ros.demo_client import DemoClient
from calib_planner.ros.processes import Nodes, own_domain
from calib_planner.simulation import random_deviations

ROBOT, LEVEL = "kuka_kr270", "lengths+offsets"
TEST_POSE = tuple(math.radians(x) for x in (0, -60, 90, 0, 45, 0))
SIGMA = 3e-5
"""Standard deviation of one coordinate of one tracker point [m]."""
SAMPLES = 20
"""Points averaged per measurement."""


@dataclass
class Screen:
    """Progress on stderr: a moving bar on a terminal, lines elsewhere."""

    console: Console = field(default_factory=lambda: Console(stderr=True))

    def __post_init__(self) -> None:
        self._live = self.console.is_terminal
        self._began, self._said = time.monotonic(), ""
        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        self._bar = Progress(*columns, console=self.console, transient=True, disable=not self._live)
        self._task = self._bar.add_task("starting", total=None)
        self._bar.start()

    def say(self, text: str, done: int | None = None, total: int | None = None) -> None:
        """Show what is being done, and how far it is."""
        if self._live:
            self._bar.update(self._task, description=text, completed=done or 0, total=total)
        elif text != self._said:
            self.console.print(f"{time.monotonic() - self._began:5.1f} s  {text}", highlight=False)
        self._said = text

    def stop(self) -> None:
        """Leave the terminal clean."""
        self._bar.stop()


@dataclass(frozen=True)
class Options:
    """What the demo is asked for; ``folder`` gets the files."""

    configurations: int
    seed: int
    folder: Path


def run_demo(options: Options, screen: Screen) -> DemoResult:
    """Plan, measure and identify; returns the comparison with the truth.

    Raises:
        CalibPlannerError: Says what failed, with the last lines of a node that ended.
    """
    with own_domain() as domain, Nodes(options.folder / "log", domain) as nodes:
        screen.say("starting planner, identifier and simulated tracker")
        nodes.start("planner_node", {"robot": ROBOT})
        save = {"save_folder": f"'{options.folder.resolve()}'", "samples": SAMPLES, "sigma": SIGMA}
        nodes.start("identifier_node", {"robot": ROBOT} | save)
        nodes.start("simulator_node", {"robot": ROBOT, "seed": options.seed, "sigma": SIGMA})
        client = DemoClient(domain, nodes.check)
        try:
            plan = _measure(options, client, screen)
            screen.say("saving")
            screen.console.print(client.save(), highlight=False)
            estimate = estimate_from_message(client.estimate)
        finally:
            client.close()
    screen.say("comparing with random plans")
    robot = Robot.load(ROBOT).with_parameters(LEVEL)
    received = plan_from_message(plan).plan
    problem = PlanProblem(robot, [TEST_POSE], options.configurations, sigma=received.sigma)
    truth = random_deviations(robot, options.seed)
    result = demo_report(problem, received, estimate, truth, seed=options.seed, report=options.folder)
    draw(result, options.folder / "demo.png")
    (options.folder / "demo.json").write_text(json.dumps(result.to_dict(), indent=2) + "\n")
    return result


def _measure(options: Options, client: DemoClient, screen: Screen) -> PlanMessage:
    """Have a plan made and measured; the client then holds the estimate."""
    screen.say("waiting for the planner")
    request = PlanCalibration.Request(
        robot=ROBOT,
        parameters=[LEVEL],
        test_poses=list(TEST_POSE),
        configurations=options.configurations,
        sigma=SIGMA / math.sqrt(SAMPLES),
        seed=options.seed,
    )
    screen.say(f"planning {options.configurations} configurations")
    plan = client.request_plan(request)
    best = 1e3 * plan.predicted_accuracy
    screen.console.print(
        f"planned: ρ0 = {best:.4f} mm at the test pose, at least {100 * plan.efficiency:.0f} % of what any "
        f"plan could reach ({plan.seconds:.1f} s)",
        highlight=False,
    )
    client.wait(lambda: client.identifier_has(plan.plan_id), 30.0, "estimate from the identifier")

    def show() -> None:
        done = client.estimate.measurements if client.estimate else 0
        screen.say(f"measured {done} of {len(plan.repetitions)}{_error(client)}", done, len(plan.repetitions))

    client.execute(plan, 60.0 + 5.0 * options.configurations, show)
    return plan


def _error(client: DemoClient) -> str:
    """What the newest estimate promises, in words."""
    accuracy = np.asarray(client.estimate.predicted_accuracy) if client.estimate else np.empty(0)
    if not accuracy.size:
        return ""
    return f", error at the test pose now {1e3 * accuracy[0]:.4f} mm (1 std)"


def main(args: Sequence[str] | None = None) -> int:
    """Command line of the demo; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m calib_planner.ros.demo",
        description="Calibrate a simulated KUKA KR-270 over ROS 2 and compare with the truth.",
    )
    parser.add_argument("--configurations", type=int, default=12, help="configurations (default 12)")
    parser.add_argument("--seed", type=int, default=0, help="seed of true errors, noise and search")
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
        result = run_demo(Options(chosen.configurations, chosen.seed, chosen.output), screen)
    except (CalibPlannerError, OSError) as error:
        screen.stop()
        print(f"demo: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        screen.stop()
        print("demo: interrupted; all nodes were ended", file=sys.stderr)
        return 130
    screen.stop()
    if chosen.json:
        print(json.dumps(result.to_dict()))
    else:
        console = Console()
        print_table(result, console)
        console.print(f"files in {result.report}:", highlight=False)
        for path in sorted(p for p in chosen.output.iterdir() if p.is_file()):
            console.print(f"  {path}", highlight=False)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
