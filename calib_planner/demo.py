# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The demonstration without ROS: plan, measure in simulation, identify, compare with the truth and with chance.

The robot errs as real ones do: in its parameters, under gravity, by its joints' own functions, and a little anew
at each visit. So something remains after its calibration, about a tenth of a millimetre; and more for a URDF,
which holds placement alone.

``demo_report`` needs the hidden truth, so it works in simulation only; the demonstration over ROS uses it, too.
The library itself makes the comparison with chance: random plans of the same size, the same true robot, the same
noise, fresh draws.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from calib_planner.arrays import FloatArray, plain
from calib_planner.error_model import Knowledge
from calib_planner.errors import InputError
from calib_planner.identification import IdentificationProblem, identify
from calib_planner.io import (
    fresh_folder,
    planned_error_model,
    read_error_model,
    write_estimate,
    write_measurements,
    write_plan,
    write_text,
)
from calib_planner.planning import Callback, Plan, PlanProblem, Search, plan
from calib_planner.report import provenance, write_report
from calib_planner.robot import Robot
from calib_planner.simulation import SimulatedCell, independent_seeds, random_deviations
from calib_planner.units import MILLI_UNIT, milli, signed

RANDOM_PLANS = 12
"""Random plans that stand for chance: one alone may be lucky. Each takes half a second."""
PAGE = "calibration.html"
"""The report, in the folder of a demonstration."""
ROBOT = "kuka_kr270"
SEED = 0
"""One robot, the first: not chosen by its result. It errs by 8.9 mm at the test pose before its calibration; the
robots of seeds 0 … 19 err by 0.6 … 14.9 mm."""
ERROR_MODEL = "typical"
"""How the robot of the demonstrations errs besides its parameters, see ``read_error_model``."""
TEST_POSE = tuple(np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0]))
"""Upper arm leaning forward, forearm level, wrist bent [rad]."""


@dataclass(frozen=True)
class DemoSettings:
    """What is demonstrated.

    Attributes:
        configurations: Different configurations of the plan.
        repetitions: Measurements at each.
        sigma: Standard deviation of one tracker coordinate [m].
        starts: Random starts of the search; ``None``: as many as usual.
        random_plans: Random plans to compare with.
        seed: Of the true errors, the noise, the search and the random plans.
    """

    configurations: int = 30
    repetitions: int = 1
    sigma: float = 3e-5
    starts: int | None = None
    random_plans: int = RANDOM_PLANS
    seed: int = SEED


@dataclass(frozen=True)
class DemoParameter:
    """One parameter: nominal, true (simulated) and identified value with its std, in ``unit``, m or rad."""

    name: str
    unit: str
    nominal: float
    true: float
    value: float
    std: float


