"""The error model on measured and on simulated robots: what is predicted and what is achieved.

    python bench/error_model.py [--data ../shared/data] [--seeds 20] [--simulated 20] [--json FILE]

Measured robots, with ``full`` placement and base and tool unknown: ``irb120_tracker`` (36 × 3 points fitted; the
40 rows of both test files predicted, the place of the re-seated target taken from the first row of each file),
``ur10_tracker`` (100 and 30 random rows of ``random_poses`` fitted, all others predicted; of ``joint_sweeps`` 100
random rows, all others predicted). No test row is used for anything else. Simulated robots, one kind of error
each: 40 × 2 points are fitted, 300 fresh configurations predicted. Shown are means over the seeds of: mean and
rms distance [mm], predicted over achieved rms, left-out rms [mm], share of coordinates within 95 % intervals,
seconds.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner import Robot
from calib_planner.error_model import ErrorModel, Knowledge, typical
from calib_planner.identification import ModelEstimate, fit_error_model
from calib_planner.io import read_measurements
from calib_planner.measurements import Measurements
from calib_planner.tracker import Isotropic, LaserTracker, Noise

ROOT = Path(__file__).resolve().parents[1]
INSIDE = 1.959964
"""Standard deviations that hold 95 %."""


def judge(known: Knowledge, data: Measurements, found: ModelEstimate, seconds: float) -> dict[str, float]:
    """Predicted and achieved at rows that took no part."""
    told = known.predict(data.q)
    apart = (data.p - told.mean)[data.seen]
    total = told.total[data.seen]
    distance, trace = np.linalg.norm(apart, axis=1), np.trace(total, axis1=1, axis2=2)
    std = np.sqrt(np.diagonal(total, axis1=1, axis2=2))
    rms = float(np.sqrt(np.mean(distance**2)))
    return {
        "mean_mm": 1e3 * float(distance.mean()),
        "rms_mm": 1e3 * rms,
        "predicted": float(np.sqrt(trace.mean())) / rms,
        "left_out_mm": 1e3 * found.left_out.rms,
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
    found, seconds = timed(three, read_measurements(folder / "calibration.csv", three).data, typical())
    parts, model = [], found.knowledge.model
    for name in ("test_1.csv", "test_2.csv"):
        data = read_measurements(folder / name, robot).data
        known = found.knowledge.with_new_targets(found.knowledge.robot.target_offsets[:1])
        known = known.updated(data.q[:1], data.p[:1])
        told, rest = known.predict(data.q[1:]), data.select(np.arange(1, len(data)))
        parts.append((told, rest))
    apart = np.concatenate([d.p - t.mean for t, d in parts])[:, 0]
    total = np.concatenate([t.total for t, _ in parts])[:, 0]
    distance = np.linalg.norm(apart, axis=1)
    rms = float(np.sqrt(np.mean(distance**2)))
    std = np.sqrt(np.diagonal(total, axis1=1, axis2=2))
    result = {
        "mean_mm": 1e3 * float(distance.mean()),
        "rms_mm": 1e3 * rms,
        "predicted": float(np.sqrt(np.trace(total, axis1=1, axis2=2).mean())) / rms,
        "left_out_mm": 1e3 * found.left_out.rms,
        "inside": float(np.mean(np.abs(apart) <= INSIDE * std)),
        "seconds": seconds,
    }
    return [{"case": "irb120 36x3", "scales": model.values, **result}]


def ur10(folder: Path, name: str, count: int, seeds: int) -> list[dict[str, Any]]:
    """``count`` random rows → the others."""
    robot = Robot.load(folder / "ur10.urdf").with_parameters("full", ("base", "tool"))
    data = read_measurements(folder / f"{name}.csv", robot).data
    result = []
    for seed in range(seeds):
        rows = np.random.default_rng(seed).permutation(len(data))
        found, seconds = timed(robot, data.select(rows[:count]), typical())
        row = judge(found.knowledge, data.select(rows[count:]), found, seconds)
        result.append({"case": f"ur10 {name} {count}", "scales": found.knowledge.model.values, **row})
    return result


# ── simulated robots ─────────────────────────────────────────────────────────────────────────────────


PLAIN = Isotropic(3e-5)


@dataclass(frozen=True)
class Kind:
    """How a simulated robot errs and is measured.

    Attributes:
        name: For the table.
        scales: Scales of the error model that are not nothing.
        heavy: Noise of the points is Student t with 3 degrees of freedom.
        backlash: Every joint stands half of this to one side or the other at a visit [rad].
        targets: How many.
        noise: The instrument; without it a point has 30 µm in each coordinate.
        stated: Whether the estimator is told the noise.
    """

    name: str
    scales: tuple[tuple[str, float], ...] = ()
    heavy: bool = False
    backlash: float = 0.0
    targets: int = 2
    noise: Noise = PLAIN
    stated: bool = False


FAR = LaserTracker(station=np.array([15.0, 0.0, 1.0]))
VISITS = (("repeatability", 1e-4), ("shared", 5e-5))
ALL = (("gravity", 2e-3), ("smooth.size", 3e-4), ("short.size", 2e-4), ("repeatability", 5e-5))
KINDS = (
    Kind("noise only"),
    Kind("gravity", (("gravity", 3e-3),)),
    Kind("smooth joints", (("smooth.size", 4e-4),)),
    Kind("short joints", (("short.size", 3e-4),)),
    Kind("visits", VISITS),
    Kind("visits, sigma stated", VISITS, stated=True),
    Kind("all", ALL),
    Kind("all, one target", ALL, targets=1),
    Kind("gravity, six targets", (("gravity", 3e-3),), targets=6),
    Kind("backlash", backlash=2e-4),
    Kind("tracker at 15 m, stated", noise=FAR, stated=True),
    Kind("noise only, t3", heavy=True),
    Kind("gravity, t3", (("gravity", 3e-3),), heavy=True),
)
LIMITS = np.radians([[-170, 170], [-100, 60], [-100, 60], [-170, 170], [-100, 100], [-170, 170]])
TARGETS = [
    [0.0, 0.05, 0.1],
    [0.08, -0.03, 0.05],
    [-0.04, 0.02, 0.12],
    [0.1, 0.1, 0.1],
    [-0.1, 0.0, 0.05],
    [0, -0.1, 0],
]


def simulated(kind: Kind, seed: int, visits: int = 40, fresh: int = 300) -> dict[str, Any]:
    """A robot drawn from the error model, measured and predicted."""
    rng = np.random.default_rng(seed)
    robot = Robot.load("ur10e").with_targets(TARGETS[: kind.targets]).with_parameters("full")
    model = typical()
    small = {s.name: 1e-12 for s in model.scales if s.name not in ("smooth.length", "short.length")}
    truth = small | {"placement.length": 3e-4, "placement.angle": 6e-4} | dict(kind.scales)
    true_model = model.with_values(truth)
    beta = np.sqrt(true_model.variances(robot)) * rng.standard_normal(len(true_model.variances(robot)))
    q = rng.uniform(LIMITS[:, 0], LIMITS[:, 1], (visits + fresh, 6))
    known = Knowledge(robot, true_model, beta, np.zeros((len(beta),) * 2), np.zeros((len(beta), 0)))
    poses, values = known.poses(q), true_model.values
    joints = values["repeatability"] * rng.standard_normal(q.shape)
    joints += 0.5 * kind.backlash * rng.choice([-1.0, 1.0], q.shape)
    error = np.einsum("nij,nj->ni", poses.levers, joints)
    error += np.tile(values["shared"] * rng.standard_normal((len(q), 3)), kind.targets)
    shape = (len(q), kind.targets, 3)
    draw = rng.standard_t(3, shape) / np.sqrt(3.0) if kind.heavy else rng.standard_normal(shape)
    noise = (np.linalg.cholesky(kind.noise.covariance(poses.points)) @ draw[..., None])[..., 0]
    data = Measurements(robot.joint_names, q, poses.points + error.reshape(shape) + noise)
    nominal = robot.with_parameters("full", ("base", "tool"))
    stated = typical(kind.noise if kind.stated else None)
    found, seconds = timed(nominal, data.select(np.arange(visits)), stated)
    row = judge(found.knowledge, data.select(np.arange(visits, len(q))), found, seconds)
    told = found.knowledge.predict(q[visits:])
    std = np.sqrt(np.diagonal(told.position, axis1=2, axis2=3))
    row["positions"] = float(np.mean(np.abs(told.mean - poses.points[visits:]) <= INSIDE * std))
    at = [found.knowledge.robot.parameter_names.index(n) for n in robot.parameter_names]
    std = np.sqrt(np.diag(found.knowledge.covariance)[at])
    apart = found.knowledge.coefficients[at] - beta[: len(at)]
    row["parameters"] = float(np.mean(np.abs(apart) <= INSIDE * std))
    row["doubted"] = float((found.doubt > 0).any())
    return {"case": f"simulated: {kind.name}", "scales": found.knowledge.model.values, **row}


def many() -> dict[str, Any]:
    """1 000 visits × 3 targets of a robot with every term, for the time it takes."""
    return simulated(Kind("1000 visits x 3", ALL, targets=3), 0, visits=1000)


def show(rows: list[dict[str, Any]]) -> None:
    """Means over the seeds of every case."""
    keys = ["mean_mm", "rms_mm", "predicted", "left_out_mm", "inside", "seconds"]
    keys += ["positions", "parameters", "doubted"]
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
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if (args.data / "irb120_tracker").is_dir():
        rows += irb120(args.data / "irb120_tracker")
        for name, count in (("random_poses", 100), ("random_poses", 30), ("joint_sweeps", 100)):
            rows += ur10(args.data / "ur10_tracker", name, count, args.seeds)
    for kind in KINDS:
        rows += [simulated(kind, seed) for seed in range(args.simulated)]
    rows.append(many())
    show(rows)
    if args.json:
        args.json.write_text(json.dumps({"error_model": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
