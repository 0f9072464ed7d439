# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner import``: measurements of any layout as this package's own CSV."""

from __future__ import annotations

import argparse
from functools import partial

from rich.console import Console

from calib_planner.cli.arguments import (
    Commands,
    add_command,
    add_reading,
    add_robot,
    load_robot,
    option,
)
from calib_planner.cli.identify import add_bags, add_points, check_files, source_reading
from calib_planner.cli.terminal import Terminal
from calib_planner.io import Sources, measurements_text, read_sources, write_text
from calib_planner.units import counted

EXAMPLE = """calib-planner import joints.xlsx --points tracker.txt --robot arm.urdf --output data.csv
  calib-planner identify --robot arm.urdf --data data.csv"""

DESCRIPTION = """Read measurements as they come and write them as this package's CSV.

The files are those that identify reads: text with any separator, decimal comma or not, with or without header,
title lines and units; XLSX, MAT, NPY, NPZ, JSON; bags; and lists of points beside a table of joints. What was
recognised is said in one line per file. What is written has a column per joint [rad | m], x1,y1,z1,… and
std_x1,… [m], and payload [kg]; several files are put together."""


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "import", summary, run, EXAMPLE, DESCRIPTION)
    parser.add_argument("data", metavar="FILE", nargs="+", help="table or bag; several are taken together")
    add_robot(parser, targets=False)
    add_reading(parser)
    add_points(parser.add_argument_group("measurements"))
    add_bags(parser)
    parser.set_defaults(validate=None)
    option(parser, "--output", "FILE", "the CSV (stdout without --json)")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    check_files(args)
    reading = source_reading(args, terminal)
    sources = read_sources(args.data, load_robot(args), reading, noise_given=False, placed=False)
    if args.output:
        write_text(args.output, measurements_text(sources.data), "--output")
    elif not args.json:
        print(measurements_text(sources.data), end="")
        return
    result = {
        "rows": len(sources.data),
        "targets": sources.data.p.shape[1],
        "files": [s.understanding.to_dict() for s in sources.files],
        "output": args.output,
    }
    terminal.answer(result, partial(show_import, sources, args.output))


def show_import(sources: Sources, output: str, console: Console) -> None:
    """Print what was understood, and where it is."""
    for source in sources.files:
        if source.understanding.plain:  # of the others it was said
            console.print(f"{source.path}: {source.understanding.describe()}", soft_wrap=True)
    count, targets = sources.data.p.shape[:2]
    text = f"{counted(count, 'row')} of {counted(targets, 'reflector')} written to {output} [rad | m]"
    console.print(text, soft_wrap=True)