@dataclass(frozen=True)
class DemoResult:
    """What was achieved, beside what was predicted.

    Attributes:
        robot: Name of the robot.
        configurations, measurements: Size of the plan.
        sigma: Standard deviation of one measured coordinate [m].
        before, after: Position error at the test poses, root mean square over them [m].
        placement_alone: The same of placement alone, as a URDF holds it [m].
        predicted_accuracy: What the estimate predicts for ``after``, (M3) [m].
        random_after: As ``after``, root mean square over ``random_plans`` random plans of equal size [m].
        random_predicted_accuracy: As ``predicted_accuracy``, likewise [m].
        random_plans: Number of random plans.
        parameters: Parameter by parameter.
        report: Folder with the files.
    """

    robot: str
    configurations: int
    measurements: int
    sigma: float
    before: float
    after: float
    placement_alone: float
    predicted_accuracy: float
    random_after: float
    random_predicted_accuracy: float
    random_plans: int
    parameters: tuple[DemoParameter, ...]
    report: str

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers, the keys of the contract; non-finite numbers become ``None``."""
        result: dict[str, Any] = plain(asdict(self))
        return result


def run_demo(
    settings: DemoSettings,
    folder: str | Path,
    callback: Callback | None = None,
) -> DemoResult:
    """Run the demonstration; its files are in a new folder: ``folder``, or beside earlier ones ``folder-2``, ….

    Raises:
        InputError: The folder cannot be made or written.
    """
    folder, robot, size = fresh_folder(folder), Robot.load(ROBOT), (settings.configurations, settings.repetitions)
    search = Search(starts=settings.starts, seed=settings.seed)
    model = planned_error_model(ERROR_MODEL, robot, settings.sigma)
    problem = PlanProblem(robot, [TEST_POSE], *size, error_model=model, search=search)
    best = plan(problem, callback)
    noise_seed, chance_seed = independent_seeds(settings.seed, 2)
    cell = demo_cell(robot, settings.seed, settings.sigma)
    data = cell.measure(best.configurations, best.repetitions, noise_seed)
    measured = IdentificationProblem(robot, data, settings.sigma, test_poses=[TEST_POSE])
    estimate = identify(measured)
    result = demo_report(
        problem,
        best,
        estimate.knowledge,
        estimate.calibrated,
        cell,
        seed=chance_seed,
        random_plans=settings.random_plans,
        report=folder,
    )
    write_plan(folder / "plan.yaml", best)
    write_measurements(folder / "measurements.csv", data)
    write_estimate(folder / "estimate.yaml", estimate, problem=measured)
    files: list[tuple[str, str | Path]] = [("robot", ROBOT), ("data", folder / "measurements.csv")]
    made = provenance(files, seed=settings.seed, estimate=str(folder / "estimate.yaml"))
    write_report(folder / PAGE, measured, estimate, made)
    write_text(folder / "demo.json", json.dumps(result.to_dict(), indent=2, ensure_ascii=False) + "\n")
    draw(result, folder / "demo.png")
    return result


def demo_cell(robot: Robot, seed: int, sigma: float) -> SimulatedCell:
    """The robot of the demonstrations, its errors drawn from ``seed``, before a tracker of ``sigma`` [m]."""
    model = read_error_model(ERROR_MODEL)
    return SimulatedCell(robot, random_deviations(robot, seed), sigma, error_model=model, seed=seed)


# ── truth beside estimate, before beside after, planned beside random ────────────────────────────────


def demo_report(
    problem: PlanProblem,
    plan: Plan,
    known: Knowledge,
    calibrated: Robot,
    cell: SimulatedCell,
    *,
    seed: int = 0,
    random_plans: int = RANDOM_PLANS,
    report: str | Path = "",
) -> DemoResult:
    """Compare an estimate with the truth, and the plan with random ones.

    Args:
        problem: The problem that ``plan`` solves; the random plans are measured with its noise.
        plan: What was measured.
        known: What was identified, with all terms.
        calibrated: The robot of placement alone.
        cell: What was measured: the true robot before its tracker.
        seed: Of the random plans and their noise.
        random_plans: Their number.
        report: Folder named in the result.

    Raises:
        InputError: The estimate lacks parameters of the problem.
    """
    robot, poses = problem.robot, problem.test_pose_array
    names = known.robot.parameter_names
    deviations = dict(zip(names, known.coefficients[: len(names)].tolist(), strict=True))
    spread = np.sqrt(np.diag(known.covariance)[: len(names)])
    std = dict(zip(names, np.where(spread > 0.0, spread, np.nan).tolist(), strict=True))
    missing = [p.name for p in robot.parameters if p.name not in deviations]
    if missing:
        raise InputError("estimate", f"no {', '.join(missing)}", "all parameters of the problem")
    random_after, random_accuracy = _random_plans(problem, cell, seed, random_plans)
    parameters = []
    for p in robot.parameters:
        true, value = p.nominal + float(cell.deviations.get(p.name, 0.0)), p.nominal + deviations[p.name]
        parameters.append(DemoParameter(p.name, p.unit, p.nominal, true, value, std[p.name]))
    return DemoResult(
        robot=robot.name,
        configurations=len(plan.configurations),
        measurements=plan.measurements,
        sigma=problem.instrument.typical,
        before=_rms(cell.position_errors(robot, poses)),
        after=_rms(_apart(cell, poses, known.poses(poses).points)),
        placement_alone=_rms(cell.position_errors(calibrated, poses)),
        predicted_accuracy=known.accuracy(poses, weights=problem.weight_array).value,
        random_after=random_after,
        random_predicted_accuracy=random_accuracy,
        random_plans=random_plans,
        parameters=tuple(parameters),
        report=str(report),
    )


def _random_plans(problem: PlanProblem, cell: SimulatedCell, seed: int, count: int) -> tuple[float, float]:
    """Achieved and predicted accuracy [m], root mean square over random plans of the problem's size."""
    robot, poses, sigma = problem.robot, problem.test_pose_array, problem.instrument.typical
    rng = np.random.default_rng([seed, 3])  # a stream of its own: the truth has [seed, 1]
    low, high = robot.joint_limits.T
    after, predicted = [], []
    for _ in range(count):
        q = rng.uniform(low, high, (problem.configurations, len(low)))
        data = cell.measure(q, problem.repetitions, int(rng.integers(2**31)))
        known = identify(IdentificationProblem(robot, data, sigma=sigma)).knowledge
        predicted.append(known.accuracy(poses, weights=problem.weight_array).value)
        after.append(_rms(_apart(cell, poses, known.poses(poses).points)))
    return _rms(np.array(after)), _rms(np.array(predicted))


def _apart(cell: SimulatedCell, poses: FloatArray, predicted: FloatArray) -> FloatArray:
    """(K, targets) distances between the true targets and ``predicted`` (K, targets, 3) at ``poses`` [m]."""
    return np.asarray(np.linalg.norm(cell.truth.positions(poses) - predicted, axis=2))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# ── for people ───────────────────────────────────────────────────────────────────────────────────────


