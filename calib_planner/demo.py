"""The demonstration without ROS: plan, measure in simulation, identify, compare with truth and chance."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib_planner.design.planner import Progress, plan
from calib_planner.design.problem import PlanProblem
from calib_planner.errors import InputError
from calib_planner.files.estimate_yaml import write_estimate
from calib_planner.files.measurements_csv import write_measurements
from calib_planner.files.plan_yaml import write_plan
from calib_planner.files.text import write_text
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.solver import identify
from calib_planner.report.calibration_report import write_report
from calib_planner.report.demo_report import RANDOM_PLANS, DemoResult, demo_report, draw
from calib_planner.report.provenance import provenance
from calib_planner.robot.chain import Robot
from calib_planner.simulation import SimulatedCell, random_deviations

ROBOT = "kuka_kr270"
TEST_POSE = tuple(np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0]))
"""Upper arm leaning forward, forearm level, wrist bent [rad]."""


@dataclass(frozen=True)
class DemoSettings:
    """What is demonstrated.

    Attributes:
        configurations: Different configurations of the plan.
        repetitions: Measurements at each.
        sigma: Standard deviation of one tracker coordinate [m].
        starts: Random starts of the search.
        random_plans: Random plans to compare with.
        seed: Of the true errors, the noise, the search and the random plans.
    """

    configurations: int = 4
    repetitions: int = 3
    sigma: float = 3e-5
    starts: int = 64
    random_plans: int = RANDOM_PLANS
    seed: int = 0


def run_demo(
    settings: DemoSettings,
    folder: str | Path,
    callback: Callable[[Progress], bool | None] | None = None,
) -> DemoResult:
    """Run the demonstration and leave its files in ``folder``, which is made if need be.

    Raises:
        InputError: The folder cannot be made or written.
    """
    folder = _make(folder)
    robot = Robot.load(ROBOT)
    problem = PlanProblem(
        robot,
        [TEST_POSE],
        settings.configurations,
        settings.repetitions,
        sigma=settings.sigma,
        starts=settings.starts,
        seed=settings.seed,
    )
    found = plan(problem, callback)
    truth_seed, noise_seed, chance_seed = independent_seeds(settings.seed, 3)
    truth = random_deviations(robot, truth_seed)
    cell = SimulatedCell(robot, truth, settings.sigma)
    data = cell.measure(found.configurations, found.repetitions, noise_seed)
    asked = IdentificationProblem(robot, data, settings.sigma, test_poses=[TEST_POSE])
    estimate = identify(asked)
    result = demo_report(
        problem,
        found,
        estimate,
        truth,
        seed=chance_seed,
        random_plans=settings.random_plans,
        report=folder,
    )
    write_plan(folder / "plan.yaml", found)
    write_measurements(folder / "measurements.csv", data)
    write_estimate(folder / "estimate.yaml", estimate)
    made = provenance(
        [("robot", ROBOT), ("data", folder / "measurements.csv")],
        seed=settings.seed,
        estimate=str(folder / "estimate.yaml"),
    )
    write_report(folder / "calibration.html", asked, estimate, made)
    write_text(folder / "demo.json", json.dumps(result.to_dict(), indent=2, ensure_ascii=False) + "\n")
    draw(result, folder / "demo.png")
    return result


def independent_seeds(seed: int, count: int) -> list[int]:
    """Seeds whose random numbers have nothing to do with each other, all from one."""
    return [int(s) for s in np.random.SeedSequence(seed).generate_state(count)]


def _make(folder: str | Path) -> Path:
    path = Path(folder).expanduser()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = f"{folder} ({error.strerror})"
        raise InputError("output", reason, "a folder that can be made", "choose another") from None
    return path
