# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Does the identification know how sure it is, and what does not belong? Simulated cells, many seeds.

    python bench/coverage.py [--sections coverage outliers breakdown scales] [--cases WORD …] [--seeds 500]
                             [--workers 2] [--json FILE]

Everything is drawn anew for each seed: the robot's errors, where it stands, the configurations, the noise. The
last three sections take fewer seeds: two fifths, a tenth, two fifths.

``coverage``   Share of the parameters whose true value lies in value ± 1.96 std, over all parameters and of the
               worst one; root mean square of achieved over predicted error at 20 test poses; share of the
               coordinates there within 95 %; share of fresh measured points inside their 95 % region.
``outliers``   5 % of the points off by 10–50 mm in any direction and 1 % of the rows exchanged: held-out error of
               the robust loss over that of the same set before it was spoilt; missed and false alarms. A fit to
               fewer points errs more even if it knew which: ``fewest`` is that, a fit to the good points alone.
``breakdown``  The same without exchanged rows for 10 … 45 % of gross errors.
``scales``     Estimated scales of the error model over those simulated, root mean square over the seeds; the
               floor holds the noise where nobody states it. How often a term was dropped that is there, and
               kept that is not.

The table goes to stderr; the figures, JSON, to FILE or stdout.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from simulated_cells import SIGMA, Case, cell_of, parameter_errors, spoil

from calib_planner import identify, validate
from calib_planner.errors import NotEnoughDataError
from calib_planner.identification import Estimate
from calib_planner.measurements import Measurements

SECTIONS = {"coverage": 1.0, "outliers": 0.4, "breakdown": 0.1, "scales": 0.4}
"""Share of the seeds that each takes."""
KNOWN = {"sigma": SIGMA}
ROBUST = {"loss": "robust"}
INSIDE = 1.959964
"""Standard deviations that hold 95 %."""

FULL = Case(level="full", placed=True, targets=3, count=40)
MODEL = replace(FULL, asked="typical", targets=2)
GRAVITY, SMOOTH, SHORT = {"gravity": 5e-4}, {"smooth.size": 3e-4}, {"short.size": 2e-4}
VISITS = {"repeatability": 5e-5, "shared": 4e-5, "floor": 3e-5}
ALL = {**GRAVITY, **SMOOTH, **SHORT, **VISITS}
COVERAGE = {
    "planar, sigma known": Case(robot="planar_2r", options=KNOWN),
    "planar, sigma unknown": Case(robot="planar_2r"),
    "kuka, sigma known": Case(options=KNOWN),
    "kuka, sigma unknown": Case(),
    "kuka, sigma unknown, 6 rows": Case(count=6),
    "kuka, 10 × 3, sigma unknown": Case(count=10, repetitions=3),
    "kuka, robust": Case(asked="typical", options=ROBUST | KNOWN),
    "kuka, 5 % gross": Case(count=40, asked="typical", options=KNOWN, gross=0.05, exchanged=True),
    "kuka, prior": Case(count=8, options=KNOWN, prior=True),
    "full, prior": Case(level="full", count=20, options=KNOWN, prior=True),
    "base+tool, sigma known": replace(FULL, level="lengths+offsets", options=KNOWN),
    "full+base+tool, sigma known": replace(FULL, options=KNOWN),
    "full+base+tool, sigma unknown": FULL,
    "model, noise only": MODEL,
    "model, gravity": replace(MODEL, scales=GRAVITY),
    "model, smooth": replace(MODEL, scales=SMOOTH),
    "model, short": replace(MODEL, scales=SHORT),
    "model, visits, sigma known": replace(MODEL, scales=VISITS, options=KNOWN),
    "model, all": replace(MODEL, scales=ALL),
    "model, all, 100 rows": replace(MODEL, scales=ALL, count=100),
    "model, all, 20 × 3": replace(MODEL, scales=ALL, count=20, repetitions=3),
    "model, all, 5 % gross": replace(MODEL, scales=ALL, gross=0.05),
    "model, all, known base and tool": replace(MODEL, scales=ALL, placed=False),
    "without gravity, gravity": replace(MODEL, scales=GRAVITY, asked="gravity"),
    "without smooth, smooth": replace(MODEL, scales=SMOOTH, asked="smooth"),
    "without short, short": replace(MODEL, scales=SHORT, asked="short"),
    "without visits, visits": replace(MODEL, scales=VISITS, asked="visits"),
}
SPOILT = Case(count=100, asked="typical", gross=0.05, exchanged=True)
OUTLIERS = {
    "planar": replace(SPOILT, robot="planar_2r"),
    "kuka": SPOILT,
    "kuka, 40 rows": replace(SPOILT, count=40),
    "full+base+tool": replace(SPOILT, level="full", placed=True, targets=3),
    "full+base+tool, 1 target": replace(SPOILT, level="full", placed=True),
    "model, all": replace(SPOILT, level="full", placed=True, targets=2, scales=ALL),
}
BREAKDOWN = {
    f"{name}, {share:.0%}": replace(case, gross=share, exchanged=False, count=60)
    for name, case in (("kuka", SPOILT), ("full", OUTLIERS["full+base+tool"]), ("model", OUTLIERS["model, all"]))
    for share in (0.1, 0.2, 0.3, 0.4, 0.45)
}
SCALES = {name: case for name, case in COVERAGE.items() if name.startswith("model")}
TERMS = {"gravity": "gravity", "smooth.size": "smooth", "short.size": "short"}
"""Scale → the term that has to better the left-out score."""


