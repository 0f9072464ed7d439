# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Every fault of the simulated shop floor × seeds: is the verdict right, or at least honest?

One run is a campaign in virtual time, without ROS: a robot with drawn errors visits a plan, its messages go
through the standstill detector as the identifier feeds it, accepted standstills are identified with the robust
loss, and the verdict is compared with the truth. Good is PASS with every parameter within 4 standard deviations
of the truth, or WARN, FAIL or a refusal with a reason. PASS beyond that is *wrong*, an exception that is none of
ours a *crash*; both make the exit status 1. Beside it stands the error at a test pose, over the predicted one.

    python bench/fault_matrix.py                        # everything, a few minutes
    python bench/fault_matrix.py --faults reseat_0.3mm drift_0.3mm --seeds 100 --setup placed

Setups: ``known``: KUKA KR-270, tracker and target known, 12 planned configurations of 2 repetitions; ``placed``:
tracker's place and target unknown as well, 30 random configurations. The table goes to stderr, JSON to stdout.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib_planner import IdentificationProblem, Measurements, PlanProblem, Robot, identify, plan
from calib_planner.acquisition import Rejection, Standstill, StandstillDetector, mean_std
from calib_planner.arrays import FloatArray, IntArray
from calib_planner.errors import CalibPlannerError
from calib_planner.identification import Estimate
from calib_planner.io import read_error_model
from calib_planner.planning import Search
from calib_planner.robot import analyse, is_nuisance
from calib_planner.simulation import Faults, SimulatedCell, World, make_tour, play, random_deviations

SIGMA = 3e-5
SPEED, DWELL = 6.0, 0.8
PLAN_TOLERANCE = 0.01
WITHIN = 4.0
VERDICTS = ("PASS", "WARN", "FAIL", "refused", "crash")
POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])
UNKNOWN = (float("nan"), float("nan"))
SPAN = {"known": 45.0, "placed": 60.0}
"""Length of the campaigns, about; speeds of drift are given as what becomes of them until the end [s]."""


def cases(setup: str) -> dict[str, Faults]:
    """Faults by name."""
    span, half = SPAN[setup], 15 if setup == "placed" else 12
    return {
        "none": Faults(),
        "transmission_0.1mrad": Faults(transmission_error=1e-4),
        "encoder_0.05mrad": Faults(encoder_resolution=5e-5),
        "swing_1mm": Faults(unsettled_probability=0.5, oscillation=1e-3),
        "swing_slow": Faults(unsettled_probability=0.5, oscillation=3e-4, oscillation_decay=5.0),
        "creep_0.2mm": Faults(unsettled_probability=0.5, oscillation=0.0, creep=2e-4),
        "reseat_0.03mm": Faults(reseat_at=half, reseat_by=3e-5),
        "reseat_0.3mm": Faults(reseat_at=half, reseat_by=3e-4),
        "reseat_late": Faults(reseat_at=2 * half - 5, reseat_by=3e-4),
        "drift_0.03mm": Faults(drift_translation=3e-5 / span, drift_rotation=1e-5 / span),
        "drift_0.3mm": Faults(drift_translation=3e-4 / span, drift_rotation=1e-4 / span),
        "bump_0.1mm": Faults(bump_at=half, bump_translation=1e-4, bump_rotation=3e-5),
        "outliers_2%": Faults(outlier_probability=0.02),
        "outlier_standstills_10%": Faults(outlier_standstills=0.1),
        "beam_breaks": Faults(beam_break_interval=5.0, beam_break_duration=1.5),
        "relock_0.05mm": Faults(beam_break_interval=5.0, beam_break_duration=0.3, relock_error=5e-5),
        "dropouts_30%": Faults(dropout_probability=0.3),
        "dropouts_80%": Faults(dropout_probability=0.8),
        "latency": Faults(tracker_latency=0.2, tracker_jitter=0.02, joint_latency=0.02, joint_jitter=0.005),
        "latency_2s": Faults(tracker_latency=2.0),
        "clock_+0.1s": Faults(tracker_clock_offset=0.1),
        "clock_-0.3s": Faults(tracker_clock_offset=-0.3),
        "clock_+1s": Faults(tracker_clock_offset=1.0),
        "clock_+3s": Faults(tracker_clock_offset=3.0),
        "clock_drift": Faults(tracker_clock_drift=5e-3),
        "duplicates_reordered": Faults(duplicate_probability=0.1, reorder_probability=0.2),
        "reordered_late": Faults(reorder_probability=0.2, shuffle_delay=0.5),
        "rough": Faults(
            encoder_resolution=1e-5,
            unsettled_probability=0.2,
            outlier_probability=0.01,
            outlier_standstills=0.05,
            beam_break_interval=10.0,
            dropout_probability=0.1,
            tracker_latency=0.1,
            tracker_jitter=0.02,
            tracker_clock_offset=0.02,
            duplicate_probability=0.05,
            reorder_probability=0.05,
        ),
    }