def _shown_errors(result: DemoResult) -> list[tuple[str, str, str, float, float | None]]:
    """Of each comparison: name in the table and in the picture, colour, achieved and predicted error [mm]."""
    size, chance = f"{result.configurations} configurations", f"(RMS of {result.random_plans}"
    return [
        ("before calibration", "before", "0.6", 1e3 * result.before, None),
        (f"planned, {size}", "planned", "C0", 1e3 * result.after, 1e3 * result.predicted_accuracy),
        ("… placement alone, as a URDF holds it", "… as a URDF", "C2", 1e3 * result.placement_alone, None),
        (
            f"random, {size} {chance} plans)",
            f"random\n{chance})",
            "C1",
            1e3 * result.random_after,
            1e3 * result.random_predicted_accuracy,
        ),
    ]


def print_table(result: DemoResult, console: Console) -> None:
    """Two tables: parameter by parameter, and the error at the test pose."""
    table = Table(title=Text(f"{result.robot}: deviations from nominal"))
    table.add_column("parameter")
    table.add_column("unit")
    for heading in ("true", "identified", "± std", "off by"):
        table.add_column(heading, justify="right")
    for p in result.parameters:
        off = abs(p.value - p.true) / p.std if p.std > 0 else float("nan")
        numbers = [signed(1e3 * x, 4, plus=True) for x in (p.true - p.nominal, p.value - p.nominal)]
        table.add_row(p.name, MILLI_UNIT[p.unit], *numbers, milli(p.std), f"{off:.1f} std")
    console.print(table)
    errors = Table(title=Text("position error at the test pose [mm]"))  # as Text: brackets are no markup
    errors.add_column("")
    errors.add_column(Text("achieved [mm]"), justify="right")
    errors.add_column(Text("predicted [mm]"), justify="right")
    for name, _, _, achieved, predicted in _shown_errors(result):
        errors.add_row(name, f"{achieved:.4f}", "" if predicted is None else f"{predicted:.4f}")
    console.print(errors)
    console.print(
        f"One measured coordinate has a standard deviation of {milli(result.sigma)} mm. The robot also errs "
        "under gravity, by its joints and a little anew at each visit: that is what remains. "
        "The random plans were measured in simulation by the library: same true robot, same noise."
    )


def print_files(folder: str | Path, console: Console) -> None:
    """Say where the files are; the last line is the path of the report, or of the picture where there is none."""
    place = Path(folder).resolve()
    console.print(f"Files: {', '.join(sorted(p.name for p in place.iterdir() if p.is_file()))}", markup=False)
    pages = sorted(place.glob("*.html"))
    last = pages[-1] if pages else place / "demo.png"
    console.print(f"The {'report' if pages else 'picture'}, to be opened in a browser:", markup=False)
    console.print(str(last), markup=False, highlight=False, soft_wrap=True)


def draw(result: DemoResult, path: str | Path) -> Path:
    """Draw the result to ``path`` (its suffix gives the format) and return it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.2), layout="constrained")
    accuracy, deviations, remainder = figure.subplots(1, 3, width_ratios=[1.2, 1, 1])
    figure.suptitle(
        f"{result.robot}: {result.configurations} configurations, "
        f"{1e3 * result.before:.2f} mm before, {milli(result.after)} mm after"
    )
    _draw_accuracy(accuracy, result)
    x, names = np.arange(len(result.parameters)), [p.name for p in result.parameters]
    rows = [(p.true - p.nominal, p.value - p.nominal, p.std) for p in result.parameters]
    true, value, std = 1e3 * np.array(rows).T
    deviations.bar(x, true, color="0.8", label="true")
    deviations.errorbar(x, value, 2 * std, fmt="o", ms=4, color="C0", label="identified")
    deviations.set_title("deviation from nominal\n[mm | mrad]")
    deviations.legend(frameon=False)
    remainder.axhline(0, color="0.5", lw=1)
    remainder.errorbar(x, value - true, 2 * std, fmt="o", ms=4, capsize=3, color="C0")
    remainder.set_title("identified − true, ± 2 std\n[mm | mrad]")
    for axes in (deviations, remainder):
        axes.set_xticks(x, names)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)
    return Path(path)


def _draw_accuracy(axes: Any, result: DemoResult) -> None:
    """Dots, because a bar on a logarithmic axis begins nowhere."""
    rows = _shown_errors(result)
    for i, (_, _, colour, achieved, predicted) in enumerate(rows):
        axes.plot(achieved, i, "o", ms=9, color=colour, label="achieved" if i == 1 else None)
        axes.annotate(f"{achieved:.4f}", (achieved, i), (0, 9), textcoords="offset points", ha="center")
        if predicted is not None:
            axes.plot(predicted, i, "k|", ms=17, mew=2, label="predicted" if i == 1 else None)
    axes.set_yticks(range(len(rows)), [name for _, name, *_ in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.margins(x=0.15)
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    axes.set_title("position error at the test pose\n[mm], logarithmic")
    axes.legend(frameon=False, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)
