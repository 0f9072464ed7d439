"""Does the identification know how sure it is, and what does not belong? Simulated cells, many seeds.

    python bench/coverage.py [--sections coverage outliers breakdown noise] [--seeds 500] [--workers 2]
                             [--json FILE]

Everything is drawn anew for each seed: the robot's errors, where it stands, the configurations, the noise. The
last three sections take fewer seeds: two fifths, a tenth, two fifths.

``coverage``   Share of the parameters whose true value lies in value ± t·std (95 %; t of Student where residuals
               told the noise, normal where it is known), over all parameters and of the worst one, and
               the share inside ± 1.96 std; root mean square of achieved over predicted error at 20 test poses;
               share of fresh measured points inside their 95 % region. Where base and targets are unknown the
               truth is what reproduces the true robot with the same parameters held.
``outliers``   5 % of the points off by 10–50 mm in any direction and 1 % of the rows exchanged: held-out error of
               the robust loss over that of the same set before it was spoilt; missed and false alarms. A fit to
               fewer points errs more even if it knew which: ``fewest`` is that, a fit to the good points alone.
``breakdown``  The same without exchanged rows for 10 … 45 % of gross errors.
``noise``      Root mean square of the parts of the scatter that were found over what was simulated; how often a
               discrepancy, or repetitions that contradict the stated noise, were found where there was none.

Model discrepancy is simulated as an error of each joint's transmission, a random function of its angle with a
squared exponential spectrum (0.35 mrad, several lengths), and a white error of each configuration and target.
The table goes to stderr; the figures, JSON, to FILE or stdout.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from scipy.stats import t as student
from simulated_cells import SIGMA, Case, Cell, cell_of, spoil, true_deviations

from calib_planner import IdentificationProblem, identify, validate
from calib_planner.errors import NotEnoughDataError
from calib_planner.identification import Estimate
from calib_planner.measurements import Measurements

SECTIONS = {"coverage": 1.0, "outliers": 0.4, "breakdown": 0.1, "noise": 0.4}
"""Share of the seeds that each takes."""
TURNING, WHITE = 3.5e-4, 1e-4
KNOWN = {"sigma": SIGMA}
ROBUST = {"loss": "robust"}


FULL = Case(level="full", placed=True, targets=3, count=40)
WRONG = Case(count=40, turning=TURNING, white=WHITE, options=KNOWN)
COVERAGE = {
    "planar, sigma known": Case(robot="planar_2r", options=KNOWN),
    "planar, sigma unknown": Case(robot="planar_2r"),
    "kuka, sigma known": Case(options=KNOWN),
    "kuka, sigma unknown": Case(),
    "kuka, sigma unknown, 6 rows": Case(count=6),
    "kuka, 10 × 3, sigma unknown": Case(count=10, repetitions=3),
    "kuka, robust": Case(options=ROBUST | KNOWN),
    "kuka, robust, sigma unknown": Case(options=ROBUST),
    "kuka, 5 % gross, robust": Case(count=40, options=ROBUST | KNOWN, gross=0.05, exchanged=True),
    "kuka, prior": Case(count=8, options=KNOWN, prior=True),
    "kuka, prior, sigma unknown": Case(count=8, prior=True),
    "full, prior": Case(level="full", count=20, options=KNOWN, prior=True),
    "base+tool, sigma known": replace(FULL, level="lengths+offsets", options=KNOWN),
    "full+base+tool, sigma known": replace(FULL, options=KNOWN),
    "full+base+tool, sigma unknown": FULL,
    "full+base+tool, 5 % gross, robust": replace(FULL, options=ROBUST, gross=0.05, exchanged=True),
    "discrepancy, white": replace(WRONG, turning=0.0),
    "discrepancy, length 0.07": WRONG,
    "discrepancy, length 0.07, 100 rows": replace(WRONG, count=100),
    "discrepancy, length 0.3": replace(WRONG, length=0.3),
    "discrepancy, length 1": replace(WRONG, length=1.0),
    "discrepancy, 20 × 3, sigma unknown": replace(WRONG, count=20, repetitions=3, options={}),
    "discrepancy, sigma unknown": replace(WRONG, options={}),
    "discrepancy, robust": replace(WRONG, options=ROBUST | KNOWN),
}
SPOILT = Case(count=100, gross=0.05, exchanged=True)
OUTLIERS = {
    "planar": replace(SPOILT, robot="planar_2r"),
    "kuka": SPOILT,
    "kuka, 40 rows": replace(SPOILT, count=40),
    "full+base+tool": replace(SPOILT, level="full", placed=True, targets=3),
    "full+base+tool, 1 target": replace(SPOILT, level="full", placed=True),
}
BREAKDOWN = {
    f"{name}, {share:.0%}": replace(case, gross=share, exchanged=False)
    for name, case in (("kuka", SPOILT), ("full+base+tool", replace(OUTLIERS["full+base+tool"], count=60)))
    for share in (0.1, 0.2, 0.3, 0.4, 0.45)
}
NOISE = {
    "clean": Case(options=KNOWN),
    "clean, 10 × 3": Case(count=10, repetitions=3, options=KNOWN),
    "clean, 10 × 3, sigma unknown": Case(count=10, repetitions=3),
    "clean, 20 and one 3 times, sigma unknown": Case(count=20, repetitions=0),
    "stated half, 15 × 2": Case(count=15, repetitions=2, options={"sigma": SIGMA / 2}),
    "white": replace(WRONG, turning=0.0),
    "transmission": replace(WRONG, white=0.0),
    "both": WRONG,
    "both, 100 rows": replace(WRONG, count=100),
    "both, 20 × 3": replace(WRONG, count=20, repetitions=3),
}


# ── one seed ─────────────────────────────────────────────────────────────────────────────────────────


def problem_of(cell: Cell, data: Measurements, **changes: Any) -> IdentificationProblem:
    return IdentificationProblem(cell.asked, data, prior=cell.prior, starts=0, **cell.case.options | changes)


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
    problem = problem_of(cell, data, test_poses=poses)
    found = identify(problem)
    freedom = {"residuals": found.residuals.chi_square.freedom, "repetitions": found.noise.repeat_freedom}
    factor = student.ppf(0.975, freedom.get(found.noise.source, np.inf))
    error = (found.fit.deviations - true_deviations(problem, found, cell)) / found.fit.std
    left = found.positions(poses) - cell.points(poses)
    checked = validate(problem, found, [cell.measure(poses, 1)]).validation
    assert checked is not None
    return {
        "names": found.fit.parameters,
        "error": error,
        "factor": float(factor),
        "achieved": float(np.mean(np.sum(left**2, axis=2))),
        "predicted": found.accuracy.overall**2,
        "within_95": checked.within_95,
        "corrections": found.transmission is not None,
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
        return float(np.mean(cell.truth.position_errors(found.calibrated, poses) ** 2))

    result: dict[str, Any] = {}
    for label, options in (("known", KNOWN), ("unknown", {})):
        run = {
            "clean": square(identify(problem_of(cell, clean, **options))),
            "fewest": square(identify(problem_of(cell, good, **options))),
        }
        try:
            found = identify(problem_of(cell, spoilt, **options | ROBUST))
            run |= {"spoilt": square(found), **mistakes(found, bad)}
        except NotEnoughDataError:
            run |= {"refused": True}
        result[label] = run
    return result


def one_noise(case: Case, seed: int) -> dict[str, Any]:
    """The parts of the scatter."""
    cell = cell_of(case, seed)
    found = identify(problem_of(cell, cell.measure(cell.configurations(case.count), case.repetitions)))
    noise = found.noise
    parts = {name: getattr(noise, name) for name in ("measurement", "repeatability", "point", "turning")}
    return parts | {
        "found": noise.discrepancy > 0,
        "scaled": noise.scaled > 1,
        "seconds": found.diagnostics.seconds,
    }


# ── all seeds ────────────────────────────────────────────────────────────────────────────────────────


def coverage(case: Case, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares of intervals that hold the truth."""
    errors, factors = np.array([r["error"] for r in runs]), np.array([r["factor"] for r in runs])
    kept = np.isfinite(errors)
    inside = np.where(kept, np.abs(errors) <= factors[:, None], np.nan)
    often = kept.sum(axis=0) > 0.9 * len(runs)
    per = np.nanmean(inside[:, often], axis=0)
    names = np.array(runs[0]["names"])[often]
    return {
        "inside": float(np.nanmean(inside)),
        "inside_normal": float(np.mean(np.abs(errors[kept]) <= norm.ppf(0.975))),
        "worst": [str(names[np.argmin(per)]), float(per.min())],
        "achieved_over_predicted": float(
            np.sqrt(np.mean([r["achieved"] for r in runs]) / np.mean([r["predicted"] for r in runs]))
        ),
        "within_95": float(np.mean([r["within_95"] for r in runs])),
        "corrections": float(np.mean([r["corrections"] for r in runs])),
        "missed": sum(r["missed"] for r in runs),
        "false_alarms": sum(r["false_alarms"] for r in runs),
    }


