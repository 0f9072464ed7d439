"""The parser over all commands, and what every command does with errors, Ctrl-C and a closed pipe.

A command is a module with ``add(commands, summary)``, which adds its parser, and ``run(args, terminal)``, which
does the work. To add one, add a row to ``COMMANDS``. Only the module of the command that is run is imported, so
that ``--help`` and short commands do not wait for numerical libraries that they do not use.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module

from calib_planner import __version__
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError

COMMANDS = {
    "plan": ("calib_planner.cli.plan", "choose the configurations to be measured"),
    "sheet": ("calib_planner.cli.sheet", "a plan for the person at the robot"),
    "campaign": ("calib_planner.cli.campaign", "plan, measure and identify until it is accurate enough"),
    "compare": ("calib_planner.cli.compare", "the proposed plan beside random plans (Table 2)"),
    "identify": ("calib_planner.cli.identify", "identify parameters from measurements"),
    "compensate": (
        "calib_planner.cli.compensate",
        "joint targets corrected for a nominal controller",
    ),
    "simulate": ("calib_planner.cli.simulate", "measure a plan with a simulated robot"),
    "robots": ("calib_planner.cli.robots", "list the shipped robots, or show one"),
    "demo": ("calib_planner.cli.demo", "plan, measure and identify a simulated robot"),
    "reproduce": ("calib_planner_paper.reproduce", "the paper's tables and figures, computed again"),
}
"""Name → module, and what the command does in a few words."""
NO_PAPER = (
    "the package calib_planner_paper is not installed; it comes with the source of calib_planner, "
    "so install that (pip install .) or put its folder paper/ on PYTHONPATH"
)
DONE, FAILED, WRONG_USAGE, INTERRUPTED, CLOSED_PIPE = 0, 1, 2, 130, 141

EPILOG = """\
Units: metres and radians everywhere (REP-103); --degrees for angles in arguments and input files.
Exit status: 0 done; 1 the work could not be done; 2 wrong usage, also a value that no run could accept.
Example: calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" --configurations 4
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    try:
        words = bind_negative(sys.argv[1:] if argv is None else argv)
        args = parser(next((w for w in words if w in COMMANDS), "")).parse_args(words)
    except SystemExit as end:
        return int(end.code or DONE)
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
    except Exception as error:
        from numpy.linalg import LinAlgError  # --help and --version do without NumPy

        if not isinstance(error, (OSError, MemoryError, LinAlgError)):
            raise
        terminal.fail(args.command, str(error) or type(error).__name__)
        return FAILED


def parser(wanted: str | None = None) -> argparse.ArgumentParser:
    """The parser of all commands.

    Args:
        wanted: The only command whose options are added; ``None`` adds those of every command.

    Raises:
        SystemExit: The package of the wanted command is not installed; the reason is on stderr.
    """
    top = argparse.ArgumentParser(
        prog="calib-planner",
        description="Plan robot calibration with a laser tracker, and identify from measurements.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    top.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (module, summary) in COMMANDS.items():
        if wanted not in (None, name):
            commands.add_parser(name, help=summary)
            continue
        try:
            import_module(module).add(commands, summary)
        except ModuleNotFoundError as error:
            if error.name != "calib_planner_paper":
                raise
            top.exit(FAILED, f"calib-planner {name}: {NO_PAPER}\n")
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
