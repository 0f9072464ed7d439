# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The command lines of the golden files, as users type them, and the files that they read.

A case runs in an empty folder of its own. There it finds the files that its words name: those of ``TEXTS``,
those that a command of ``MADE`` writes, and the folders ``config`` (of this repository) and ``real`` (measured
data of real robots, ``../shared/data`` beside the repository; without it the cases that need it are skipped).
"""

from __future__ import annotations

import random
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config"
REAL = ROOT.parent / "shared" / "data"


@dataclass(frozen=True)
class Case:
    """One command line.

    Attributes:
        name: Of the expected file.
        line: The words after ``calib-planner``, quoted as in a shell; ``--json`` is added unless ``tables``.
        writes: The files it leaves, relative to its folder.
        tables: The answer is the tables for people, of which the numbers count.
        heavy: Seconds of work for what tests of its room prove, too: compared by ``make prove``.
    """

    name: str
    line: str
    writes: tuple[str, ...] = ()
    tables: bool = False
    heavy: bool = False

    @property
    def words(self) -> list[str]:
        """The command line, one word an item."""
        return [*shlex.split(self.line), *(() if self.tables else ("--json",))]

    @property
    def real(self) -> bool:
        """Whether it needs measured data of real robots."""
        return any(needs_real(word) for word in self.words)

    @property
    def searched(self) -> bool:
        """Whether the answer follows from a search for plans."""
        words = self.words
        return words[0] in SEARCHING or any(MADE.get(word, "").startswith("plan ") for word in words)


# ── files that cases read ────────────────────────────────────────────────────────────────────────────

ARM = """<?xml version="1.0"?>
<!-- An arm of six joints with a wrist; the comment and the colours have to survive. -->
<robot name="golden_arm">
  <link name="base"/><link name="l1"/><link name="l2"/><link name="l3"/><link name="l4"/><link name="l5"/>
  <link name="flange"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>
  <joint name="j1" type="revolute"><origin xyz="0 0 0.35"/><parent link="base"/><child link="l1"/>
    <axis xyz="0 0 1"/><limit lower="-2.8" upper="2.8" effort="0" velocity="2.0"/></joint>
  <joint name="j2" type="revolute"><origin xyz="0.05 0 0" rpy="0 0.1 0"/><parent link="l1"/><child link="l2"/>
    <axis xyz="0 1 0"/><limit lower="-1.6" upper="1.9" effort="0" velocity="2.0"/></joint>
  <joint name="j3" type="revolute"><origin xyz="0 0 0.6"/><parent link="l2"/><child link="l3"/>
    <axis xyz="0 1 0"/><limit lower="-1.9" upper="1.2" effort="0" velocity="2.5"/></joint>
  <joint name="j4" type="revolute"><origin xyz="0.15 0 0.1"/><parent link="l3"/><child link="l4"/>
    <axis xyz="1 0 0"/><limit lower="-2.7" upper="2.7" effort="0" velocity="3.0"/></joint>
  <joint name="j5" type="revolute"><origin xyz="0.5 0 0"/><parent link="l4"/><child link="l5"/>
    <axis xyz="0 1 0"/><limit lower="-2.0" upper="2.0" effort="0" velocity="3.0"/></joint>
  <joint name="j6" type="revolute"><origin xyz="0.08 0 0" rpy="0.2 0 0"/><parent link="l5"/><child link="flange"/>
    <axis xyz="1 0 0"/><limit lower="-4.0" upper="4.0" effort="0" velocity="4.0"/></joint>
</robot>
"""

CONSTRAINTS = """workspace:
  low: [0.3, -2.0, 0.3]
  high: [3.0, 2.0, 2.5]
minimum_height: {height: 0.2, up: [0, 0, 1], links: false}
tracker:
  station: [4.0, 1.5, 1.2]
  up: [0, 0, 1]
  range: [1.0, 20.0]
  elevation_deg: [-50, 75]
