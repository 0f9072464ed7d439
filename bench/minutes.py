# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How many random visits, and how many minutes, are as good as 15 planned ones?

    python bench/minutes.py [--data ../shared/data] [--seeds 6] [--robots NAME …] [--share 0.3]

For simulated robots and for a measured UR10: all placement errors, tracker and reflector are unknown; the default
estimator identifies from the visits, and the mean error at configurations that took no part judges them. They are
spread over all joint limits, as are the test poses of the plan; with ``--share`` both are where the robot works:
in a box of that share of every joint's range, whose middle is drawn. Random visits are spread over all joint
limits and, with ``--share``, over the box as well: the better of the two counts. A simulated robot errs as the
typical error model says, each seed another one; the plan knows nothing of the seed. Random visits are the first
n of one random sequence. For every n the median over the seeds of the quotient random/planned is taken; the
number of random visits that are as good as the planned ones is where that median is 1, by linear interpolation of
its logarithm between the two n around the last crossing. ``>`` says that even the largest n is not enough.

Both tours are visited in little time (``visiting_order``) at the usual pace: a quarter of the speed limits in the
URDF, or 0.5 rad/s where there are none; 2 s to settle and 3 s to measure. The minutes of the random visits are
interpolated alike.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from real_robot import Estimator, pool_of

from calib_planner import IdentificationProblem, Robot, identify
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, gravity_of, typical
from calib_planner.identification import start_robot
from calib_planner.io import read_data, robot_pace
from calib_planner.planning import (
    Candidates,
    PlanProblem,
    plan,
    usual_error_model,
    visit_times,
    visiting_order,
    with_wide_placement,
)
from calib_planner.simulation import SimulatedCell, random_deviations
from calib_planner.tracker import Isotropic

PLANNED = 15
SIZES = (15, 18, 22, 27, 33, 40, 50, 65)
"""Numbers of random visits."""
SIGMA = 3e-5
REFLECTOR = [[0.06, 0.02, 0.1]]
TESTS, HELD_OUT, POOL = 60, 300, 600
ROOT = Path(__file__).resolve().parents[1]

Judge = Callable[[FloatArray], float]
"""Configurations (n, joints) → mean held-out error of what is identified from them [mm]."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One robot of one seed.

    Attributes:
        robot: What the timetable is of.
        planned: (15, joints).
        random: Random sequences, (65, joints) each.
        judge: See ``Judge``.
    """

    robot: Robot
    planned: FloatArray
    random: tuple[FloatArray, ...]
    judge: Judge


def simulated(source: str | Path, seeds: int, share: float) -> Iterator[Trial]:
    """Robots that err as the typical model says; one plan for all; they work in ``share`` of the range."""
    nominal = Robot.load(source).with_targets(REFLECTOR)
    chain, asked = nominal.with_parameters("full"), nominal.with_parameters("full", ("base", "tool"))
    error_model = typical(Isotropic(SIGMA), gravity=gravity_of(asked))
    everywhere, draw = nominal.joint_limits, np.random.default_rng(0)
    half = 0.5 * share * np.diff(everywhere)
    middle = draw.uniform(everywhere[:, :1] + half, everywhere[:, 1:] - half)
    work = np.hstack([middle - half, middle + half])

    def spread(rng: np.random.Generator, count: int, box: FloatArray = work) -> FloatArray:
        return np.asarray(rng.uniform(*box.T, (count, len(box))))

    tests = spread(draw, TESTS)
    wide: ErrorModel = with_wide_placement(error_model)
    planned = plan(PlanProblem(asked, tests, PLANNED, noise=SIGMA, error_model=wide)).configurations
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 3])
        cell = SimulatedCell(chain, random_deviations(chain, seed), SIGMA, error_model=error_model, seed=seed)
        held_out = spread(rng, HELD_OUT)
        true = cell.truth.positions(held_out)

        def judge(q: FloatArray, cell: SimulatedCell = cell, true: FloatArray = true) -> float:
            data = cell.measure(q, 1, 7)
            found = identify(IdentificationProblem(asked, data)).knowledge.poses(held_out).points  # noqa: B023
            return float(1e3 * np.linalg.norm(found - true, axis=2).mean())

        boxes = (everywhere, work) if share < 1 else (everywhere,)
        yield Trial(nominal, planned, tuple(spread(rng, max(SIZES), box) for box in boxes), judge)


