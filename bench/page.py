# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Write docs/benchmarks.md and its pictures from the benches' results.

    python bench/page.py [--results results] [--run] [--figaroh PYTHON]

``--run`` runs the benches first, one after the other (minutes; the machine should have nothing else to do). Each
bench writes ``results/NAME.json``; a table whose file is not there is left out, and the page says so. Every ratio
is of two sides that took turns in one run on one machine; no figure is copied by hand.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs" / "pictures"
OURS, THEIRS = "#1b6ca8", "#b0b7bf"
"""Colours of this library and of what stands beside it."""

BENCHES: dict[str, tuple[str, ...]] = {
    "kinematics": (),
    "identification": ("--sections", "figaroh", "--cells", "3"),
    "least_squares": ("--seeds", "5", "--simulated", "5"),
    "candidates": ("--sizes", "500", "2000"),
    "planning": ("--poses", "20"),
    "real_robot": ("--seeds", "6", "--random", "100"),
    "half_and_double": ("--seeds", "3", "--random", "30"),
    "error_model": ("--seeds", "5", "--simulated", "0"),
}
"""Bench → options of the run for the page."""


@dataclass(frozen=True)
class Part:
    """A part of the page.

    Attributes:
        bench: Its results, ``results/BENCH.json``.
        title: Its heading.
        text: What is compared, and how.
        table: Makes the table's heading and rows from the results.
        picture: Draws into axes; ``None`` for a part without one.
    """

    bench: str
    title: str
    text: str
    table: Callable[[Any], tuple[list[str], list[list[str]]]]
    picture: Callable[[Any, Any], None]


# ── tables and pictures ──────────────────────────────────────────────────────────────────────────────


def kinematics_table(rows: Any) -> tuple[list[str], list[list[str]]]:
    head = ["configurations at a time", "calib_planner, ns each", "Pinocchio, ns each", "ratio"]
    return head, [
        [f"{r['batch']:,}", f"{r['ours_ns']:.0f}", f"{r['pinocchio_ns']:.0f}", f"{r['ratio']:.0f} ×"]
        for r in rows
    ]


def kinematics_picture(rows: Any, axes: Any) -> None:
    paired(
        axes,
        [f"{r['batch']:,}" for r in rows],
        {"calib_planner": [r["ours_ns"] for r in rows], "Pinocchio": [r["pinocchio_ns"] for r in rows]},
        "ns per configuration",
        bars=False,
    )
    axes.set_yscale("log")
    axes.set_ylim(10.0, 10_000.0)


def figaroh_table(result: Any) -> tuple[list[str], list[list[str]]]:
    head = ["way", "processor seconds", "parameters", "held-out error, µm", "time over ours"]
    rows = []
    for side, r in result["figaroh"]["medians"].items():
        name = f"calib_planner ({side})" if side.startswith("ours") else f"FIGAROH, {side}"
        ratio = "" if side.startswith("ours") else f"{r['ratio_cpu']:.1f} ×"
        rows.append(
            [name, f"{r['cpu_seconds']:.3f}", f"{r['parameters']:.0f}", f"{1e6 * r['error_m']:.1f}", ratio]
        )
    return head, rows


def figaroh_picture(result: Any, axes: Any) -> None:
    medians = result["figaroh"]["medians"]
    names = [n if n.startswith("ours") else f"FIGAROH {n}" for n in medians]
    values = [1e6 * r["error_m"] for r in medians.values()]
    for at, (name, value) in enumerate(zip(names, values, strict=True)):
        axes.plot(value, at, "o", color=OURS if name.startswith("ours") else THEIRS, markersize=9)
    axes.set_yticks(range(len(names)), names)
    axes.grid(axis="y", alpha=0.3)
    axes.invert_yaxis()
    axes.set_xlabel("held-out error, µm")
    axes.set_xscale("log")
    axes.set_xlim(5.0, 500.0)


def scipy_table(result: Any) -> tuple[list[str], list[list[str]]]:
    names = {"irb120": "IRB 120, measured", "ur10": "UR10, measured", "ur10e": "UR10e, simulated"}
    head = [
        "robot",
        "splits",
        "calib_planner, mm",
        "plain least squares, mm",
        "error, ratio",
        "processor seconds",
    ]
    rows = []
    for case, a, b in _cases(result):
        ratio = median(y["mean_mm"] / x["mean_mm"] for x, y in zip(a, b, strict=True))
        seconds = [median(r["seconds"] for r in side) for side in (a, b)]
        errors = [f"{median(r['mean_mm'] for r in side):.3f}" for side in (a, b)]
        rows.append([names[case], str(len(a)), *errors, f"{ratio:.1f} ×", f"{seconds[0]:.2f} / {seconds[1]:.2f}"])
    return head, rows