"""

PRIOR = """source: last year
parameters:
  d1: {deviation: 0.3, std: 0.4, unit: mm}
  q2: {std: 0.05, unit: deg}
  q3: 1.0e-3
"""

STD = """d1: 5.0e-4
q2: 1.0e-3
"""


def table(names: str, low: float, high: float, rows: int, seed: int) -> str:
    """A CSV of ``rows`` configurations drawn between ``low`` and ``high``; ``names`` with spaces between."""
    draw, columns = random.Random(seed), names.split()
    lines = [",".join(f"{draw.uniform(low, high):.6f}" for _ in columns) for _ in range(rows)]
    return "\n".join([",".join(columns), *lines, ""])


KUKA = " ".join(f"joint_a{i}" for i in range(1, 7))
JOINTS = " ".join(f"j{i}" for i in range(1, 7))

TEXTS: Mapping[str, str] = {
    "arm.urdf": ARM,
    "limits.yaml": CONSTRAINTS,
    "known.yaml": PRIOR,
    "std.yaml": STD,
    "planar.csv": table("q1 q2", -1.5, 1.5, 10, 1),
    "planar_deg.csv": table("q1 q2", -80, 80, 6, 2),
    "kuka.csv": table(KUKA, -1.0, 0.0, 14, 3),
    "kuka_few.csv": table(KUKA, -1.0, 0.0, 4, 4),
    "kuka_pool.csv": table(KUKA, -1.2, 0.0, 40, 5),
    "kuka_path.csv": table(KUKA, -0.9, -0.3, 3, 6),
    "arm.csv": table(JOINTS, -1.1, 1.1, 24, 7),
    "arm_new.csv": table(JOINTS, -1.0, 1.0, 6, 8),
    "arm_pool.csv": table(JOINTS, -1.1, 1.1, 40, 9),
}

POSE = '--degrees --test-pose "0 -60 90 0 45 0"'
RADIANS = '--test-pose "0 -1.05 1.57 0 0.79 0"'
ARM_POSE = '--test-pose "0.2 0.3 -0.4 0.1 0.5 0"'
ARM_TARGETS = '--targets "0.05 0.02 0.04" --targets "0.03 -0.05 0"'
ARM = f"--robot arm.urdf {ARM_TARGETS} --parameters full"
EXACT = "--error-model paper --length-error 1e-3"
"""A robot that errs by its parameters alone, in its lengths by 1 mm."""

MADE: Mapping[str, str] = {
    "kuka_plan.yaml": f"plan --robot kuka_kr270 {POSE} --configurations 4 --repetitions 2 --starts 4",
    "arm_plan.yaml": f"plan --robot arm.urdf --parameters offsets {ARM_POSE} --configurations 4 --starts 2",
    "planar_points.csv": f"simulate --robot planar_2r --plan planar.csv --seed 1 {EXACT}",
    "kuka_points.csv": f"simulate --robot kuka_kr270 --plan kuka.csv --seed 2 {EXACT}",
    "kuka_new.csv": f"simulate --robot kuka_kr270 --plan kuka_few.csv --seed 2 {EXACT}",
    "kuka_again.csv": f"simulate --robot kuka_kr270 --plan kuka.csv --repetitions 2 --seed 3 {EXACT}",
    "arm_points.csv": f"simulate {ARM} --plan arm.csv --seed 4 {EXACT}",
    "arm_held_out.csv": f"simulate {ARM} --plan arm_new.csv --seed 4 {EXACT}",
    "kuka_estimate.yaml": "identify --robot kuka_kr270 --data kuka_points.csv",
    "arm_estimate.yaml": "identify --robot arm.urdf --parameters full --unknown base,tool --prior typical "
    "--data arm_points.csv",
}
"""File → the command that writes it with ``--output``."""


def shifted(text: str) -> str:
    """Measurements with one point 5 mm off and one empty, and all in millimetres."""
    head, *rows = text.splitlines()
    columns = head.split(",")
    x, y, z = (columns.index(name) for name in ("x1", "y1", "z1"))
    cells = [row.split(",") for row in rows]
    cells[3][y] = repr(float(cells[3][y]) + 5e-3)
    for row in cells:
        for k in (x, y, z):
            row[k] = repr(1e3 * float(row[k]))
    cells[5][x] = cells[5][y] = cells[5][z] = ""
    return "\n".join([head, *(",".join(row) for row in cells), ""])


def head(rows: int) -> Callable[[str], str]:
    """The header and the first ``rows`` rows of a CSV."""
    return lambda text: "\n".join([*text.splitlines()[: rows + 1], ""])


DERIVED: Mapping[str, tuple[str, Callable[[str], str]]] = {
    "kuka_spoilt_mm.csv": ("kuka_again.csv", shifted),
    "irb120.csv": ("real/irb120_tracker/calibration.csv", head(14)),
    "irb120_new.csv": ("real/irb120_tracker/test_1.csv", head(10)),
    "ur10.csv": ("real/ur10_tracker/random_poses.csv", head(30)),
    "ur10_pool.csv": ("real/ur10_tracker/random_poses.csv", head(60)),
}
"""File → the file it is made from, and how."""


def needs_real(word: str) -> bool:
    """Whether a word of a command line names measured data of a real robot, or a file made from it."""
    return word.startswith("real/") or (word in DERIVED and needs_real(DERIVED[word][0]))


# ── the command lines ────────────────────────────────────────────────────────────────────────────────

CRITERIA = ("test_pose", "worst_pose", "d", "d_star", "a", "e", "o1", "o2", "o3", "o4", "o5")
SAMPLE = ("worst_pose", "d", "e", "o3")
"""Criteria of which ``make test`` compares the plans, one of every kind of search; others have ``test_pose``."""
COMMANDS = (
    "init",
    "import",
    "plan",
    "sheet",
    "program",
    "campaign",
    "compare",
    "identify",
    "compensate",
    "export",
    "simulate",
    "robots",
    "completion",
    "demo",
    "reproduce",
)
SEARCHING = ("plan", "campaign", "compare", "demo", "reproduce")
IRB = "--robot real/irb120_tracker/irb120.urdf"
UR10 = "--robot real/ur10_tracker/ur10.urdf"
SHEET = ("plan_sheet.html", "plan_sheet.csv", "plan_sheet.yaml", "trajectory.yaml")


def _plans() -> list[Case]:
    kuka = f"plan --robot kuka_kr270 {POSE}"
    radians = f"plan --robot kuka_kr270 {RADIANS}"
    few = "plan --robot kuka_kr270 --parameters offsets --configurations 3 --starts 3"
    small = f"{few} --degrees"
    two = '--test-pose "0 -60 90 0 45 0" --test-pose "30 -40 60 10 -45 0"'
    arm = f"plan --robot arm.urdf {ARM_POSE}"
    planar = 'plan --robot planar_2r --test-pose "0.3 0.8"'
    return [
        *(Case(f"plan_criterion_{c}", f"{small} {two} --criterion {c}", heavy=c not in SAMPLE) for c in CRITERIA),
        Case("plan", f"{kuka} --configurations 4 --repetitions 3 --starts 6 --output p.yaml", ("p.yaml",)),
        Case("plan_tables", f"{kuka} --configurations 4 --starts 2", tables=True),
        Case(
            "plan_csv_and_sheet",
            f"{kuka} --configurations 4 --starts 2 --seed 5 --output p.csv --sheet s",
            ("p.csv", *(f"s/{name}" for name in SHEET)),
        ),
        Case("plan_compound", f"{small} {two} --compound d=0.3 --compound e=0.2"),
        Case("plan_path", f"{few} --test-path kuka_path.csv --weights '1 2 3'"),
        Case("plan_base_and_tool", f"{kuka} --unknown base,tool --configurations 7 --starts 2"),
        Case("plan_candidates", f"{radians} --configurations 5 --candidates kuka_pool.csv"),
        Case(
            "plan_repeat_candidates",
            f"{planar} --configurations 4 --candidates planar.csv --repeat-candidates --criterion d",
        ),
        Case("plan_discrepancy", f"{arm} --parameters offsets --configurations 6 --candidates arm_pool.csv"),
        Case(
            "plan_no_discrepancy",
            f"{arm} --parameters offsets --configurations 6 --candidates arm_pool.csv --discrepancy off",
        ),
        Case("plan_measured", f"{planar} --configurations 2 --starts 4 --measured planar_points.csv"),
        Case("plan_constraints", f"{kuka} --configurations 4 --starts 2 --constraints limits.yaml"),
        Case(
            "plan_instrument",
            f"{kuka} --configurations 4 --starts 2 --instrument config/instruments/laser_tracker.yaml",
            heavy=True,
        ),
        Case("plan_isotropic", f"{planar} --configurations 3 --instrument config/instruments/isotropic.yaml"),
        Case("plan_prior", f"{kuka} --configurations 3 --starts 3 --prior std.yaml"),
        Case("plan_prior_typical", f"{arm} --parameters full --prior typical --configurations 6 --starts 1"),
        Case("plan_prove", f"{planar} --configurations 3 --starts 8 --prove"),
        Case("plan_prove_offsets", f"{planar} --parameters offsets --configurations 2 --repetitions 2 --prove"),
        Case("plan_for_accuracy", f"{planar} --accuracy 3e-5 --starts 4"),
        Case("plan_for_accuracy_in_time", f"{planar} --accuracy 2e-5 --starts 4 --speed 0.1"),
        Case("plan_for_time", f"{planar} --time-budget 4min --starts 4 --speed 0.1"),
        Case("plan_of_measurements", f"{planar} --measurements 8 --starts 4"),
        Case("plan_of_the_paper", f"{small} {two} --general-weight 0 --sigma 1e-4"),
        Case("plan_configuration_sigma", f"{planar} --measurements 6 --starts 4 --configuration-sigma 2e-5"),
        Case("plan_named", f"{kuka} --parameters d1,q2,q3 --configurations 2 --starts 4"),
        Case("plan_lengths", f"{kuka} --parameters lengths --configurations 2 --starts 4"),
        Case("plan_ur10e", "plan --robot ur10e --test-pose '0 -1 1.2 0 1 0' --configurations 5 --starts 2"),
        Case(
            "plan_urdf",
            "plan --robot arm.urdf --parameters full --base-link l1 --tip-link l5 --targets '0.1 0 0.05' "
            "--test-pose '0.3 -0.4 0.1 0.5' --configurations 12 --starts 1",
        ),
        Case(
            "plan_real_pool",
            f"plan {UR10} --parameters full --unknown base,tool --test-pose '0 -1 1 -1 1 0' --prior typical "
            "--configurations 12 --candidates ur10_pool.csv",
        ),
    ]


def _identifications() -> list[Case]:
    kuka = "identify --robot kuka_kr270 --data kuka_points.csv"
    planar = "identify --robot planar_2r --data planar_points.csv"
    again = "identify --robot kuka_kr270 --data kuka_again.csv"
    arm = "identify --robot arm.urdf --parameters full --unknown base,tool --data arm_points.csv"
    irb = f"identify {IRB} --parameters full --unknown base,tool --prior typical --data irb120.csv"
    ur10 = f"identify {UR10} --parameters full --unknown base,tool --prior typical --data ur10.csv"
    files = "--output e.yaml --report r.html --urdf-output c.urdf --kinematics-output k.yaml"
    return [
        Case("identify", f"{planar} --output e.yaml", ("e.yaml",)),
        Case("identify_offsets", f"{planar} --parameters offsets --sigma 3e-5"),
        Case("identify_lengths", f"{kuka} --parameters lengths"),
        Case("identify_named", f"{kuka} --parameters d1,q2,q3 --error-model paper"),
        Case("identify_repetitions", f"{again}"),
        Case("identify_instrument", f"{kuka} --instrument config/instruments/laser_tracker.yaml"),
        Case("identify_validate", f"{kuka} --validate kuka_new.csv --required-accuracy 5e-5"),
        Case("identify_test_pose", f"{kuka} --test-pose '0 -1 1.5 0 0.8 0' --test-pose '0.3 -1 1 0 0.5 0'"),
        Case("identify_prior", f"{kuka} --prior known.yaml"),
        Case("identify_from_estimate", f"{kuka} --prior kuka_estimate.yaml --data kuka_new.csv"),
        Case(
            "identify_robust",
            "identify --robot kuka_kr270 --data kuka_spoilt_mm.csv --millimetres --loss robust --sigma 3e-5",
        ),
        Case("identify_linear_spoilt", "identify --robot kuka_kr270 --data kuka_spoilt_mm.csv --millimetres"),
        Case("identify_urdf", f"{arm} --prior typical {files}", ("e.yaml", "r.html", "c.urdf", "k.yaml")),
        Case("identify_error_model", f"{arm} --error-model typical --validate arm_held_out.csv"),
        Case(
            "identify_error_model_paper",
            f"{kuka} --error-model paper --accuracy-frame robot --test-pose '0 -1 1.5 0 0.8 0' "
            "--test-pose '0.3 -1 1 0 0.5 0' --test-pose '-0.4 -0.8 1.2 0.3 0.6 0'"
            " --test-pose '0.1 -1.3 0.9 1 0.7 0'",
        ),
        Case("identify_rank", f"{arm} --sigma 3e-5"),
        Case(
            "identify_with_tool",
            f"{arm} --prior arm_estimate.yaml --prior-includes tool --validate arm_held_out.csv",
        ),
        Case(
            "identify_target_from", f"{arm} --prior typical --validate arm_held_out.csv --validate-target-from 2"
        ),
        Case("identify_real", f"{irb} --loss robust --output e.yaml", ("e.yaml",)),
        Case(
            "identify_real_held_out",
            f"identify {IRB} --parameters offsets --unknown base,tool --data irb120.csv "
            "--validate irb120_new.csv --validate-target-from 1",
        ),
        Case("identify_real_stds", f"{ur10}"),
    ]


def _others() -> list[Case]:
    kuka = f"--robot kuka_kr270 {POSE}"
    campaign = f"campaign {kuka} --required-accuracy 50e-6 --starts 3"
    by_hand = f"campaign --robot kuka_kr270 {RADIANS} --required-accuracy 50e-6 --starts 3"
    easy = by_hand.replace("50e-6", "2e-4")
    compensate = "compensate --robot arm.urdf --estimate arm_estimate.yaml --targets arm_new.csv"
    return [
        Case("compare", f"compare {kuka} --configurations 3 4 --replicate 3x2 --random 100 --starts 2"),
        Case(
            "compare_tables",
            'compare --robot planar_2r --test-pose "0.3 0.8" --random 50 --starts 2 --configurations 3',
            tables=True,
        ),
        Case("simulate", "simulate --robot kuka_kr270 --plan kuka_plan.yaml --seed 7 --output m.csv", ("m.csv",)),
        Case("simulate_repeated", "simulate --robot kuka_kr270 --plan kuka_few.csv --repetitions 2 --seed 8"),
        Case("simulate_paper", "simulate --robot kuka_kr270 --plan kuka_few.csv --error-model paper --seed 8"),
        Case(
            "simulate_true",
            "simulate --robot planar_2r --plan planar_deg.csv --degrees --true l1=1e-3 --true dq2=-2e-3 "
            "--sigma 0 --error-model paper",
        ),
        Case(
            "simulate_urdf",
            f"simulate --robot arm.urdf {ARM_TARGETS} --parameters full --unknown base,tool --plan arm_new.csv "
            "--length-error 5e-4 --angle-error 2e-3 --sigma 1e-5",
        ),
        Case(
            "campaign_simulated",
            f"{campaign} --simulate 1 --budget 20 --output c",
            ("c/measurements.csv", "c/validation.csv", "c/estimate.yaml"),
            heavy=True,
        ),
        Case(
            "campaign_typical", f"{campaign} --simulate 1 --simulate-error-model typical --budget 12 --minimum 5"
        ),
        Case(
            "campaign_transmission",
            f"{campaign} --simulate 2 --budget 16 --batch 5 --validation 4 "
            "--simulate-transmission 1e-4 --simulate-sigma 2e-5 --minimum 5",
            heavy=True,
        ),
        Case("campaign_first", f"{campaign} --next n.csv", ("n.csv",)),
        Case("campaign_goes_on", f"{by_hand} --measured kuka_new.csv --next n.csv", ("n.csv",)),
        Case("campaign_ends", f"{easy} --measured kuka_points.csv --held-out kuka_new.csv --validation 4"),
        Case("compensate", f"{compensate} --output o.csv", ("o.csv",)),
        Case(
            "export",
            "export arm_estimate.yaml --urdf c.urdf --kinematics k.yaml --targets arm_new.csv o.csv",
            ("c.urdf", "k.yaml", "o.csv"),
        ),
        Case("compensate_position", f"{compensate} --position-only --tool '0.1 0 0' --ignore-limits"),
        Case(
            "compensate_kuka",
            "compensate --robot kuka_kr270 --estimate kuka_estimate.yaml --targets kuka_few.csv --geometry-only",
        ),
        Case(
            "sheet",
            "sheet --plan kuka_plan.yaml --constraints limits.yaml --output s",
            tuple(f"s/{name}" for name in SHEET),
        ),
        Case(
            "sheet_urdf",
            "sheet --plan arm_plan.yaml --robot arm.urdf --start '0 0 0 0 0 0' --speed-share 0.5 --dwell 2 "
            "--instrument config/instruments/laser_tracker.yaml",
        ),
        Case(
            "init",
            "init --robot kuka_kr270 --data kuka_points.csv --sigma 20um --mounting ceiling",
            ("cell.yaml",),
        ),
        Case("program", "program kuka_plan.yaml --for fanuc --name Visits --signs '-1 1 1 1 1 -1' --output p.ls"),
        Case("robots", "robots list"),
        *(Case(f"robots_{r}", f"robots show {r}") for r in ("planar_2r", "kuka_kr270", "ur10e", "arm.urdf")),
        Case(
            "demo",
            "demo --configurations 15 --output d",
            tuple(
                f"d/{n}"
                for n in (
                    "plan.yaml",
                    "measurements.csv",
                    "estimate.yaml",
                    "demo.json",
                    "calibration.html",
                    "demo.png",
                )
            ),
            heavy=True,
        ),
        Case(
            "reproduce",
            "reproduce --random 100 --calibrations 10 --output r",
            ("r/tables.json", "r/index.html", "r/figure_2.svg", "r/figure_5.png"),
            heavy=True,
        ),
    ]


def _refusals() -> list[Case]:
    return [
        Case("refused_unknown_robot", "robots show kuka"),
        Case("refused_no_pose", "plan --robot planar_2r --configurations 3"),
        Case("refused_too_few", f"plan --robot kuka_kr270 {POSE} --configurations 1 --unknown base,tool"),
        Case("refused_no_file", "identify --robot planar_2r --data absent.csv"),
        Case("refused_option", "identify --robot planar_2r --data planar_points.csv --loss quadratic"),
        Case("refused_short_of_data", "identify --robot arm.urdf --parameters full --data arm.csv"),
    ]


def _helps() -> list[Case]:
    lines = ["", *COMMANDS, "robots list", "robots show"]
    return [Case(f"help_{line.replace(' ', '_') or 'top'}", f"{line} --help", tables=True) for line in lines]


CASES: tuple[Case, ...] = (*_plans(), *_identifications(), *_others(), *_refusals(), *_helps())
