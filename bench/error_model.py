# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The error model on measured and on simulated robots: what is predicted and what is achieved.

    python bench/error_model.py [--data ../shared/data] [--seeds 20] [--simulated 20] [--kinds WORD …]
                                [--json FILE]

Measured robots, with ``full`` placement and base and tool unknown: ``irb120_tracker`` (36 × 3 points fitted; the
40 rows of both test files predicted, the place of the re-seated target taken from the first row of each file),
``ur10_tracker`` (100 and 30 random rows of ``random_poses`` fitted, all others predicted; of ``joint_sweeps`` 100
random rows, all others predicted). No test row is used for anything else. Simulated robots are drawn from the
error model, with one kind of error each: 40 × 2 points are fitted, 300 fresh configurations predicted. Shown are
means over the seeds of: mean and rms distance [mm]; predicted over achieved rms, of all points and of the *sound*
ones, which are not impossible beside the prediction (by the rule that takes the weight of fitted ones); the share
of the others (*gross*); left-out rms [mm] and its *excess*, achieved over predicted; share of coordinates within
95 % intervals (of measured points, of true positions, of parameters), seconds, how often a point lost its weight,
and for the re-seated target how far achieved over predicted may be from one by *chance* (one standard deviation).
With ``--kinds`` only simulated robots whose kind holds one of the words.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner import Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, Knowledge, Truth, typical
from calib_planner.identification import ModelEstimate, fit_error_model, gate_of
from calib_planner.io import read_data
from calib_planner.measurements import Measurements
from calib_planner.robot import Element
from calib_planner.tracker import Isotropic, LaserTracker, Noise

ROOT = Path(__file__).resolve().parents[1]
INSIDE = 1.959964
"""Standard deviations that hold 95 %."""


def judge(known: Knowledge, data: Measurements, found: ModelEstimate, seconds: float) -> dict[str, float]:
    """Predicted and achieved at rows that took no part."""
    told = known.predict(data.q)
    return compared((data.p - told.mean)[data.seen], told.total[data.seen], found, seconds)


def compared(apart: FloatArray, total: FloatArray, found: ModelEstimate, seconds: float) -> dict[str, float]:
    """The figures of points (n, 3) measured − predicted [m] with covariances (n, 3, 3) [m²]."""
    square, trace = np.sum(apart**2, axis=1), np.trace(total, axis1=1, axis2=2)
    std = np.sqrt(np.diagonal(total, axis1=1, axis2=2))
    normalised = np.sum(apart * np.linalg.solve(total, apart[:, :, None])[:, :, 0], axis=1)
    sound = normalised < gate_of(len(apart))
    return {
        "mean_mm": 1e3 * float(np.sqrt(square).mean()),
        "rms_mm": 1e3 * float(np.sqrt(square.mean())),
        "predicted": float(np.sqrt(trace.mean() / square.mean())),
        "sound": float(np.sqrt(trace[sound].mean() / square[sound].mean())),
        "gross": float(np.mean(~sound)),
        "left_out_mm": 1e3 * found.left_out.rms,
        "excess": found.left_out.excess[0],
        "inside": float(np.mean(np.abs(apart) <= INSIDE * std)),
        "seconds": seconds,
    }


def timed(robot: Robot, data: Measurements, model: ErrorModel) -> tuple[ModelEstimate, float]:
    """The estimate and how long it took."""
    began = time.process_time()
    found = fit_error_model(robot, data, model)
    return found, time.process_time() - began


# ── measured robots ──────────────────────────────────────────────────────────────────────────────────


def irb120(folder: Path) -> list[dict[str, Any]]:
    """36 × 3 points → 10 + 30 points of a target that was re-seated twice."""
    robot = Robot.load(folder / "irb120.urdf").with_parameters("full", ("base",))
    three = robot.with_targets(np.zeros((3, 3))).with_parameters("full", ("base", "tool"))
    found, seconds = timed(three, read_data(folder / "calibration.csv", three).data, typical())
    parts, wholes, model = [], [], found.knowledge.model
    for name in ("test_1.csv", "test_2.csv"):
        data = read_data(folder / name, robot).data
        known = found.knowledge.with_new_targets(found.knowledge.robot.target_offsets[:1])
        known = known.updated(data.q[:1], data.p[:1])
        told, rest = known.predict(data.q[1:]), data.select(np.arange(1, len(data)))
        parts.append((told, rest))
        poses = known.poses(rest.q)
        rows = model.columns(poses).reshape(3 * len(rest), -1)
        whole = (rows @ known.covariance @ rows.T).reshape(len(rest), 3, len(rest), 3)
        every = np.arange(len(rest))
        whole[every, :, every] += model.visit_covariance(poses)
        wholes.append(whole)
    apart = np.concatenate([d.p - t.mean for t, d in parts])[:, 0]
    total = np.concatenate([t.total for t, _ in parts])[:, 0]
    result = compared(apart, total, found, seconds)
    # The rows of a file share what the first one says wrongly of the target.
    spread = sum(2.0 * float(np.sum(whole**2)) for whole in wholes)
    result["chance"] = 0.5 * float(np.sqrt(spread)) / float(np.trace(total, axis1=1, axis2=2).sum())
    return [{"case": "irb120 36x3", "scales": model.values, **result}]


