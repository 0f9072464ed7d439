"""Identification one configuration at a time: time of an update, and how far it is from all at once.

    python bench/streaming.py [--updates 9] [--counts 10 20 50 100 200 400]

A simulated KR-270 (0.5 mm, 1 mrad, 0.03 mm of noise), one target. ``full``: all 36 placement errors; ``full,
base, tool``: the tracker's pose and the target unknown besides; ``paper``: lengths and joint offsets only, so
that the other errors are a discrepancy, which is estimated as on a real robot. An update starts at the estimate
of n − 1 configurations, adds one, and computes the whole new estimate, verdict included; medians over
``--updates`` of them with different configurations. ``cpu_ms`` is the processor's time, ``least_ms`` the least
of it: what the clock shows on an idle core. ``undo_ms`` withdraws a configuration from the middle instead. On
any machine: ``jacobians`` is ``least_ms`` over that of one ``positions_and_jacobian`` of these configurations,
``whole`` the processor's time of all that ``identify`` does by default over ``cpu_ms``. ``deviation`` is the
largest absolute difference of any value, standard deviation [m | rad] or residual [m] from ``identify`` of the
same measurements without a start. Robust data have a gross error in every tenth point. ``load`` is the
machine's when the row was done.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np

from calib_planner import Robot, identify
from calib_planner.identification import UPDATE, Estimate, IdentificationProblem
from calib_planner.measurements import Measurements
from calib_planner.simulation import SimulatedCell, random_deviations

SIGMA, LENGTH, ANGLE = 3e-5, 5e-4, 1e-3
TARGET = [[0.05, 0.02, 0.12]]
CASES: dict[str, tuple[str, tuple[str, ...]]] = {
    "paper": ("lengths+offsets", ()),
    "full": ("full", ()),
    "full, base, tool": ("full", ("base", "tool")),
}


def simulate(count: int, loss: str) -> tuple[Robot, Measurements]:
    """The robot with its target, and measurements of a real one."""
    robot = Robot.load("kuka_kr270").with_targets(TARGET)
    real = robot.with_parameters("full")
    rng = np.random.default_rng(1)
    low, high = robot.joint_limits.T
    q = rng.uniform(low, high, (count, len(low)))
    data = SimulatedCell(real, random_deviations(real, 1, LENGTH, ANGLE), SIGMA).measure(q, 1, 1)
    points = data.p.copy()
    if loss == "robust":
        points[5::10] += rng.normal(0.0, 3e-3, points[5::10].shape)
    return robot, replace(data, points=points, std=None)


def timed(job: Callable[[], Estimate]) -> tuple[Estimate, float, float]:
    """The estimate, verdict included, and milliseconds by the clock and of the processor."""
    clock, used = time.perf_counter(), time.process_time()
    estimate = job()
    _ = estimate.verdict
    return estimate, 1e3 * (time.perf_counter() - clock), 1e3 * (time.process_time() - used)


def processor(job: Callable[[], object]) -> float:
    """Milliseconds of the processor."""
    began = time.process_time()
    job()
    return 1e3 * (time.process_time() - began)


def deviation(one: Estimate, other: Estimate) -> float:
    """Largest difference; infinite where other parameters are held or other points rejected."""
    same = [[(r.row, r.target) for r in e.points.rejected] for e in (one, other)]
    if same[0] != same[1] or one.observability.fixed != other.observability.fixed:
        return float("inf")
    pairs = [
        (one.fit.values, other.fit.values),
        (one.fit.std, other.fit.std),
        (one.residuals.vectors, other.residuals.vectors),
    ]
    return max(float(np.nanmax(np.abs(a - b))) for a, b in pairs)


def measure(robot: Robot, data: Measurements, count: int, loss: str, updates: int) -> dict[str, Any]:
    """One row of the table."""
    settings = {**UPDATE, "sigma": SIGMA, "loss": loss}
    problem = IdentificationProblem(robot, data.select(np.arange(count - 1)), **settings)
    before = identify(problem)
    rows: list[tuple[float, float]] = []
    moved = np.full(len(robot.parameter_names), 1e-4)
    jacobian = min(processor(lambda: robot.positions_and_jacobian(problem.data.q, moved)) for _ in range(20))
    undone, apart = [], []
    for k in range(count - 1, count - 1 + updates):
        chosen = np.append(np.arange(count - 1), k)
        after = replace(problem, data=data.select(chosen))
        estimate, *times = timed(lambda after=after: identify(after, before))
        rows.append((times[0], times[1]))
        less = replace(problem, data=data.select(np.delete(chosen, count // 2)))
        undone.append(timed(lambda less=less, estimate=estimate: identify(less, estimate))[1])
        if len(apart) < 3:
            apart.append(deviation(estimate, identify(after)))
    asked = {"starts": 2, "joint_corrections": "auto", "order_check": "auto"}
    whole = processor(lambda: identify(replace(problem, **asked)).verdict)
    least, usual = min(r[1] for r in rows), median(r[1] for r in rows)
    return {
        "configurations": count,
        "clock_ms": median(r[0] for r in rows),
        "cpu_ms": usual,
        "least_ms": least,
        "jacobians": least / jacobian,
        "whole": whole / usual,
        "undo_ms": median(undone),
        "deviation": max(apart),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=9)
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 20, 50, 100, 200, 400])
    args = parser.parse_args()
    result = []
    head = f"{'parameters':>18} {'P':>3} {'loss':>7} {'n':>4} {'clock ms':>9} {'cpu ms':>7} {'least':>6} "
    print(head + f"{'undo ms':>8} {'jacobians':>9} {'whole':>6}  deviation", file=sys.stderr)
    for loss in ("linear", "robust"):
        shared, data = simulate(max(args.counts) + args.updates, loss)
        for name, (level, unknown) in CASES.items():
            robot = shared.with_targets(np.zeros((1, 3))) if "tool" in unknown else shared
            robot = robot.with_parameters(level, unknown)
            size = len(robot.parameter_names)
            for count in (n for n in args.counts if 3 * (n - 2) >= size):
                row = measure(robot, data, count, loss, args.updates)
                load = os.getloadavg()[0]
                result.append({"case": name, "parameters": size, "loss": loss, **row, "load": load})
                numbers = (
                    f"{row['clock_ms']:9.1f} {row['cpu_ms']:7.1f} {row['least_ms']:6.1f} {row['undo_ms']:8.1f} "
                    f"{row['jacobians']:9.1f} {row['whole']:6.1f}  {row['deviation']:.0e}"
                )
                print(f"{name:>18} {size:>3} {loss:>7} {count:>4} {numbers}", file=sys.stderr, flush=True)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
