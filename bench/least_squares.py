# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification beside a plain ``scipy.optimize.least_squares``: the same robots, rows and held-out rows.

    python bench/least_squares.py [--data ../shared/data] [--seeds 5] [--simulated 5] [--json FILE]

The plain way is what is written in an afternoon: the model's positions less the measured points over their
standard deviation, all placement errors with base and targets free, differences for derivatives, and
Levenberg–Marquardt. It starts with base and targets fitted first, since it finds no way from a base that is
turned round.
Both sides get the same rows; the error is the mean distance at rows that took no part.

Robots: the measured IRB 120 (36 × 3 points; 40 rows of a re-seated target, whose place is taken from the first
row of each file, as the data's README says), the measured UR10 (100 random rows of ``random_poses``, all others
held out, a split for each seed), and a simulated UR10e that errs in all ways of the typical error model (100
configurations; true positions at 300 others). Times are processor seconds of one core.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from calib_planner import IdentificationProblem, Measurements, Robot, identify
from calib_planner.arrays import FloatArray
from calib_planner.error_model import Truth, gravity_of, typical
from calib_planner.io import read_data
from calib_planner.tracker import Isotropic

ROOT = Path(__file__).resolve().parents[1]
SIGMA = 3e-5
Predict = Callable[[FloatArray], FloatArray]


def ours(robot: Robot, data: Measurements) -> Predict:
    """Where the estimate puts the targets."""
    known = identify(IdentificationProblem(robot, data)).knowledge
    return lambda q: known.predict(q).mean


def plain(robot: Robot, data: Measurements) -> Predict:
    """The same by scipy."""
    names, chain = robot.parameter_names, set(robot.with_parameters("full").parameter_names)
    free = np.array([n not in chain for n in names])

    def solved(start: FloatArray, which: FloatArray) -> FloatArray:
        def residuals(part: FloatArray) -> FloatArray:
            deviations = start.copy()
            deviations[which] = part
            return ((robot.positions(data.q, deviations) - data.p)[data.seen] / SIGMA).ravel()

        full = start.copy()
        full[which] = least_squares(residuals, start[which], method="lm").x
        return full

    where = solved(np.zeros(len(names)), free)
    deviations = solved(where, np.ones(len(names), bool))
    return lambda q: robot.positions(q, deviations)


WAYS: dict[str, Callable[[Robot, Measurements], Predict]] = {"identify": ours, "scipy": plain}


def mean_mm(apart: FloatArray) -> float:
    """Mean distance [mm] of (…, 3)."""
    return 1e3 * float(np.linalg.norm(apart, axis=-1).mean())


def runs(
    case: str, seed: int, robot: Robot, data: Measurements, judge: Callable[[Predict], float]
) -> list[dict[str, Any]]:
    """One split, both ways."""
    rows = []
    for name, way in WAYS.items():
        began = time.process_time()
        predict = way(robot, data)
        seconds = time.process_time() - began
        rows.append({"case": case, "seed": seed, "way": name, "seconds": seconds, "mean_mm": judge(predict)})
    return rows


def irb120(folder: Path) -> list[dict[str, Any]]:
    """36 × 3 points; the re-seated target sits where the first row of each test file says."""
    bare = Robot.load(folder / "irb120.urdf")
    robot = bare.with_targets(np.zeros((3, 3))).with_parameters("full", ("base", "tool"))
    tests = [read_data(folder / f"test_{k}.csv", bare).data for k in (1, 2)]

    def judge(predict: Predict) -> float:
        apart = []
        for test in tests:
            # Three targets give the pose of the flange; the re-seated one has a place there, from the first row.
            frames = [flange(points) for points in predict(test.q)]
            (origin, axes), first = frames[0], test.p[0, 0]
            place = axes.T @ (first - origin)
            told = np.array([origin + axes @ place for origin, axes in frames[1:]])
            apart.append(told - test.p[1:, 0])
        return mean_mm(np.concatenate(apart))

    return runs("irb120", 0, robot, read_data(folder / "calibration.csv", robot).data, judge)


def flange(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Origin (3,) and axes (3, 3) of the frame that three targets (3, 3) [m] span."""
    a, b, c = points
    x = (b - a) / np.linalg.norm(b - a)
    z = np.cross(x, c - a)
    z /= np.linalg.norm(z)
    return a, np.column_stack([x, np.cross(z, x), z])


def ur10(folder: Path, seeds: int) -> list[dict[str, Any]]:
    """100 random rows, all others held out."""
    robot = Robot.load(folder / "ur10.urdf").with_parameters("full", ("base", "tool"))
    data = read_data(folder / "random_poses.csv", robot).data
    result = []
    for seed in range(seeds):
        order = np.random.default_rng(seed).permutation(len(data))
        test = data.select(order[100:])
        result += runs("ur10", seed, robot, data.select(order[:100]), lambda p, t=test: mean_mm(p(t.q) - t.p))
    return result


def simulated(seeds: int) -> list[dict[str, Any]]:
    """A UR10e that errs in all ways, 100 configurations."""
    robot = Robot.load("ur10e").with_parameters("full", ("base", "tool"))
    low, high = robot.joint_limits.T
    result = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth = Truth.draw(robot, typical(Isotropic(SIGMA), gravity=gravity_of(robot)), rng)
        q, test = (rng.uniform(low, high, (n, len(low))) for n in (100, 300))
        data = Measurements(robot.joint_names, q, truth.measure(q, rng))
        where = truth.positions(test)
        result += runs("ur10e", seed, robot, data, lambda p, t=test, w=where: mean_mm(p(t) - w))
    return result


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--simulated", type=int, default=5)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = simulated(args.simulated)
    if args.data.is_dir():
        rows += irb120(args.data / "irb120_tracker") + ur10(args.data / "ur10_tracker", args.seeds)
    text = json.dumps({"least_squares": rows}, indent=1)
    for case in dict.fromkeys(r["case"] for r in rows):
        for way in WAYS:
            part = [(r["seconds"], r["mean_mm"]) for r in rows if (r["case"], r["way"]) == (case, way)]
            seconds, error = np.median(part, axis=0)
            print(f"{case:>8} {way:>9} {seconds:8.2f} s {error:8.3f} mm")
    if args.json:
        args.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