def scipy_picture(result: Any, axes: Any) -> None:
    cases = _cases(result)
    plain = "plain least squares"
    sides = {
        name: [median(r["mean_mm"] for r in case[k]) for case in cases]
        for k, name in ((1, "calib_planner"), (2, plain))
    }
    paired(axes, [c[0] for c in cases], sides, "held-out error, mm")


def _cases(result: Any) -> list[tuple[str, list[Any], list[Any]]]:
    rows = result["least_squares"]
    return [
        (case, *([r for r in rows if (r["case"], r["way"]) == (case, way)] for way in ("identify", "scipy")))
        for case in dict.fromkeys(r["case"] for r in rows)
    ]


def pools_table(result: Any) -> tuple[list[str], list[list[str]]]:
    head = ["candidates", "chosen", "calib_planner, s", "proved D-efficiency", "FIGAROH, s", "D, ours / FIGAROH"]
    rows = []
    for pool in result["pools"]:
        for e in pool["choices"]:
            theirs = ["no answer", ""]
            if "d_ratio" in e:
                theirs = [f"{pool['figaroh_seconds']:.1f}", f"{e['d_ratio']:.3f}"]
            rows.append(
                [str(pool["candidates"]), str(e["n"]), f"{e['seconds']:.3f}", f"{e['efficiency']:.3f}", *theirs]
            )
    return head, rows


def pools_picture(result: Any, axes: Any) -> None:
    pools = [p for p in result["pools"] if p["figaroh_seconds"]] or result["pools"]
    sides = {"calib_planner": [median(e["seconds"] for e in p["choices"]) for p in pools]}
    if pools[0]["figaroh_seconds"]:
        sides["FIGAROH"] = [p["figaroh_seconds"] for p in pools]
    paired(axes, [f"{p['candidates']} candidates" for p in pools], sides, "seconds", bars=False)
    axes.set_yscale("log")
    axes.set_ylim(0.1, 1000.0)


def planning_table(result: Any) -> tuple[list[str], list[list[str]]]:
    head = ["configurations", "test poses", "median efficiency", "worst", "seconds, median"]
    rows = []
    for r in result["efficiency"]:
        figures = [f"{r['median']:.4f}", f"{r['worst']:.4f}", f"{r['seconds_median']:.2f}"]
        rows.append([str(r["configurations"]), str(r["poses"]), *figures])
    return head, rows


def planning_picture(result: Any, axes: Any) -> None:
    rows = result["efficiency"]
    sides = {"median": [r["median"] for r in rows], "worst": [r["worst"] for r in rows]}
    paired(axes, [f"{r['configurations']}" for r in rows], sides, "share of the proved bound", bars=False)
    axes.set_ylim(0.95, 1.0)
    axes.set_xlabel("configurations")


def measured_table(result: Any) -> tuple[list[str], list[list[str]]]:
    head = [
        "measured",
        "planned, mean mm",
        "random, mean mm",
        "beats by mean",
        "beats by 95th percentile",
        "worst draw",
    ]
    rows = []
    for n, part in _counts(result["real_robot"]):
        of = {k: [r[k] for r in part] for k in part[0] if isinstance(part[0][k], float)}
        beats = [f"{median(of[k]):.0f} %" for k in ("beats_mean", "beats_p95")]
        worst = min(of["beats_mean"] + of["beats_p95"])
        rows.append(
            [
                str(n),
                f"{median(of['mean_mm']):.3f}",
                f"{median(of['random_mean_mm']):.3f}",
                *beats,
                f"{worst:.0f} %",
            ]
        )
    return head, rows


def measured_picture(result: Any, axes: Any) -> None:
    parts = _counts(result["real_robot"])
    sides = {
        "planned": [median(r["mean_mm"] for r in p) for _, p in parts],
        "random": [median(r["random_mean_mm"] for r in p) for _, p in parts],
    }
    paired(axes, [str(n) for n, _ in parts], sides, "held-out error, mm")
    axes.set_xlabel("configurations measured")


def _counts(rows: list[Any]) -> list[tuple[int, list[Any]]]:
    return [(n, [r for r in rows if r["n"] == n]) for n in dict.fromkeys(r["n"] for r in rows)]


