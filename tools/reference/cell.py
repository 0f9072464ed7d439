# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/reference/cell.md: the keys of ``cell.yaml``, from the table that reads them."""

from __future__ import annotations

from markdown import MADE, code, escaped, joined, table

from calib_planner.io import CELL_KEYS, EITHER, ROS_KEYS

INTRODUCTION = """\
`calib-planner init` asks what a cell has and writes `cell.yaml`; every command takes it with `--cell cell.yaml`,
and the nodes with `ros2 launch calib_planner campaign.launch.py cell:=cell.yaml`.
Its keys are the names of the options, and options that are given beside it win. Paths are from the folder of the
file. A length may carry its unit (`20um`, `0.02mm`). Every key may be left out; one that is not in this table is
refused."""

EXAMPLE = """\
robot: irb120.urdf
targets: [[60mm, 20mm, 90mm]]
unknown: base,tool
payload: [3.2, 0, 0, 0.05]
sigma: 20um
constraints: constraints.yaml"""

PYTHON = """\
`calib_planner.io.read_cell` gives the same as a frozen `Cell`, with the pieces of problems: `load_robot()`,
`load_noise()`, `load_constraints(robot)` and `load_error_model(robot)`."""


def page() -> str:
    """The page."""
    rows = [(code(key), escaped(k.takes), escaped(k.meaning)) for key, k in CELL_KEYS.items()]
    lines = ["# The file of a cell", "", MADE, "", INTRODUCTION, "", "```yaml", *EXAMPLE.splitlines(), "```", ""]
    lines += table(("key", "value", "meaning"), rows)
    lines += [f"For the nodes alone: {', '.join(code(key) for key in ROS_KEYS)}.", ""]
    pairs = [" and ".join(code(key) for key in pair) for pair in EITHER]
    lines += [f"One of the two only: {'; '.join(pairs)}.", "", *PYTHON.splitlines()]
    return joined(lines)