def outliers(case: Case, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Ratios of held-out errors, with the noise given and unknown."""
    result: dict[str, Any] = {}
    for label in ("known", "unknown"):
        those = [r[label] for r in runs if "spoilt" in r[label]]
        table = np.array([[r["spoilt"], r["fewest"], r["clean"]] for r in those])
        ratio = np.sqrt(table[:, 0] / table[:, 2])
        over_fewest = np.sqrt(table[:, 0] / table[:, 1])
        result[label] = {
            "rms_ratio": float(np.sqrt(table[:, 0].mean() / table[:, 2].mean())),
            "rms_ratio_fewest": float(np.sqrt(table[:, 1].mean() / table[:, 2].mean())),
            "median": float(np.median(ratio)),
            "p95": float(np.quantile(ratio, 0.95)),
            "largest": float(ratio.max()),
            "largest_over_fewest": float(over_fewest.max()),
            "above_1.2": float(np.mean(ratio > 1.2)),
            "bad": sum(r["bad"] for r in those),
            "missed": sum(r["missed"] for r in those),
            "false_alarms": sum(r["false_alarms"] for r in those),
            "refused": len(runs) - len(those),
        }
    return result


def noise(case: Case, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Found over simulated."""
    simulated = {"measurement": SIGMA, "repeatability": SIGMA, "point": case.white, "turning": case.turning}
    result: dict[str, Any] = {"found": float(np.mean([r["found"] for r in runs]))}
    result["scaled"] = float(np.mean([r["scaled"] for r in runs]))
    for name, truth in simulated.items():
        values = np.array([r[name] for r in runs])
        squares = values[np.isfinite(values)] ** 2
        if truth and len(squares):
            error = 0.5 * squares.std() / max(squares.mean(), 1e-300) / np.sqrt(len(squares))
            result[name] = {"ratio": float(np.sqrt(squares.mean()) / truth), "standard_error": float(error)}
    return result


Study = tuple[dict[str, Case], Callable[[Case, int], dict[str, Any]], Callable[..., dict[str, Any]]]
STUDIES: dict[str, Study] = {
    "coverage": (COVERAGE, one_interval, coverage),
    "outliers": (OUTLIERS, one_spoilt, outliers),
    "breakdown": (BREAKDOWN, one_spoilt, outliers),
    "noise": (NOISE, one_noise, noise),
}


def study(section: str, seeds: int, pool: Executor) -> Iterator[tuple[str, dict[str, Any]]]:
    """Each case of a section with its figures."""
    cases, one, summary = STUDIES[section]
    seeds = max(1, round(SECTIONS[section] * seeds))
    for name, case in cases.items():
        began = time.perf_counter()
        runs = list(pool.map(partial(one, case), range(seeds), chunksize=5))
        yield name, summary(case, runs) | {"seeds": seeds, "seconds": time.perf_counter() - began}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--sections", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--seeds", type=int, default=500)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    result: dict[str, Any] = {}
    with ProcessPoolExecutor(args.workers) as pool:
        for section in args.sections:
            result[section] = {}
            for name, figures in study(section, args.seeds, pool):
                result[section][name] = figures
                print(f"{section:10s} {name:40s} {json.dumps(figures)}", file=sys.stderr, flush=True)
    text = json.dumps(result, indent=1)
    if args.json:
        args.json.write_text(text + "\n")
    else:
        print(text)


if __name__ == "__main__":
    main()
