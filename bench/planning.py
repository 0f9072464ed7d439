# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How near the bound the planner comes, and in what time: kuka_kr270, nine parameters, default settings.

50 random test poses within the joint limits; for each number of configurations the distribution of the efficiency
and of the seconds per plan. Then the cost against the size of the request: measurements, test poses.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from calib_planner import PlanProblem, Robot, plan
from calib_planner.error_model import gravity_of, typical
from calib_planner.planning import (
    Constraint,
    InformationModel,
    JointRange,
    LineOfSight,
    MinimumHeight,
    ReflectorAcceptance,
    Search,
    SelfCollision,
    TrackerElevation,
    TrackerRange,
    WorkspaceBox,
    plan_space,
)
from calib_planner.robot import Capsules

TARGETS = {3: 0.94, 4: 0.985, 6: 0.99, 12: 0.99}
"""Configurations: smallest efficiency wanted."""


def efficiencies(robot: Robot, poses: np.ndarray) -> list[dict[str, float]]:
    rows = []
    for m, wanted in TARGETS.items():
        plans = [plan(PlanProblem(robot, pose, m)) for pose in poses]
        e, t = (np.array([getattr(p.quality, name) for p in plans]) for name in ("efficiency", "seconds"))
        row = {
            "configurations": m, "wanted": wanted, "poses": len(poses),
            "median": float(np.median(e)), "worst": float(e.min()), "below": int((e < wanted).sum()),
            "seconds_median": float(np.median(t)), "seconds_worst": float(t.max()),
        }  # fmt: skip
        rows.append(row)
        print(
            f"m = {m:>2}: efficiency median {row['median']:.4f}, worst {row['worst']:.4f} (wanted {wanted}, "
            f"{row['below']} of {len(poses)} below); {row['seconds_median']:.2f} s median, "
            f"{row['seconds_worst']:.2f} s worst",
            file=sys.stderr,
        )
    return rows


def with_error_model() -> list[dict[str, float | str]]:
    """Processor time of plans for real robots: all parameters, base and tool unknown, typical errors."""
    rows: list[dict[str, float | str]] = []
    for name in ("kuka_kr270", "ur10e"):
        robot = Robot.load(name).with_parameters("full", ("base", "tool"))
        low, high = 0.6 * robot.joint_limits.T
        model = typical(gravity=gravity_of(robot))
        for m in (12, 30):
            times, accuracies = [], []
            for seed in range(5):
                pose = np.random.default_rng(100 + seed).uniform(low, high)
                began = time.process_time()
                found = plan(PlanProblem(robot, pose, m, error_model=model, search=Search(seed=seed)))
                times.append(time.process_time() - began)
                accuracies.append(1e6 * found.quality.predicted_accuracy)
            row = {"robot": name, "configurations": m, "seconds_median": float(np.median(times))}
            rows.append(row | {"accuracy_mean_um": float(np.mean(accuracies))})
            print(f"error model, {name}, m = {m}: {row['seconds_median']:.2f} s median", file=sys.stderr)
    return rows


def seconds_of(work) -> float:  # type: ignore[no-untyped-def]
    times = []
    for _ in range(5):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def scaling(robot: Robot) -> dict[str, dict[int, float]]:
    """Seconds per evaluation of value and gradient (by m), of a pool's information (by C), of K test poses."""
    low, high = robot.joint_limits.T
    rng = np.random.default_rng(0)
    pose = rng.uniform(low, high, 6)
    model = plan_space(PlanProblem(robot, pose, 4)).single
    assert isinstance(model, InformationModel)
    slope = np.eye(9)[None]
    table: dict[str, dict[int, float]] = {"configurations": {}, "candidates": {}, "test_poses": {}}
    for m in (1_000, 2_000, 4_000, 8_000, 16_000):
        q = rng.uniform(low, high, (m, 6))

        def value_and_gradient(q: np.ndarray = q, m: int = m) -> None:
            info = model.linearised(q)
            info.sums(m)
            info.gradient(slope)

        table["configurations"][m] = seconds_of(value_and_gradient)
        table["candidates"][m] = seconds_of(lambda q=q: model.at(q))
        table["test_poses"][m] = seconds_of(lambda q=q: plan_space(PlanProblem(robot, q, 4)))
    for name, row in table.items():
        first = min(row)
        shares = ", ".join(f"{n}: {t / row[first] / (n / first):.2f}" for n, t in row.items())
        print(f"time per {name[:-1].replace('_', ' ')}, relative to {first}: {shares}", file=sys.stderr)
    return table


STATION = np.array([4.0, 1.5, 1.2])
RADII = [0.30, 0.25, 0.18, 0.15, 0.12, 0.12, 0.10]
"""Of the body's capsules and of the cylinders that may not collide [m]."""


def eight_constraints(robot: Robot, folder: Path) -> tuple[Constraint, ...]:
    """A cell with a tracker in front of the robot; links that collide are a URDF of cylinders in ``folder``."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))
    from robots import cylinder_urdf

    (folder / "cylinders.urdf").write_text(cylinder_urdf(robot, RADII))
    body = Capsules(RADII)
    return (
        JointRange({"joint_a4": [-np.pi, np.pi], "joint_a6": [-np.pi, np.pi]}),
        WorkspaceBox([0.3, -2.0, 0.3], [3.0, 2.0, 2.5]),
        MinimumHeight(0.2, capsules=body),
        TrackerRange(STATION, 1.0, 6.0),
        TrackerElevation(STATION, low=-0.8, high=1.0),
        ReflectorAcceptance(STATION, [1, 0, 0], np.pi / 6),
        LineOfSight(STATION, body, near=0.2),
        SelfCollision(folder / "cylinders.urdf"),
    )


def constrained(robot: Robot, seeds: int, more: int = 20) -> list[dict[str, float]]:
    """Plans with eight constraints against the best with ``more`` times the starts; seconds of processor time."""
    pose, rows = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0]), []
    with tempfile.TemporaryDirectory() as folder:
        constraints = eight_constraints(robot, Path(folder))
        for m in (6, 12):

            def made(seed: int, starts: int, m: int = m) -> tuple[float, float]:
                began = time.process_time()
                search = Search(seed=seed, starts=starts)
                best = plan(PlanProblem(robot, pose, m, constraints=constraints, search=search))
                return best.quality.predicted_accuracy, time.process_time() - began

            accuracy, seconds = np.array([made(k, 48) for k in range(seeds)]).T
            long = min(accuracy.min(), *(made(1_000 + k, 48 * more)[0] for k in range(2)))
            row = {
                "configurations": m, "seeds": seeds, "long": long, "worst": float(long / accuracy.max()),
                "median": float(np.median(long / accuracy)), "seconds": float(np.median(seconds)),
            }  # fmt: skip
            rows.append(row)
            print(f"eight constraints: {row}", file=sys.stderr)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=50)
    text = "only plans with eight constraints, this many seeds"
    parser.add_argument("--constrained", type=int, metavar="SEEDS", help=text)
    args = parser.parse_args()
    robot = Robot.load("kuka_kr270")
    if args.constrained:
        print(json.dumps({"constrained": constrained(robot, args.constrained)}))
        return
    low, high = robot.joint_limits.T
    poses = np.random.default_rng(2026).uniform(low, high, (args.poses, 6))
    result = {
        "efficiency": efficiencies(robot, poses), "error_model": with_error_model(),
        "constrained": constrained(robot, 5), "scaling": scaling(robot),
    }  # fmt: skip
    print(json.dumps(result))


if __name__ == "__main__":
    main()