# ── one campaign ─────────────────────────────────────────────────────────────────────────────────────


@dataclass
class Run:
    """One campaign: what became of it."""

    fault: str
    seed: int
    verdict: str
    reasons: list[str]
    worst: float
    at_pose: float
    accepted: int
    rejected: Counter[str] = field(default_factory=Counter)
    why: str = ""

    @property
    def wrong(self) -> bool:
        """PASS, but a parameter is not where its standard deviation says."""
        return self.verdict == "PASS" and not self.worst <= WITHIN


def robot_and_visits(setup: str, seed: int) -> tuple[Robot, FloatArray, IntArray]:
    """Robot with the parameters asked for, configurations (m, joints) and how often each is visited."""
    robot = Robot.load("kuka_kr270")
    if setup == "known":
        return robot, *_planned(robot)
    robot = robot.with_parameters("lengths+offsets", ("base", "tool"))
    low, high = robot.joint_limits.T
    q = np.random.default_rng([seed, 7]).uniform(low, high, (30, len(low)))
    return robot, q, np.ones(len(q), np.int64)


def _planned(robot: Robot) -> tuple[FloatArray, IntArray]:
    if not _PLANNED:
        found = plan(PlanProblem(robot, POSE, configurations=12, noise=SIGMA / 20**0.5, search=Search(starts=8)))
        _PLANNED.append(found.configurations)
    return _PLANNED[0], np.full(len(_PLANNED[0]), 2)


_PLANNED: list[FloatArray] = []


def true_deviations(robot: Robot, q: FloatArray, seed: int) -> dict[str, float]:
    """Drawn errors; none where the data cannot tell, so that truth and estimate mean the same."""
    found = analyse(robot.jacobian(q).reshape(-1, len(robot.parameter_names)), robot.parameter_names)
    kept = {robot.parameter_names[i] for i in found.free}
    drawn = random_deviations(robot, seed)
    return {n: v for n, v in drawn.items() if n in kept and not is_nuisance(n)}


def measure(world: World, q: FloatArray, visits: IntArray) -> tuple[list[Standstill], Counter[str]]:
    """Accepted standstills in the order measured, and the reasons of the others."""
    robot = world.robot
    tour = make_tour(robot.joint_limits.mean(axis=1), q, visits, robot.joint_limits, SPEED, DWELL)
    detector = StandstillDetector(len(robot.joint_names), len(robot.targets))
    found: list[Standstill | Rejection] = []
    for message in play(world, tour):
        if message.stream:
            found += detector.add_point(message.stream - 1, message.stamp, message.values)
        else:
            found += detector.add_joints(message.stamp, message.values)
    found += detector.flush()
    accepted, rejected = [], Counter[str]()
    for one in found:
        if isinstance(one, Rejection):
            rejected[one.reason.value] += 1
        elif np.abs(q - one.joints).max(axis=1).min() > PLAN_TOLERANCE:
            rejected["not_in_plan"] += 1
        else:
            accepted.append(one)
    return accepted, rejected


def run(setup: str, fault: str, seed: int, model: str = "paper") -> Run:
    """One campaign with a robot that errs by the error ``model`` of that name; refusals are verdicts."""
    robot, q, visits = robot_and_visits(setup, seed)
    truth = true_deviations(robot, q, seed)
    cell = SimulatedCell(robot, truth, SIGMA, error_model=read_error_model(model), seed=seed)
    world = World(cell, cases(setup)[fault], seed)
    accepted, rejected = measure(world, q, visits)
    try:
        if not accepted:
            return Run(fault, seed, "refused", ["no standstill"], *UNKNOWN, 0, rejected)
        points = np.array([one.points for one in accepted])
        joints = np.array([one.joints for one in accepted])
        data = Measurements(robot.joint_names, joints, points, mean_std(accepted, SIGMA))
        found = identify(IdentificationProblem(robot, data, loss="robust", test_poses=POSE))
    except CalibPlannerError as error:
        return Run(fault, seed, "refused", [str(error)], *UNKNOWN, len(accepted), rejected)
    codes = [r.code for r in found.verdict.reasons if r.level != "PASS"]
    worst, where = worst_error(found, truth)
    at_pose = error_at_pose(found, world)
    return Run(fault, seed, found.verdict.level, codes, worst, at_pose, len(accepted), rejected, where)