# ── one seed ─────────────────────────────────────────────────────────────────────────────────────────


def mistakes(found: Estimate, bad: NDArray[np.bool_]) -> dict[str, int]:
    """Bad points that were used and good ones that were not."""
    out = np.zeros_like(bad)
    for point in found.points.rejected:
        out[point.row, point.target - 1] = True
    return {"bad": int(bad.sum()), "missed": int((bad & ~out).sum()), "false_alarms": int((out & ~bad).sum())}


def one_interval(case: Case, seed: int) -> dict[str, Any]:
    """Normalised errors of the parameters, and achieved and predicted errors."""
    cell = cell_of(case, seed)
    data, bad = spoil(cell.measure(cell.configurations(case.count), case.repetitions), case, cell.rng)
    poses = cell.configurations(20)
    problem = cell.problem(data, test_poses=poses)
    found = identify(problem)
    told = found.knowledge.predict(poses)
    left = told.mean - cell.truth.positions(poses)
    checked = validate(problem, found, [cell.measure(poses, 1)]).validation
    assert checked is not None
    return {
        "errors": parameter_errors(found, cell),
        "achieved": float(np.mean(np.sum(left**2, axis=2))),
        "predicted": float(np.mean(found.accuracy.predicted**2)),
        "positions": float(np.mean(np.abs(left) <= INSIDE * np.sqrt(np.diagonal(told.position, 0, 2, 3)))),
        "within_95": checked.within_95,
        **mistakes(found, bad),
    }


def one_spoilt(case: Case, seed: int) -> dict[str, Any]:
    """Held-out error with gross errors, without them, and of the good points alone; noise given and not."""
    cell = cell_of(case, seed)
    clean = cell.measure(cell.configurations(case.count), 1)
    spoilt, bad = spoil(clean, case, cell.rng)
    good = Measurements(clean.joint_names, clean.q, np.where(bad[:, :, None], np.nan, clean.p))
    poses = cell.configurations(200)

    def square(found: Estimate) -> float:
        return float(np.mean(np.sum((found.positions(poses) - cell.truth.positions(poses)) ** 2, axis=2)))

    result: dict[str, Any] = {}
    for label, options in (("known", KNOWN), ("unknown", {})):
        run = {
            "clean": square(identify(cell.problem(clean, **options))),
            "fewest": square(identify(cell.problem(good, **options))),
        }
        try:
            found = identify(cell.problem(spoilt, **options | ROBUST))
            run |= {"spoilt": square(found), **mistakes(found, bad), "failed": found.verdict.level == "FAIL"}
        except NotEnoughDataError:
            run |= {"refused": True}
        result[label] = run
    return result


def one_scales(case: Case, seed: int) -> dict[str, Any]:
    """The scales as estimated, and the terms kept."""
    cell = cell_of(case, seed)
    data, _ = spoil(cell.measure(cell.configurations(case.count), case.repetitions), case, cell.rng)
    found = identify(cell.problem(data))
    terms = {t.name: t.used for t in found.terms}
    return {"values": found.knowledge.model.values, "kept": terms, "seconds": found.seconds}


# ── all seeds ────────────────────────────────────────────────────────────────────────────────────────


