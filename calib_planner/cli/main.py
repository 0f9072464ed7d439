"""The parser over all commands, and what every command does with errors, Ctrl-C and a closed pipe.

A command is a module with ``add(commands)``, which adds its parser, and ``run(args, terminal)``, which does
the work. To add one, add it to ``COMMANDS``.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence

import numpy as np

from calib_planner import __version__
from calib_planner.cli import (
    campaign,
    compare,
    compensate,
    demo,
    identify,
    plan,
    reproduce,
    robots,
    sheet,
    simulate,
)
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError

COMMANDS = (plan, sheet, campaign, compare, identify, compensate, simulate, robots, demo, reproduce)
DONE, FAILED, WRONG_USAGE, INTERRUPTED, CLOSED_PIPE = 0, 1, 2, 130, 141

EPILOG = """\
Units: metres and radians everywhere (REP-103); --degrees for angles in arguments and input files.
Exit status: 0 done; 1 the work could not be done; 2 wrong usage, also a value that no run could accept.
Example: calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" --configurations 4
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    try:
        args = parser().parse_args(bind_negative(sys.argv[1:] if argv is None else argv))
    except SystemExit as stop:
        return int(stop.code or DONE)
    terminal = Terminal(json_wanted=args.json)
    try:
        args.run(args, terminal)
        sys.stdout.flush()
        return DONE
    except CalibPlannerError as error:
        terminal.fail(args.command, str(error))
        wrong = isinstance(error, InputError) and not isinstance(error, FileFormatError)
        return WRONG_USAGE if wrong else FAILED
    except BrokenPipeError:
        # Nobody reads on: what is still buffered goes nowhere, so that the interpreter's exit is quiet.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return CLOSED_PIPE
    except KeyboardInterrupt:
        terminal.fail(args.command, "interrupted")
        return INTERRUPTED
    except (OSError, MemoryError, np.linalg.LinAlgError) as error:
        terminal.fail(args.command, str(error) or type(error).__name__)
        return FAILED


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = argparse.ArgumentParser(
        prog="calib-planner",
        description="Plan robot calibration with a laser tracker, and identify from measurements.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    top.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add(commands)
    return top


def bind_negative(argv: Sequence[str]) -> list[str]:
    """``--flag -1,2`` as ``--flag=-1,2``: argparse would take numbers that start with a minus for a flag."""
    bound: list[str] = []
    for word in argv:
        flag = bound[-1] if bound else ""
        if re.match(r"-\.?\d", word) and flag.startswith("--") and "=" not in flag and len(flag) > 2:
            bound[-1] = f"{flag}={word}"
        else:
            bound.append(word)
    return bound