def worst_error(found: Estimate, truth: dict[str, float]) -> tuple[float, str]:
    """Largest |error|/std of the robot's own parameters that were identified, and whose."""
    worst, where = 0.0, ""
    for name, value, std in zip(found.fit.parameters, found.fit.deviations, found.fit.std, strict=True):
        if is_nuisance(name) or not np.isfinite(std) or name in found.observability.fixed:
            continue
        ratio = abs(value - truth.get(name, 0.0)) / std
        if ratio > worst:
            worst, where = float(ratio), name
    return worst, where


def error_at_pose(found: Estimate, world: World) -> float:
    """Distance between the true target and the prediction at ``POSE``, over the predicted accuracy there."""
    error = world.truth.positions(POSE) - found.positions(POSE)
    return float(np.linalg.norm(error) / found.accuracy.overall)


# ── the matrix ───────────────────────────────────────────────────────────────────────────────────────


def row(runs: Sequence[Run]) -> dict[str, Any]:
    """A line of the table."""
    levels = Counter(r.verdict for r in runs)
    worst = [r.worst for r in runs if np.isfinite(r.worst)]
    passed = [r.worst for r in runs if r.verdict == "PASS"]
    rejected: Counter[str] = sum((r.rejected for r in runs), Counter())
    return {
        "levels": dict(levels),
        "worst": max(worst, default=float("nan")),
        "worst_of_pass": max(passed, default=float("nan")),
        "worst_at_pose_of_pass": max((r.at_pose for r in runs if r.verdict == "PASS"), default=float("nan")),
        "accepted": float(np.mean([r.accepted for r in runs])),
        "rejected": {k: v / len(runs) for k, v in rejected.items()},
        "reasons": dict(Counter(code for r in runs for code in set(r.reasons))),
        "wrong": [{"seed": r.seed, "worst": r.worst, "parameter": r.why} for r in runs if r.wrong],
        "crashes": [{"seed": r.seed, "error": r.why} for r in runs if r.verdict == "crash"],
    }


def show(name: str, line: dict[str, Any]) -> None:
    """The same for people."""
    levels = line["levels"]
    text = f"{name:<24}" + "".join(
        f" {levels.get(k, 0):>7}" for k in ("PASS", "WARN", "FAIL", "refused", "crash")
    )
    text += f" {line['worst_of_pass']:9.1f} {line['worst']:8.1f} {line['worst_at_pose_of_pass']:8.1f}"
    text += f" {len(line['wrong']):6} {line['accepted']:9.1f}  "
    text += ", ".join(f"{k} {v:.1f}" for k, v in line["rejected"].items()) or "–"
    print(text, file=sys.stderr, flush=True)


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--setup", nargs="+", choices=list(SPAN), default=list(SPAN))
    parser.add_argument("--faults", nargs="+", choices=list(cases("known")), default=list(cases("known")))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--error-model", default="paper", help="how the robots err: paper (noise alone), typical")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    args = parser.parse_args()
    if args.seeds < 1:
        parser.error("--seeds: at least 1")
    result: dict[str, Any] = {}
    bad = 0
    for setup in args.setup:
        began = time.perf_counter()
        print(f"\n{setup}: verdicts of {args.seeds} campaigns, worst |error|/std", file=sys.stderr)
        head = f"{'fault':<24}    PASS    WARN    FAIL refused   crash   of PASS   of all  at pose  wrong"
        print(f"{head}  accepted  rejected per campaign", file=sys.stderr)
        result[setup] = {}
        for fault in args.faults:
            runs = []
            for seed in range(args.first, args.first + args.seeds):
                try:
                    runs.append(run(setup, fault, seed, args.error_model))
                except Exception as error:
                    why = f"{type(error).__name__}: {error}"
                    runs.append(Run(fault, seed, "crash", [], *UNKNOWN, 0, why=why))
            line = result[setup][fault] = row(runs)
            bad += len(line["wrong"]) + len(line["crashes"])
            show(fault, line)
        print(f"{time.perf_counter() - began:.0f} s", file=sys.stderr)
    print(json.dumps(result, indent=1))
    return int(bad > 0)


if __name__ == "__main__":
    raise SystemExit(main())