def ur10(folder: Path, name: str, count: int, seeds: int) -> list[dict[str, Any]]:
    """``count`` random rows → the others."""
    robot = Robot.load(folder / "ur10.urdf").with_parameters("full", ("base", "tool"))
    data = read_data(folder / f"{name}.csv", robot).data
    result = []
    for seed in range(seeds):
        rows = np.random.default_rng(seed).permutation(len(data))
        found, seconds = timed(robot, data.select(rows[:count]), typical())
        row = judge(found.knowledge, data.select(rows[count:]), found, seconds)
        result.append({"case": f"ur10 {name} {count}", "scales": found.knowledge.model.values, **row})
    return result


# ── simulated robots ─────────────────────────────────────────────────────────────────────────────────


PLAIN = Isotropic(3e-5)
FAR = LaserTracker(station=np.array([15.0, 0.0, 1.0]))


@dataclass(frozen=True)
class Kind:
    """How a simulated robot errs and is measured.

    Attributes:
        name: For the table.
        scales: Scales of the error model that are not nothing; ``None``: all are drawn from their spread.
        heavy: Noise of the points is Student t with 3 degrees of freedom.
        backlash: Every joint stands half of this to one side or the other at a visit [rad].
        targets: How many.
        noise: The instrument; without it a point has 30 µm in each coordinate.
        stated: Whether the estimator is told the noise.
        rail: Whether the robot stands on a rail of 2 m.
    """

    name: str
    scales: tuple[tuple[str, float], ...] | None = ()
    heavy: bool = False
    backlash: float = 0.0
    targets: int = 2
    noise: Noise = PLAIN
    stated: bool = False
    rail: bool = False


VISITS = (("repeatability", 1e-4), ("shared", 5e-5))
ALL = (("gravity", 2e-3), ("smooth.size", 3e-4), ("short.size", 2e-4), ("repeatability", 5e-5))
KINDS = (
    Kind("noise only"),
    Kind("noise only, stated", stated=True),
    Kind("gravity", (("gravity", 3e-3),)),
    Kind("smooth joints", (("smooth.size", 4e-4),)),
    Kind("short joints", (("short.size", 3e-4),)),
    Kind("visits", VISITS),
    Kind("visits, sigma stated", VISITS, stated=True),
    *(Kind(f"all, {n} targets", ALL, targets=n) for n in range(1, 7)),
    Kind("all, on a rail", ALL, rail=True),
    Kind("scales drawn", None),
    Kind("backlash", backlash=2e-4),
    Kind("tracker at 15 m, stated", noise=FAR, stated=True),
    Kind("all, tracker at 15 m, stated", ALL, noise=FAR, stated=True),
    Kind("noise only, t3", heavy=True),
    Kind("gravity, t3", (("gravity", 3e-3),), heavy=True),
)
LIMITS = np.radians([[-170, 170], [-100, 60], [-100, 60], [-170, 170], [-100, 100], [-170, 170]])
RAIL = [[0.0, 2.0]]
TARGETS = [
    [0.0, 0.05, 0.1],
    [0.08, -0.03, 0.05],
    [-0.04, 0.02, 0.12],
    [0.1, 0.1, 0.1],
    [-0.1, 0.0, 0.05],
    [0, -0.1, 0],
]
PLACEMENT = {"placement.length": 3e-4, "placement.angle": 6e-4}
LENGTHS = ("smooth.length", "short.length")


