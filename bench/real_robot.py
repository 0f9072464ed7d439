# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Plans on a measured UR10 against random choices of the same rows, same estimator, same held-out data.

    python bench/real_robot.py [--data ../shared/data] [--seeds 6] [--pool 600] [--random 100] [--others]
        [--json FILE]

For every seed a random part of ``ur10_tracker/random_poses.csv`` is the pool; n of its rows are chosen, all
placement errors with tracker and target are identified from them by the default estimator, with all
terms, and all other rows of the file are predicted. "Beats" is the share of random choices from the same pool
with a larger mean (95th percentile) error. Measured points enter the choice only through the rough pose of
tracker and target (every fifth row of the file). ``--others`` compares plans that know less beside the default.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner import IdentificationProblem, Robot, identify
from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import ErrorModel
from calib_planner.identification import start_robot
from calib_planner.io import read_data
from calib_planner.measurements import Measurements
from calib_planner.planning import Candidates, PlanProblem, plan, usual_error_model
from calib_planner.tracker import Isotropic

COUNTS = (10, 15, 20, 30)
SIGMA = 1.5e-5
ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Estimator:
    """The estimator that is the default, on measured configurations.

    Attributes:
        robot: Nominal, tracker and target near their place, all parameters active.
        data: All rows.
    """

    robot: Robot
    data: Measurements

    def held_out(self, rows: IntArray) -> tuple[float, float]:
        """Mean and 95th percentile of the error at all other rows [mm]."""
        others = np.setdiff1d(np.arange(len(self.data)), rows)
        known = identify(IdentificationProblem(self.robot, self.data.select(rows))).knowledge
        difference: FloatArray = self.data.p[others] - known.poses(self.data.q[others]).points
        distance = 1e3 * np.linalg.norm(difference[:, 0], axis=1)
        return float(np.mean(np.asarray(distance, float))), float(np.percentile(distance, 95))


def planners(robot: Robot, others: bool) -> dict[str, Callable[[FloatArray, int], FloatArray]]:
    """Name → (pool, n) → configurations."""

    def ask(**options: Any) -> Callable[[FloatArray, int], FloatArray]:
        def choose(pool: FloatArray, n: int) -> FloatArray:
            poses = None if options.get("criterion") == "d" else pool
            problem = PlanProblem(robot, poses, n, noise=SIGMA, **options, candidates=Candidates(pool))
            return plan(problem).configurations

        return choose

    usual = usual_error_model(robot, SIGMA)
    white = replace(ErrorModel.paper(Isotropic(3e-4)), placement=usual.placement, scales=usual.scales)
    default = {"typical": ask(error_model=usual)}
    return (
        default
        if not others
        else default
        | {
            "white 0.3 mm, priors": ask(error_model=white),
            "plain test poses": ask(),
            "plain D": ask(criterion="d"),
        }
    )


def one_seed(
    seed: int, data: Measurements, judges: dict[str, Estimator], ways: dict[str, Any], size: int, count: int
) -> list[dict[str, Any]]:
    """Every planner and estimator at every n on one pool."""
    pool = pool_of(seed, len(data), size)
    result = []
    for n in COUNTS:
        chosen = {name: _rows(data.q, pool, way(data.q[pool], n)) for name, way in ways.items()}
        for judge, estimator in judges.items():
            random = random_choices(estimator, seed, pool, n, count)
            for name, rows in chosen.items():
                got = np.array(estimator.held_out(rows))
                beats = 100.0 * (random > got).mean(axis=0)
                entry: dict[str, Any] = {"seed": seed, "n": n, "estimator": judge, "plan": name}
                entry |= {"mean_mm": got[0], "p95_mm": got[1], "beats_mean": beats[0], "beats_p95": beats[1]}
                entry |= {"random_mean_mm": np.median(random[:, 0]), "random_p95_mm": np.median(random[:, 1])}
                result.append({k: v if isinstance(v, (str, int)) else float(v) for k, v in entry.items()})
    return result


def pool_of(seed: int, rows: int, size: int) -> IntArray:
    """(size,) rows that may be chosen."""
    return np.random.default_rng([seed, 0]).choice(rows, size, replace=False)


def random_choices(estimator: Estimator, seed: int, pool: IntArray, n: int, count: int) -> FloatArray:
    """(count, 2) mean and 95th percentile [mm] of random choices, which no planner has a say in."""
    rng = np.random.default_rng([seed, n])
    return np.array([estimator.held_out(rng.choice(pool, n, replace=False)) for _ in range(count)])


def _rows(q: FloatArray, pool: IntArray, configurations: FloatArray) -> IntArray:
    """Which rows of the file the configurations are."""
    apart = np.abs(q[pool][None] - configurations[:, None]).max(axis=2)
    return np.asarray(pool[np.argmin(apart, axis=1)])


def show(entries: list[dict[str, Any]]) -> None:
    """Median [smallest–largest] over the seeds."""
    print(f"{'estimator':>9} {'plan':<22} {'n':>3} {'beats % (mean)':>17} {'beats % (p95)':>17}", end="")
    print(f" {'mean mm':>8} {'random':>7} {'p95 mm':>7} {'random':>7}")
    for judge in dict.fromkeys(e["estimator"] for e in entries):
        for name in dict.fromkeys(e["plan"] for e in entries):
            for n in COUNTS:
                part = [e for e in entries if (e["estimator"], e["plan"], e["n"]) == (judge, name, n)]

                def spread(key: str, part: list[dict[str, Any]] = part) -> str:
                    values = [e[key] for e in part]
                    return f"{np.median(values):5.0f} [{min(values):3.0f}–{max(values):3.0f}]"

                figures = [np.median([e[k] for e in part]) for k in ("mean_mm", "random_mean_mm")]
                figures += [np.median([e[k] for e in part]) for k in ("p95_mm", "random_p95_mm")]
                print(
                    f"{judge:>9} {name:<22} {n:3d} {spread('beats_mean'):>17} {spread('beats_p95'):>17}", end=""
                )
                print(" {:8.3f} {:7.3f} {:7.3f} {:7.3f}".format(*figures))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--pool", type=int, default=600)
    parser.add_argument("--random", type=int, default=100)
    parser.add_argument("--others", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    folder = args.data / "ur10_tracker"
    if not folder.is_dir():
        print(f"real_robot: no measured data at {args.data}: nothing measured")
        return
    robot = Robot.load(folder / "ur10.urdf").with_parameters("full", ("base", "tool"))
    data = read_data(folder / "random_poses.csv", robot).data
    robot = start_robot(robot, data.select(np.arange(0, len(data), 5)))
    judges, ways = {"default": Estimator(robot, data)}, planners(robot, args.others)
    entries = []
    for seed in range(args.seeds):
        entries += one_seed(seed, data, judges, ways, args.pool, args.random)
    show(entries)
    if args.json:
        args.json.write_text(json.dumps({"real_robot": entries}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
