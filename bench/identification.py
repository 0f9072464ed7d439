# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification: speed and held-out error against FIGAROH. (Measured robots: bench/error_model.py.)

    python bench/identification.py [--sections figaroh kuka] [--figaroh PYTHON] [--data ../shared/data]
                                   [--json FILE] [--cells 3] [--repeats 5]

``figaroh``  Simulated cells around the UR10 of ``ur10_tracker/ur10.urdf``: all placement errors (0.5 mm, 1 mrad),
             base and three targets unknown, 100 configurations, 0.03 mm of noise. The same file to both sides;
             error: mean distance to the true points at 200 other configurations. FIGAROH's time is its
             ``initialize`` and ``solve``, which read the file; ours is shown for ``identify`` alone and with
             reading the file. FIGAROH (PyPI ``figaroh`` 1.0.2) may live in another environment: ``--figaroh`` or
             the variable FIGAROH_PYTHON names its interpreter; without it only ours is measured. Its four ways
             are told in ``figaroh_identification.py``.
``kuka``     The same size and errors with the shipped KR-270, ours only.

Ours is measured as the paper has it, the same least squares as FIGAROH's, and as it comes, with all terms of the
error model. The table goes to stderr; the figures, JSON, to FILE or stdout.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from calib_planner import IdentificationProblem, Robot, identify
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel
from calib_planner.identification import Estimate
from calib_planner.io import read_data, write_measurements
from calib_planner.measurements import Measurements
from calib_planner.robot import rotation
from calib_planner.simulation import SimulatedCell, random_deviations

ROOT = Path(__file__).resolve().parents[1]
SECTIONS = ("figaroh", "kuka")
TARGETS = np.array([[0.05, 0.02, 0.12], [-0.06, 0.04, 0.10], [0.01, -0.07, 0.14]])
LENGTH, ANGLE, SIGMA = 5e-4, 1e-3, 3e-5
FITTED, HELD_OUT = 100, 200


def ways() -> dict[str, dict[str, Any]]:
    """Ways of identifying: name → further arguments of the problem."""
    return {"ours": {"error_model": ErrorModel.paper()}, "ours, all terms": {}}


# ── simulated cells ──────────────────────────────────────────────────────────────────────────────────


def simulate(robot: Robot, seed: int, limit: float = np.pi) -> tuple[Measurements, Measurements]:
    """What is fitted, with noise, and the true points of the held-out configurations."""
    rng = np.random.default_rng(seed)
    yaw, pitch, roll = rng.uniform([-np.pi, -0.5, -0.5], [np.pi, 0.5, 0.5])
    place = rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
    real = robot.with_targets(TARGETS).with_base(place, rng.uniform(-3.0, 3.0, 3)).with_parameters("full")
    deviations = random_deviations(real, seed, LENGTH, ANGLE)
    low, high = np.clip(robot.joint_limits, -limit, limit).T
    q = rng.uniform(low, high, (FITTED + HELD_OUT, len(low)))
    fitted = SimulatedCell(real, deviations, SIGMA).measure(q[:FITTED], 1, seed)
    return fitted, SimulatedCell(real, deviations, 0.0).measure(q[FITTED:], 1, seed)


def asked(robot: Robot) -> Robot:
    """The robot as a user without any knowledge of the cell states it."""
    return robot.with_targets(np.zeros_like(TARGETS)).with_parameters("full", ("base", "tool"))


def found_by(robot: Robot, data: Measurements, options: dict[str, Any]) -> Estimate:
    """The job that is timed."""
    return identify(IdentificationProblem(robot, data, **{"sigma": SIGMA} | options))


def timed(robot: Robot, path: Path, options: dict[str, Any], repeats: int) -> FloatArray:
    """(repeats, 4) seconds by the clock and of the processor, without and with reading the file."""
    data = read_data(path, robot).data
    seconds = []
    for _ in range(repeats):
        times = [(time.perf_counter(), time.process_time())]
        found_by(robot, data, options)
        times.append((time.perf_counter(), time.process_time()))
        found_by(robot, read_data(path, robot).data, options)
        times.append((time.perf_counter(), time.process_time()))
        seconds.append(np.diff(times, axis=0).ravel())
    return np.array(seconds)


def mean_error(points: FloatArray, truth: Measurements) -> float:
    """Mean distance of (N, targets, 3) points to the true ones [m]."""
    return float(np.linalg.norm(points - truth.p, axis=2).mean())