def measured(data: Path, seeds: int) -> Iterator[Trial]:
    """The UR10: each seed has another part of the measured rows to choose from."""
    folder = data / "ur10_tracker"
    robot = Robot.load(folder / "ur10.urdf").with_parameters("full", ("base", "tool"))
    rows = read_data(folder / "random_poses.csv", robot).data
    robot = start_robot(robot, rows.select(np.arange(0, len(rows), 5)))
    estimator = Estimator(robot, rows)

    def judge(q: FloatArray) -> float:
        apart = np.abs(rows.q[None] - q[:, None]).max(axis=2)
        return estimator.held_out(np.argmin(apart, axis=1))[0]

    for seed in range(seeds):
        pool = rows.q[pool_of(seed, len(rows), POOL)]
        usual = usual_error_model(robot, SIGMA)
        problem = PlanProblem(robot, pool, PLANNED, noise=SIGMA, error_model=usual, candidates=Candidates(pool))
        order = np.random.default_rng([seed, 3]).permutation(len(pool))
        yield Trial(robot, plan(problem).configurations, (pool[order[: max(SIZES)]],), judge)


def minutes(robot: Robot, q: FloatArray) -> float:
    """How long visiting q (n, joints) once each takes [min]."""
    pace = robot_pace(robot)
    return visit_times(robot, q[visiting_order(q, robot, pace)], 1, pace).seconds / 60.0


def compare(name: str, trials: Iterator[Trial]) -> dict[str, Any]:
    """One robot: errors and minutes of both, and where they are equal."""
    planned, times = [], []
    ratios: dict[int, list[list[float]]] = {}
    random_times: dict[int, list[list[float]]] = {}
    for trial in trials:
        own = trial.judge(trial.planned)
        planned.append(own)
        times.append(minutes(trial.robot, trial.planned))
        for kind, q in enumerate(trial.random):
            ratios.setdefault(kind, []).append([trial.judge(q[:n]) / own for n in SIZES])
            random_times.setdefault(kind, []).append([minutes(trial.robot, q[:n]) for n in SIZES])
            print(f"{name}: {own:.3f} mm, quotients {np.round(ratios[kind][-1], 2)}", file=sys.stderr, flush=True)
    quotients = [np.median(each, axis=0) for each in ratios.values()]
    spent = [np.median(each, axis=0) for each in random_times.values()]
    every = [crossing(np.log(q), t) for q, t in zip(quotients, spent, strict=True)]
    visits, needed = min(every)
    return {
        "robot": name,
        "seeds": len(planned),
        "planned_visits": PLANNED,
        "planned_minutes": median(times),
        "planned_mm": median(planned),
        "random_visits": visits,
        "random_minutes": needed,
        "sizes": list(SIZES),
        "kinds": [
            {"random_visits": v, "random_minutes": m, "quotients": q.tolist(), "minutes_of_sizes": t.tolist()}
            for (v, m), q, t in zip(every, quotients, spent, strict=True)
        ],
        "quotients_of_seeds": list(ratios.values()),
    }


def crossing(logs: FloatArray, spent: FloatArray) -> tuple[float, float]:
    """Number of random visits and their minutes from which on log quotients (sizes,) are at most 0."""
    above = np.flatnonzero(logs > 0)
    if not len(above):
        return float(SIZES[0]), float(spent[0])
    last = int(above[-1])
    if last == len(SIZES) - 1:
        return float("inf"), float("inf")
    share = logs[last] / (logs[last] - logs[last + 1])
    both = np.stack([np.array(SIZES, float), spent])
    visits, needed = both[:, last] + share * (both[:, last + 1] - both[:, last])
    return float(visits), float(needed)


def table(results: list[dict[str, Any]]) -> str:
    """For people, as Markdown."""
    lines = ["| robot | planned | mean error elsewhere | random visits as good | |", "|---|---|---|---|---|"]
    for r in results:
        left = f"{r['planned_visits']} visits, {r['planned_minutes']:.1f} min"
        enough = np.isfinite(r["random_visits"])
        right = f"{r['random_visits']:.0f} | {r['random_minutes']:.1f} min" if enough else f"> {SIZES[-1]} | "
        lines.append(f"| {r['robot']} | {left} | {r['planned_mm']:.2f} mm | {right} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--robots", nargs="+", default=["kuka_kr270", "ur10e", "irb120", "measured_ur10"])
    parser.add_argument("--share", type=float, default=1.0)
    args = parser.parse_args()
    results = []
    for name in args.robots:
        urdf = args.data / "irb120_tracker" / "irb120.urdf"
        if name in ("irb120", "measured_ur10") and not args.data.is_dir():
            print(f"minutes: no measured data at {args.data}: {name} left out", file=sys.stderr)
        elif name == "measured_ur10":
            results.append(compare(name, measured(args.data, args.seeds)))
        else:
            results.append(compare(name, simulated(urdf if name == "irb120" else name, args.seeds, args.share)))
    print(table(results), file=sys.stderr)
    print(json.dumps({"minutes": results}, indent=1))


if __name__ == "__main__":
    main()