def sizes_table(result: Any) -> tuple[list[str], list[list[str]]]:
    head = ["true size", "measured", "planned, mean mm", "random, mean mm", "beats by mean", "worst robot"]
    rows = []
    entries = result["half_and_double"]
    for size, n in dict.fromkeys((r["size"], r["n"]) for r in entries):
        part = [r for r in entries if (r["size"], r["n"]) == (size, n)]
        of = {k: [r[k] for r in part] for k in ("mean_mm", "random_mean_mm", "beats_mean", "beats_p95")}
        errors = [f"{median(of[k]):.3f}" for k in ("mean_mm", "random_mean_mm")]
        worst = min(of["beats_mean"] + of["beats_p95"])
        rows.append([f"{size:g} ×", str(n), *errors, f"{median(of['beats_mean']):.0f} %", f"{worst:.0f} %"])
    return head, rows


def sizes_picture(result: Any, axes: Any) -> None:
    rows = result["half_and_double"]
    for size, mark in zip(dict.fromkeys(r["size"] for r in rows), "osD", strict=False):
        part = _counts([r for r in rows if r["size"] == size])
        axes.plot(
            [n for n, _ in part], [median(r["mean_mm"] / r["random_mean_mm"] for r in p) for _, p in part],
            mark + "-", label=f"{size:g} × the size planned with",
        )  # fmt: skip
    axes.axhline(1.0, color=THEIRS)
    axes.set_xlabel("configurations measured")
    axes.set_ylabel("error, planned / random")
    axes.set_ylim(0, 1.1)
    axes.set_xticks([n for n, _ in part])
    axes.legend(frameon=False)


def model_table(result: Any) -> tuple[list[str], list[list[str]]]:
    head = [
        "robot and rows",
        "splits",
        "mean error, mm",
        "predicted / achieved rms",
        "left-out rms, mm",
        "inside 95 %",
    ]
    rows = []
    for case, part in _models(result):
        figures = {k: median(r[k] for r in part) for k in ("mean_mm", "predicted", "left_out_mm", "inside")}
        row = [f"{figures['mean_mm']:.3f}", f"{figures['predicted']:.2f}", f"{figures['left_out_mm']:.3f}"]
        rows.append([case, str(len(part)), *row, f"{100 * figures['inside']:.1f} %"])
    return head, rows


def model_picture(result: Any, axes: Any) -> None:
    parts = _models(result)
    achieved = [median(r["rms_mm"] for r in p) for _, p in parts]
    predicted = [median(r["rms_mm"] * r["predicted"] for r in p) for _, p in parts]
    names = [c.replace("_", " ").replace(" x ", "×").replace(" ", "\n") for c, _ in parts]
    paired(axes, names, {"achieved": achieved, "predicted": predicted}, "held-out rms, mm")


def _models(result: Any) -> list[tuple[str, list[Any]]]:
    rows = [r for r in result["error_model"] if "mean_mm" in r]
    return [(c, [r for r in rows if r["case"] == c]) for c in dict.fromkeys(r["case"] for r in rows)]


def paired(axes: Any, names: list[str], sides: dict[str, list[float]], label: str, bars: bool = True) -> None:
    """Two sides beside each other: bars, or dots for an axis that does not begin at zero."""
    for k, ((side, values), colour) in enumerate(zip(sides.items(), (OURS, THEIRS), strict=False)):
        at = range(len(names))
        if bars:
            axes.bar([i + 0.4 * k - 0.2 for i in at], values, 0.38, label=side, color=colour)
        else:
            axes.plot(at, values, "o", label=side, color=colour, markersize=9)
    axes.set_xticks(range(len(names)), names)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.set_ylabel(label)
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)


