# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The parser over all commands, and what every command does with errors, Ctrl-C and a closed pipe.

A command is a module with ``add(commands, summary)``, which adds its parser, and ``run(args, terminal)``, which
does the work. To add one, add a row to ``COMMANDS``. Only the module of the command that is run is imported, so
that ``--help`` and short commands do not wait for numerical libraries that they do not use.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module

from calib_planner import __version__
from calib_planner.cli.usage import (
    HelpfulParser,
    UsageError,
    bind_negative,
    refuse_unknown_options,
    refuse_unquoted_numbers,
    suggestion,
    with_cell,
)
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError

COMMANDS = {
    "init": ("calib_planner.cli.init", "describe a cell once, in cell.yaml, and try it on measurements"),
    "plan": ("calib_planner.cli.plan", "choose the configurations to be measured"),
    "sheet": ("calib_planner.cli.sheet", "a plan for the person at the robot"),
    "program": ("calib_planner.cli.program", "a plan for the robot's controller"),
    "campaign": ("calib_planner.cli.campaign", "plan, measure and identify until it is accurate enough"),
    "compare": ("calib_planner.cli.compare", "the proposed plan beside random plans of the same size"),
    "import": ("calib_planner.cli.import_data", "measurements of any layout as this package's CSV"),
    "identify": ("calib_planner.cli.identify", "identify parameters from measurements"),
    "compensate": (
        "calib_planner.cli.compensate",
        "joint targets corrected for a nominal controller",
    ),
    "export": ("calib_planner.cli.export", "URDF, kinematics, report and corrected targets of an estimate"),
    "simulate": ("calib_planner.cli.simulate", "measure a plan with a simulated robot"),
    "robots": ("calib_planner.cli.robots", "list the shipped robots, or show one"),
    "completion": ("calib_planner.cli.completion", "print the script that completes words in bash or zsh"),
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
Units: metres and radians everywhere (REP-103), a length also as 20um or 0.02mm; --degrees for angles in arguments
and input files. Exit status: 0 done; 1 the work could not be done; 2 wrong usage, also a value that no run could
accept. With --json an error is one object too: {"error": {field, got, expected, advice, message}}.
Example: calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" --configurations 4
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    command = next((w for w in words if w in COMMANDS), "")
    try:
        args = parse(words, command)
        from calib_planner.cli.terminal import Terminal  # rich, 0.1 s, which --help does not wait for

        terminal = Terminal(json_wanted=args.json)
    except SystemExit as end:  # of --help and --version
        return int(end.code or DONE)
    except CalibPlannerError as error:
        return _failed("--json" in words, command, error)
    except KeyboardInterrupt:  # while what the command needs is imported
        _tell("--json" in words, command, "interrupted")
        return INTERRUPTED
    try:
        args.run(args, terminal)
        sys.stdout.flush()
        return DONE
    except CalibPlannerError as error:
        return _failed(args.json and not terminal.answered, command, error)
    except BrokenPipeError:
        # Nobody reads on: what is still buffered goes nowhere, so that the interpreter's exit is quiet.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return CLOSED_PIPE
    except KeyboardInterrupt:
        _tell(args.json and not terminal.answered, command, "interrupted")
        return INTERRUPTED
    except Exception as error:
        from numpy.linalg import LinAlgError  # --help and --version do without NumPy

        if not isinstance(error, (OSError, MemoryError, LinAlgError)):
            raise
        _tell(args.json and not terminal.answered, command, str(error) or type(error).__name__)
        return FAILED


def parse(words: Sequence[str], command: str) -> argparse.Namespace:
    """The arguments of a command line, in which ``command`` is the first word that names a command.

    Raises:
        UsageError: Wrong usage.
        SystemExit: --help and --version.
    """
    top = parser(command)
    if not command and not {"-h", "--help", "--version"} & {*words}:
        first = next((w for w in words if not w.startswith("-")), None)
        if first is not None:
            expected = f"one of: {', '.join(COMMANDS)}"
            raise UsageError("command", repr(first), expected, suggestion(first, COMMANDS))
        top.print_help(sys.stderr)
        raise SystemExit(WRONG_USAGE)
    refuse_unknown_options(top, words)
    refuse_unquoted_numbers(top, words)
    return top.parse_args(bind_negative(with_cell(top, words)))


def _failed(json_wanted: bool, command: str, error: CalibPlannerError) -> int:
    """Say why; the exit status."""
    _tell(json_wanted, command, str(error), error)
    wrong = isinstance(error, InputError) and not isinstance(error, FileFormatError)
    return WRONG_USAGE if wrong else FAILED


def _tell(json_wanted: bool, command: str, reason: str, error: CalibPlannerError | None = None) -> None:
    """One line on stderr, and one JSON object on stdout if that is wanted."""
    one_line = " ".join(reason.split())
    print(f"{' '.join(['calib-planner', command]).strip()}: {one_line}", file=sys.stderr)
    if json_wanted:
        import json

        known = {key: getattr(error, key, None) for key in ("field", "got", "expected", "advice")}
        print(json.dumps({"error": {**known, "message": one_line}}, ensure_ascii=False))


def parser(wanted: str | None = None) -> argparse.ArgumentParser:
    """The parser of all commands.

    Args:
        wanted: The only command whose options are added; ``None`` adds those of every command.

    Raises:
        CalibPlannerError: The package of the wanted command is not installed.
    """
    top = HelpfulParser(
        prog="calib-planner",
        description="Plan robot calibration with a laser tracker, and identify from measurements.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    top.set_defaults(all_commands=parser)
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
            raise CalibPlannerError(NO_PAPER) from None
    return top
