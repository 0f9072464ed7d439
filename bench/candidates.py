# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""D-optimal choice from a pool of real configurations, against FIGAROH's SOCP, in one run.

    python bench/candidates.py [--data ../shared/data] [--json FILE] [--figaroh PYTHON] [--sizes 500 2000]

The pool is a seeded random part of ``ur10_tracker/random_poses.csv``; the parameters are all placement errors,
tracker and target unknown (level ``full``, unknown base and tool), reduced to the identifiable ones. Both sides
get the same base regressor and are judged by det(Σ XᵢᵀXᵢ) of the chosen rows, each row once, same number of rows:
those FIGAROH keeps (weight > 1e-5), and the 10, 20 and 30 heaviest. Ours includes the bound and the choice.
FIGAROH (PyPI ``figaroh`` 1.0.2 with picos and cvxopt) may live in another environment: ``--figaroh`` or
the variable FIGAROH_PYTHON names its interpreter; without it only ours is measured. It may take 16 GiB (2000
candidates wanted more than the 24 GiB of a machine); where it has no answer, only ours is measured.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from calib_planner import Robot
from calib_planner.arrays import FloatArray
from calib_planner.identification import start_robot
from calib_planner.io import read_data
from calib_planner.planning import (
    Candidates,
    ChoiceProblem,
    Determinant,
    PlanProblem,
    candidate_design,
    choose,
    plan,
)
from calib_planner.robot import analyse

COUNTS = (10, 20, 30)
MEMORY = 16 * 2**30
"""Bytes that FIGAROH may take: a machine that is out of memory ends other programs, too."""
ROOT = Path(__file__).resolve().parents[1]


def ur10(data: Path) -> tuple[Robot, FloatArray]:
    """The robot with tracker and target at their closed-form start, and all measured configurations."""
    folder = data / "ur10_tracker"
    robot = Robot.load(folder / "ur10.urdf").with_parameters("full", ("base", "tool"))
    measured = read_data(folder / "random_poses.csv", robot).data
    return start_robot(robot, measured.select(np.arange(0, len(measured), 5))), measured.q


def base_rows(robot: Robot, q: FloatArray) -> FloatArray:
    """(C, 3, p) Jacobian in the identifiable parameters, scaled so that the pool's mean information is I.

    D-optimal choices do not depend on the scale; cvxopt does: on the rows in metres and radians it had not
    finished after seven minutes on 500 candidates.
    """
    jacobian = np.ascontiguousarray(robot.jacobian(q))
    found = analyse(jacobian.reshape(-1, jacobian.shape[2]), robot.parameter_names)
    rows = np.ascontiguousarray(jacobian[:, :, sorted(found.free)])
    flat = rows.reshape(-1, rows.shape[2])
    triangle = np.linalg.qr(flat / np.sqrt(len(q)), mode="r")
    return np.ascontiguousarray(np.linalg.solve(triangle.T, flat.T).T).reshape(rows.shape)


def ours(rows: FloatArray, count: int) -> tuple[list[int], float]:
    """Chosen rows and the D-efficiency, from the rows to the answer."""
    nothing = np.zeros((rows.shape[2], rows.shape[2]))
    relaxed = candidate_design(rows, Determinant(), nothing, count, count)
    problem = ChoiceProblem(rows, Determinant(), nothing, count, weights=relaxed.weights)
    found = choose(problem, np.random.default_rng(0))
    return found.rows.tolist(), float(np.exp(found.log_value)) / relaxed.bound


def log_det(rows: FloatArray, chosen: list[int]) -> float:
    """log det of the information of the chosen rows."""
    own = rows[chosen].reshape(-1, rows.shape[2])
    scale = np.linalg.norm(own, axis=0)
    return float(np.linalg.slogdet((own / scale).T @ (own / scale))[1] + 2 * np.log(scale).sum())


def figaroh(rows: FloatArray, python: str) -> dict[str, Any] | None:
    """FIGAROH's weights and seconds, or ``None`` where it is not installed."""
    check = [python, "-c", "import figaroh.optimal.base_optimal_calibration, picos, cvxopt"]
    try:
        if subprocess.run(check, capture_output=True).returncode:
            return None
    except OSError:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pool.npz"
        np.savez(path, rows=rows)
        script = str(Path(__file__).with_name("figaroh_socp.py"))
        done = subprocess.run([python, script, str(path)], capture_output=True, text=True, preexec_fn=_in_memory)
    if done.returncode:
        why = (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]
        print(f"candidates: FIGAROH has no answer for {len(rows)} candidates: {why}", file=sys.stderr)
        return None
    answer: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return answer


def _in_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def compare(robot: Robot, q: FloatArray, python: str | None, repeats: int) -> dict[str, Any]:
    """One pool: every figure of the table."""
    rows = base_rows(robot, q)
    theirs = figaroh(rows, python) if python else None
    counts, ranked = list(COUNTS), []
    if theirs:
        weights = np.array(theirs["weights"])
        ranked = np.argsort(-weights, kind="stable").tolist()
        counts.append(int((weights > 1e-5).sum()))
    result: dict[str, Any] = {"candidates": len(q), "parameters": rows.shape[2], "choices": []}
    result["figaroh_seconds"] = theirs["seconds"] if theirs else None
    for count in counts:
        seconds = []
        for _ in range(repeats):
            began = time.perf_counter()
            chosen, efficiency = ours(rows, count)
            seconds.append(time.perf_counter() - began)
        entry: dict[str, Any] = {"n": count, "seconds": median(seconds), "efficiency": efficiency}
        entry["log_det"] = log_det(rows, chosen)
        if theirs:
            entry["figaroh_log_det"] = log_det(rows, ranked[:count])
            entry["ratio"] = theirs["seconds"] / entry["seconds"]
            entry["d_ratio"] = float(np.exp((entry["log_det"] - entry["figaroh_log_det"]) / rows.shape[2]))
        result["choices"].append(entry)
    began = time.perf_counter()
    plan(PlanProblem(robot, None, 20, criterion="d", candidates=Candidates(q)))
    result["plan_seconds_n20"] = time.perf_counter() - began
    return result


def show(results: list[dict[str, Any]]) -> None:
    """The table."""
    head = f"{'candidates':>10} {'n':>4} {'ours s':>8} {'D-eff.':>7} {'FIGAROH s':>10} {'ratio':>7}"
    print(head + f" {'D ours/FIGAROH':>15}   (D = det^(1/p))")
    for result in results:
        for e in result["choices"]:
            theirs = result["figaroh_seconds"]
            tail = f"{theirs:10.1f} {e['ratio']:7.0f} {e['d_ratio']:15.4f}" if theirs else f"{'not found':>10}"
            print(f"{result['candidates']:10d} {e['n']:4d} {e['seconds']:8.3f} {e['efficiency']:7.3f} {tail}")
        print(f"{'':10} whole plan(), nuisance eliminated, n = 20: {result['plan_seconds_n20']:.2f} s")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figaroh", default=os.environ.get("FIGAROH_PYTHON", sys.executable))
    parser.add_argument("--sizes", type=int, nargs="+", default=[500, 2000])
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    if not (args.data / "ur10_tracker").is_dir():
        print(f"candidates: no measured data at {args.data}: nothing measured")
        return
    robot, q = ur10(args.data)
    rng = np.random.default_rng(0)
    results = []
    for size in args.sizes:
        pool = q[rng.choice(len(q), size, replace=False)]
        results.append(compare(robot, pool, args.figaroh, args.repeats))
    show(results)
    if args.json:
        args.json.write_text(json.dumps({"pools": results}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
