# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimate brought up to date one visit at a time: time of an update, and how far it is from a full fit.

    python bench/streaming.py [--updates 12] [--counts 20 50 100 200 400]

A simulated UR10e that errs in all ways that the typical error model knows, with ``full`` placement, base and tool
unknown, one target and three. An update starts at the estimate of the visits before and brings one more in
(``fit_error_model(..., start=…)``). Milliseconds of one core: the *median* and the *slowest* of the updates but
the first, which changes the form of the solution (*first*); an *undo* withdraws a visit from the middle; *full*
is a full fit. *identify* is the median of ``identify(problem, start=…)`` as a whole, with ten test poses, of the
same updates, and *its first* the first of them. *apart* is the root mean square by which predictions at 100 other
configurations differ from those of the full fit, as a share of what the full fit says of their uncertainty. JSON
on stdout.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any, TypeVar

import numpy as np

from calib_planner import Robot
from calib_planner.error_model import Truth, typical
from calib_planner.identification import IdentificationProblem, fit_error_model, identify
from calib_planner.measurements import Measurements

TARGETS = [[0.0, 0.05, 0.1], [0.08, -0.03, 0.05], [-0.04, 0.02, 0.12]]
OTHERS = 100
"""Configurations at which predictions are compared."""
TEST_POSES = 10
T = TypeVar("T")


def simulate(count: int, targets: int) -> tuple[Robot, Measurements]:
    """The robot as the estimator knows it, and ``count`` visits."""
    robot = Robot.load("ur10e").with_targets(TARGETS[:targets]).with_parameters("full")
    rng = np.random.default_rng(0)
    truth = Truth.draw(robot, typical(), rng)
    low, high = np.maximum(robot.joint_limits.T, [[-2.5], [-2.5]])[0], np.minimum(robot.joint_limits[:, 1], 2.5)
    q = rng.uniform(low, high, (count, len(low)))
    points = truth.positions(q, truth.draw_visits(count, rng))
    return robot.with_parameters("full", ("base", "tool")), Measurements(robot.joint_names, q, points)


def timed(job: Callable[[], T]) -> tuple[T, float]:
    """What the job returns, and milliseconds of the processor."""
    began = time.process_time()
    found = job()
    return found, 1e3 * (time.process_time() - began)


def measure(robot: Robot, data: Measurements, count: int, updates: int) -> dict[str, Any]:
    """One row of the table."""
    model, times = typical(), []
    visits = data.select(np.arange(count + updates))
    found, whole = timed(lambda: fit_error_model(robot, visits.select(np.arange(count)), model))
    for k in range(count + 1, count + updates + 1):
        more, before = visits.select(np.arange(k)), found
        found, spent = timed(partial(fit_error_model, robot, more, model, start=before))
        times.append(spent)
    less = visits.select(np.delete(np.arange(count + updates), count // 2))
    undone = timed(lambda: fit_error_model(robot, less, model, start=found))[1]
    full, others = fit_error_model(robot, visits, model), data.q[-OTHERS:]
    told, expected = found.knowledge.predict(others), full.knowledge.predict(others)
    apart = np.sum((told.mean - expected.mean) ** 2, axis=2).mean()
    asked = IdentificationProblem(robot, visits, test_poses=data.q[-TEST_POSES:])
    estimate, complete = identify(replace(asked, data=visits.select(np.arange(count)))), []
    for k in range(count + 1, count + updates + 1):
        problem = replace(asked, data=visits.select(np.arange(k)))
        estimate, spent = timed(partial(identify, problem, estimate))
        complete.append(spent)
    return {
        "targets": data.p.shape[1],
        "visits": count,
        "median": median(times[1:]),
        "slowest": max(times[1:]),
        "first": times[0],
        "undo": undone,
        "full": whole,
        "identify": median(complete[1:]),
        "its first": complete[0],
        "apart": float(np.sqrt(apart / np.trace(expected.position, axis1=2, axis2=3).mean())),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--updates", type=int, default=12)
    parser.add_argument("--counts", type=int, nargs="+", default=[20, 50, 100, 200, 400])
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for targets in (1, 3):
        robot, data = simulate(max(args.counts) + args.updates + OTHERS, targets)
        for count in args.counts:
            rows.append(measure(robot, data, count, args.updates))
            if len(rows) == 1:
                print(" ".join(f"{k:>8}" for k in rows[0]), file=sys.stderr)
            values = (f"{v:8.3f}" if k == "apart" else f"{v:8.0f}" for k, v in rows[-1].items())
            print(" ".join(values), file=sys.stderr, flush=True)
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