def coverage(case: Case, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares of intervals that hold the truth."""
    names = dict.fromkeys(n for r in runs for n in r["errors"])
    inside = {n: [abs(r["errors"][n]) <= INSIDE for r in runs if n in r["errors"]] for n in names}
    often = {n: float(np.mean(i)) for n, i in inside.items() if len(i) > 0.9 * len(runs)}
    worst = min(often, key=lambda n: often[n])
    ratio = np.mean([r["achieved"] for r in runs]) / np.mean([r["predicted"] for r in runs])
    return {
        "inside": float(np.mean([x for i in inside.values() for x in i])),
        "worst": [worst, often[worst]],
        "achieved_over_predicted": float(np.sqrt(ratio)),
        "positions": float(np.mean([r["positions"] for r in runs])),
        "within_95": float(np.mean([r["within_95"] for r in runs])),
        "missed": sum(r["missed"] for r in runs),
        "false_alarms": sum(r["false_alarms"] for r in runs),
    }


def outliers(case: Case, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Ratios of held-out errors, with the noise given and unknown."""
    result: dict[str, Any] = {}
    for label in ("known", "unknown"):
        those = [r[label] for r in runs if "spoilt" in r[label]]
        if not those:
            result[label] = {"refused": len(runs)}
            continue
        table = np.array([[r["spoilt"], r["fewest"], r["clean"]] for r in those])
        ratio = np.sqrt(table[:, 0] / table[:, 2])
        over_fewest = np.sqrt(table[:, 0] / table[:, 1])
        failed = np.array([r["failed"] for r in those])
        result[label] = {
            "rms_ratio": float(np.sqrt(table[:, 0].mean() / table[:, 2].mean())),
            "rms_ratio_fewest": float(np.sqrt(table[:, 1].mean() / table[:, 2].mean())),
            "median": float(np.median(ratio)),
            "p95": float(np.quantile(ratio, 0.95)),
            "largest": float(ratio.max()),
            "largest_over_fewest": float(over_fewest.max()),
            "above_1.2": float(np.mean(ratio > 1.2)),
            "above_1.2_not_failed": float(np.mean((ratio > 1.2) & ~failed)),
            "bad": sum(r["bad"] for r in those),
            "missed": sum(r["missed"] for r in those),
            "false_alarms": sum(r["false_alarms"] for r in those),
            "refused": len(runs) - len(those),
        }
    return result


def scales(case: Case, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Estimated over simulated."""
    result: dict[str, Any] = {"seconds": float(np.mean([r["seconds"] for r in runs]))}
    truth = case.scales | {
        "floor": float(np.hypot(case.scales.get("floor", 0.0), 0.0 if case.options else SIGMA))
    }
    for name, true in truth.items():
        if not true:
            continue
        squares = np.array([r["values"].get(name, 0.0) ** 2 for r in runs])
        result[name] = float(np.sqrt(squares.mean()) / true)
    for name, term in TERMS.items():
        often = float(np.mean([r["kept"][term] for r in runs]))
        result[f"{term} {'dropped' if name in case.scales else 'kept'}"] = (
            1 - often if name in case.scales else often
        )
    return result


Study = tuple[dict[str, Case], Callable[[Case, int], dict[str, Any]], Callable[..., dict[str, Any]]]
STUDIES: dict[str, Study] = {
    "coverage": (COVERAGE, one_interval, coverage),
    "outliers": (OUTLIERS, one_spoilt, outliers),
    "breakdown": (BREAKDOWN, one_spoilt, outliers),
    "scales": (SCALES, one_scales, scales),
}


def study(section: str, words: Sequence[str], seeds: int, pool: Executor) -> Iterator[tuple[str, dict[str, Any]]]:
    """Each case of a section with its figures."""
    cases, one, summary = STUDIES[section]
    seeds = max(1, round(SECTIONS[section] * seeds))
    for name, case in cases.items():
        if words and not any(word in name for word in words):
            continue
        began = time.perf_counter()
        runs = list(pool.map(partial(one, case), range(seeds), chunksize=5))
        yield name, summary(case, runs) | {"seeds": seeds, "seconds": time.perf_counter() - began}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--sections", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--cases", nargs="+", default=[], metavar="WORD", help="only cases that hold a word")
    parser.add_argument("--seeds", type=int, default=500)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    result: dict[str, Any] = {}
    with ProcessPoolExecutor(args.workers) as pool:
        for section in args.sections:
            result[section] = {}
            for name, figures in study(section, args.cases, args.seeds, pool):
                result[section][name] = figures
                print(f"{section:10s} {name:40s} {json.dumps(figures)}", file=sys.stderr, flush=True)
    text = json.dumps(result, indent=1)
    if args.json:
        args.json.write_text(text + "\n")
    else:
        print(text)


if __name__ == "__main__":
    main()