PARTS = (
    Part(
        "kinematics",
        "Positions and Jacobian",
        "Positions of the reflector and the identification Jacobian of the KR-270, beside Pinocchio's "
        "`forwardKinematics` and `computeJointKinematicRegressor`, called from Python for each "
        "configuration.",
        kinematics_table,
        kinematics_picture,
    ),
    Part(
        "planning",
        "Plans and their bound",
        "KR-270, nine parameters, random test poses: the share of the bound that the plan reaches, 1 being "
        "a plan that provably cannot be better. The bound is proved within the time that is shown.",
        planning_table,
        planning_picture,
    ),
    Part(
        "real_robot",
        "Planned and random configurations of a measured UR10",
        "From 600 measured rows, drawn by seed, as many rows are planned as are chosen at random,"
        " 100 times; the default estimator identifies, all other rows of the file judge. Medians over six "
        "draws; the last column is the smaller of both shares in the worst draw.",
        measured_table,
        measured_picture,
    ),
    Part(
        "half_and_double",
        "Robots that err otherwise than planned with",
        "A simulated UR10e whose gravity, joint functions and repeatability are half, as large as, and "
        "double what the plan counts with; 30 random choices for each of three robots.",
        sizes_table,
        sizes_picture,
    ),
    Part(
        "error_model",
        "Predicted and achieved on measured robots",
        "Fitted to the rows named; all others are predicted, with their uncertainty. IRB 120: 36 "
        "configurations of three points, 40 rows of a target that was re-seated. UR10: random rows, all "
        "others held out, a split for each seed.",
        model_table,
        model_picture,
    ),
    Part(
        "least_squares",
        "Identification beside a plain least squares",
        "The same rows for both: `identify` as it comes, and `scipy.optimize.least_squares` for all "
        "placement errors with base and targets free. The error is the mean distance at rows that took no "
        "part; medians over the splits. The last column is ours / theirs: the time buys the error model, "
        "its uncertainty and the verdict.",
        scipy_table,
        scipy_picture,
    ),
    Part(
        "identification",
        "Identification beside FIGAROH",
        "Simulated cells around the UR10 that err in their parameters alone, so that both models can be "
        "right: 100 configurations, three targets, base and targets unknown, the same file to both sides; "
        "medians over three cells. The file of the bench says how FIGAROH 1.0.2 is called in each way.",
        figaroh_table,
        figaroh_picture,
    ),
    Part(
        "candidates",
        "Choosing from candidates, beside FIGAROH",
        "D-optimal choice from measured configurations of the UR10, against FIGAROH's cone program, judged "
        "by D = det^(1/p) of the chosen rows; ours with its bound. FIGAROH may take 16 GiB of memory; where "
        "that is not enough, it has no answer.",
        pools_table,
        pools_picture,
    ),
)

# ── the page ─────────────────────────────────────────────────────────────────────────────────────────


def machine() -> str:
    """What the figures were measured on."""
    names = [
        line.split(":")[1].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if "model name" in line
    ]
    packages = []
    for name in ("numpy", "scipy", "pin"):
        try:
            packages.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    cores = f"{os.cpu_count()} cores of {names[0] if names else platform.machine()}"
    return f"{cores}, Python {platform.python_version()}, {', '.join(packages)}; one thread"


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def page(results: Path) -> str:
    """The text; pictures are written on the way."""
    lines = [
        "# Benchmarks",
        "",
        "This page is written by `make bench`, which runs the files in `bench/` and draws what they measured.",
        "Two sides of a comparison took turns in one run, so that what else the machine did fell on both; read",
        "ratios rather than times. Seeds and splits are in the files: the same run has the same rows.",
        "",
        f"Measured on {datetime.date.today().isoformat()} with {machine()}.",
        "",
    ]
    missing = []
    for part in PARTS:
        path = results / f"{part.bench}.json"
        result = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
        if not result:  # not run, or its data or its peer are not there
            missing.append(f"`bench/{part.bench}.py`")
            continue
        figure, axes = plt.subplots(figsize=(6.4, 2.8), layout="constrained")
        part.picture(result, axes)
        axes.spines[["top", "right"]].set_visible(False)
        name = f"bench_{part.bench}.png"
        figure.savefig(PICTURES / name, dpi=110, metadata={"Software": ""})
        plt.close(figure)
        lines += [f"## {part.title}", "", part.text, "", table(*part.table(result)), ""]
        lines += [f"![{part.title}](pictures/{name})", "", f"From `bench/{part.bench}.py`.", ""]
    if missing:
        lines += [f"Not run for this page: {', '.join(missing)}.", ""]
    return "\n".join(lines)


def run(name: str, options: tuple[str, ...], results: Path, figaroh: str) -> None:
    """One bench into its file."""
    script = ROOT / "bench" / f"{name}.py"
    path, takes = results / f"{name}.json", script.read_text(encoding="utf-8")
    options = (*options, *(("--figaroh", figaroh) if figaroh and '"--figaroh"' in takes else ()))
    print(f"== {name}", file=sys.stderr)
    if '"--json"' in takes:
        subprocess.run([sys.executable, str(script), *options, "--json", str(path)], check=True)
        return
    done = subprocess.run([sys.executable, str(script), *options], check=True, stdout=subprocess.PIPE)
    path.write_bytes(done.stdout)


def main() -> None:
    """Run what is asked for and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--results", type=Path, default=ROOT / "results")
    parser.add_argument("--run", nargs="*", metavar="BENCH", help="run these benches first; without names all")
    default = os.environ.get("FIGAROH_PYTHON", "")
    parser.add_argument("--figaroh", default=default, help="an interpreter with FIGAROH")
    args = parser.parse_args()
    args.results.mkdir(exist_ok=True)
    if args.run is not None:
        for name in args.run or BENCHES:
            run(name, BENCHES[name], args.results, args.figaroh)
    (ROOT / "docs" / "benchmarks.md").write_text(page(args.results), encoding="utf-8")


if __name__ == "__main__":
    main()
