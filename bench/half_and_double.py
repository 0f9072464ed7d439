# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Plans for robots that err otherwise than the plan assumes, against random choices, by the default estimator.

    python bench/half_and_double.py [--seeds 6] [--random 100] [--counts 10 15 20 30] [--json FILE]

A UR10e whose base and reflector are unknown is drawn from the error model ``typical`` with gravity, joint
functions and repeatability of half, or of double, the size that the plan assumes. It is identified from n planned
configurations, and from n random ones within the joint limits, a hundred times. Judged are the errors at 200
configurations in the middle half of the joints' ranges; the test poses of the plan are 40 others. "Beats"
is the share of random choices with a larger mean (95th percentile) error.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner import IdentificationProblem, Measurements, PlanProblem, Robot, identify, plan
from calib_planner.arrays import FloatArray
from calib_planner.error_model import Truth, gravity_of, typical
from calib_planner.planning import UNCERTAIN, usual_error_model
from calib_planner.tracker import Isotropic

ROOT = Path(__file__).resolve().parents[1]
SIGMA = 3e-5
FACTORS = (0.5, 1.0, 2.0)


@dataclass(frozen=True, eq=False)
class Judge:
    """One true robot and where its estimates are judged.

    Attributes:
        robot: Nominal, base and target unknown.
        truth: How it really errs.
        poses: (K, joints) where [rad].
    """

    robot: Robot
    truth: Truth
    poses: FloatArray

    def held_out(self, q: FloatArray, rng: np.random.Generator) -> tuple[float, float]:
        """Mean and 95th percentile of the error after measuring ``q`` (n, joints) once [mm]."""
        data = Measurements(self.robot.joint_names, q, self.truth.measure(q, rng))
        known = identify(IdentificationProblem(self.robot, data)).knowledge
        errors: FloatArray = self.truth.positions(self.poses) - known.poses(self.poses).points
        distance = 1e3 * np.linalg.norm(errors[:, 0], axis=1)
        return float(distance.mean()), float(np.percentile(distance, 95))


def drawn(robot: Robot, low: FloatArray, high: FloatArray, rng: np.random.Generator, count: int) -> FloatArray:
    """(count, joints) configurations between ``low`` and ``high`` (joints,) [rad]."""
    return np.asarray(rng.uniform(low, high, (count, len(robot.joint_names))))


def judge_of(robot: Robot, factor: float, seed: int) -> Judge:
    """A robot that errs ``factor`` times as much as a typical one."""
    usual = typical(Isotropic(SIGMA), gravity=gravity_of(robot))
    model = usual.with_values({n: v * factor for n, v in usual.values.items() if n in UNCERTAIN})
    low, high = middle(robot)
    rng = np.random.default_rng([seed, 1])
    return Judge(robot, Truth.draw(robot, model, rng), drawn(robot, low, high, rng, 200))


def middle(robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Lower and upper end (joints,) of the middle half of the joints' ranges, one turn at most [rad]."""
    low, high = robot.joint_limits.T
    centre, half = (low + high) / 2, np.minimum((high - low) / 4, np.pi / 2)
    return centre - half, centre + half


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--random", type=int, default=100)
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 15, 20, 30])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    robot = Robot.load(ROOT / "docs" / "examples" / "ur10e.urdf").with_targets([[0.06, 0.0, 0.03]])
    robot = robot.with_parameters("full", ["base", "tool"])
    tests = drawn(robot, *middle(robot), np.random.default_rng(0), 40)
    low, high = robot.joint_limits.T
    entries: list[dict[str, Any]] = []
    print(f"{'size':>5} {'n':>3} {'beats % (mean)':>15} {'beats % (p95)':>15} {'mean mm':>8} {'random':>7}")
    for n in args.counts:
        planned = plan(PlanProblem(robot, tests, n, error_model=usual_error_model(robot, SIGMA))).configurations
        for factor in FACTORS:
            part = []
            for seed in range(args.seeds):
                judge, rng = judge_of(robot, factor, seed), np.random.default_rng([seed, n, 2])
                ours = np.array(judge.held_out(planned, rng))
                choices = [drawn(robot, low, high, rng, n) for _ in range(args.random)]
                random = np.array([judge.held_out(q, rng) for q in choices])
                beats = 100.0 * (random > ours).mean(axis=0)
                figures = (*beats, ours[0], np.median(random[:, 0]))
                names = ("beats_mean", "beats_p95", "mean_mm", "random_mean_mm")
                part.append({k: float(v) for k, v in zip(names, figures, strict=True)})
                entries.append({"size": factor, "n": n, "seed": seed, **part[-1]})
            middles = {k: float(np.median([e[k] for e in part])) for k in part[0]}
            least = [min(e[k] for e in part) for k in ("beats_mean", "beats_p95")]
            print(
                f"{factor:5.1f} {n:3d} {middles['beats_mean']:6.0f} (≥ {least[0]:3.0f}) "
                f"{middles['beats_p95']:6.0f} (≥ {least[1]:3.0f}) {middles['mean_mm']:8.3f} "
                f"{middles['random_mean_mm']:7.3f}",
                flush=True,
            )
    if args.json:
        args.json.write_text(json.dumps({"half_and_double": entries}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