def on_a_rail(robot: Robot) -> Robot:
    """The robot on a rail along x of its base, behind the errors of the base and before its first joint."""
    start = 1 + max(i for i, e in enumerate(robot.elements) if str(e.parameter).startswith("base."))
    moved = [e if e.joint is None else replace(e, joint=e.joint + 1) for e in robot.elements]
    return replace(
        robot,
        elements=(*moved[:start], Element("Tx", joint=0), *moved[start:]),
        joint_names=("rail", *robot.joint_names),
        joint_limits=np.concatenate([RAIL, robot.joint_limits]),
    )


def simulated(kind: Kind, seed: int, visits: int = 40, fresh: int = 300) -> dict[str, Any]:
    """A robot drawn from the error model, measured and predicted."""
    rng = np.random.default_rng(seed)
    arm = Robot.load("ur10e")
    robot = (on_a_rail(arm) if kind.rail else arm).with_targets(TARGETS[: kind.targets]).with_parameters("full")
    model = typical(kind.noise)
    if kind.scales is None:
        model = model.with_drawn_scales(rng)
    else:
        small = {s.name: 1e-12 for s in model.scales if s.name not in LENGTHS}
        model = model.with_values(small | PLACEMENT | dict(kind.scales))
    truth = Truth.draw(robot, model, rng)
    limits = np.concatenate([RAIL, LIMITS]) if kind.rail else LIMITS
    q = rng.uniform(limits[:, 0], limits[:, 1], (visits + fresh, len(limits)))
    at_visits = truth.draw_visits(len(q), rng)
    back = 0.5 * kind.backlash * rng.choice([-1.0, 1.0], q.shape)
    points = truth.positions(q, replace(at_visits, joints=at_visits.joints + back))
    standard = rng.standard_t(3, points.shape) / np.sqrt(3.0) if kind.heavy else rng.standard_normal(points.shape)
    data = Measurements(robot.joint_names, q, points + truth.noise(points, standard))
    nominal = robot.with_parameters("full", ("base", "tool"))
    stated = typical(kind.noise if kind.stated else None)
    found, seconds = timed(nominal, data.select(np.arange(visits)), stated)
    row = judge(found.knowledge, data.select(np.arange(visits, len(q))), found, seconds)
    told = found.knowledge.predict(q[visits:])
    std = np.sqrt(np.diagonal(told.position, axis1=2, axis2=3))
    row["positions"] = float(np.mean(np.abs(told.mean - truth.positions(q[visits:])) <= INSIDE * std))
    at = [found.knowledge.robot.parameter_names.index(n) for n in robot.parameter_names]
    std = np.sqrt(np.diag(found.knowledge.covariance)[at])
    apart = found.knowledge.coefficients[at] - truth.coefficients[: len(at)]
    row["parameters"] = float(np.mean(np.abs(apart) <= INSIDE * std))
    row["doubted"] = float((found.doubt > 0).any())
    return {"case": f"simulated: {kind.name}", "scales": found.knowledge.model.values, **row}


def many() -> dict[str, Any]:
    """1 000 visits × 3 targets of a robot with every term, for the time it takes."""
    return simulated(Kind("1000 visits x 3", ALL, targets=3), 0, visits=1000)


def show(rows: list[dict[str, Any]]) -> None:
    """Means over the seeds of every case."""
    keys = ["mean_mm", "rms_mm", "predicted", "sound", "gross", "left_out_mm", "excess", "inside", "seconds"]
    keys += ["positions", "parameters", "doubted", "chance"]
    print(f"{'case':<30} {'seeds':>5} " + " ".join(f"{k:>11}" for k in keys))
    for case in dict.fromkeys(r["case"] for r in rows):
        part = [r for r in rows if r["case"] == case]
        means = " ".join(f"{np.mean([r.get(k, np.nan) for r in part]):11.3f}" for k in keys)
        print(f"{case:<30} {len(part):5d} {means}", flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--simulated", type=int, default=20)
    parser.add_argument("--kinds", nargs="+", default=[], metavar="WORD")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if (args.data / "irb120_tracker").is_dir() and not args.kinds:
        rows += irb120(args.data / "irb120_tracker")
        for name, count in (("random_poses", 100), ("random_poses", 30), ("joint_sweeps", 100)):
            rows += ur10(args.data / "ur10_tracker", name, count, args.seeds)
    for kind in KINDS:
        if not args.kinds or any(word in kind.name for word in args.kinds):
            rows += [simulated(kind, seed) for seed in range(args.simulated)]
    rows += [] if args.kinds else [many()]
    show(rows)
    if args.json:
        args.json.write_text(json.dumps({"error_model": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