def figaroh(urdf: Path, folder: Path, truth: Measurements, python: str) -> dict[str, Any]:
    """FIGAROH's seconds and held-out error, per cost function."""
    script = str(Path(__file__).with_name("figaroh_identification.py"))
    done = subprocess.run([python, script, str(urdf), str(folder)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"identification: FIGAROH failed:\n{done.stderr[-2000:]}")
    answer: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    for one in answer.values():
        one["error_m"] = mean_error(np.array(one.pop("held_out")).reshape(truth.p.shape), truth)
        one["seconds"] = one["initialize"] + one["solve"]
    return answer


def installed(python: str) -> bool:
    """Whether that interpreter has FIGAROH."""
    try:
        check = [python, "-c", "import figaroh.calibration.base_calibration"]
        return not subprocess.run(check, capture_output=True).returncode
    except OSError:
        return False


def one_cell(robot: Robot, seed: int, urdf: Path | None, python: str | None, repeats: int) -> dict[str, Any]:
    """Ours, FIGAROH where there is one, ours again: what else the machine does falls on both."""
    question = asked(robot)
    fitted, truth = simulate(robot, seed)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "fit.csv"
        write_measurements(path, fitted)
        write_measurements(path.with_name("held_out.csv"), truth)
        mine = ways()
        before = {name: timed(question, path, options, repeats) for name, options in mine.items()}
        theirs = figaroh(urdf, path.parent, truth, python) if urdf and python else {}
        after = {name: timed(question, path, options, repeats) for name, options in mine.items()}
        data = read_data(path, question).data
    run: dict[str, Any] = {}
    for name, options in mine.items():
        keys = ("seconds", "cpu_seconds", "seconds_with_file", "cpu_seconds_with_file")
        times = np.median(np.vstack([before[name], after[name]]), axis=0)
        found = found_by(question, data, options)
        run[name] = dict(zip(keys, times, strict=True)) | {"first_seconds": before[name][0, 0]}
        run[name] |= {
            "error_m": mean_error(found.positions(truth.q), truth),
            "parameters": found.observability.rank,
        }
        run[name] |= {"used": found.points.used, "iterations": found.fit.iterations, "status": found.fit.status}
    return run | theirs


def compare(robot: Robot, urdf: Path | None, python: str | None, cells: int, repeats: int) -> dict[str, Any]:
    """Medians over the cells; ratios of FIGAROH's to ours."""
    runs = [one_cell(robot, seed, urdf, python, repeats) for seed in range(cells)]
    result: dict[str, Any] = {"parameters": len(asked(robot).parameter_names), "cells": runs, "medians": {}}
    for side in runs[0]:
        keys = [k for k, v in runs[0][side].items() if isinstance(v, (int, float))]
        result["medians"][side] = {k: median(run[side][k] for run in runs) for k in keys}
    mine = result["medians"]["ours"]
    for side, theirs in result["medians"].items():
        if not side.startswith("ours"):
            theirs["ratio"] = theirs["seconds"] / mine["seconds"]
            theirs["ratio_cpu"] = theirs["cpu_seconds"] / mine["cpu_seconds"]
            theirs["ratio_with_file"] = theirs["seconds"] / mine["seconds_with_file"]
            theirs["error_ratios"] = [run["ours"]["error_m"] / run[side]["error_m"] for run in runs]
    return result


def show_times(name: str, result: dict[str, Any]) -> None:
    """The table of one robot; errors of ours as shares of FIGAROH's."""
    head = f"{name:<24} {'s':>8} {'CPU s':>8} {'fitted':>6} {'held-out µm':>11}"
    print(head + "   FIGAROH/ours: s, CPU, with our reading; ours/FIGAROH: error per cell", file=sys.stderr)
    for side, row in result["medians"].items():
        text = f"{side:<24} {row['seconds']:8.4f} {row['cpu_seconds']:8.4f} {row['parameters']:6.0f}"
        text += f" {1e6 * row['error_m']:11.2f}"
        if side.startswith("ours"):
            text += f"   with the file {row['seconds_with_file']:.4f} s; first run {row['first_seconds']:.4f} s"
        else:
            text += f"   {row['ratio']:.1f}, {row['ratio_cpu']:.1f}, {row['ratio_with_file']:.1f}; "
            text += " ".join(f"{e:.5f}" for e in row["error_ratios"])
        print(text, file=sys.stderr)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figaroh", default=os.environ.get("FIGAROH_PYTHON", sys.executable))
    parser.add_argument("--cells", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    if min(args.cells, args.repeats) < 1:
        parser.error("--cells and --repeats: at least 1")
    folder, result = args.data / "ur10_tracker", {}
    if not folder.is_dir() and args.sections != ["kuka"]:
        print(f"identification: no measured data at {args.data}: only kuka needs none", file=sys.stderr)
        args.sections = [s for s in args.sections if s == "kuka"]
    if "figaroh" in args.sections:
        python = args.figaroh if installed(args.figaroh) else None
        if not python:
            print(f"identification: no FIGAROH in {args.figaroh}: only ours is measured", file=sys.stderr)
        urdf = folder / "ur10.urdf"
        result["figaroh"] = compare(Robot.load(urdf), urdf, python, args.cells, args.repeats)
        show_times("UR10", result["figaroh"])
    if "kuka" in args.sections:
        result["kuka"] = compare(Robot.load("kuka_kr270"), None, None, args.cells, args.repeats)
        show_times("KR-270", result["kuka"])
    text = json.dumps(result, indent=1)
    if args.json:
        args.json.write_text(text + "\n", encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
