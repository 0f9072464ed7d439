# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner completion``: the script that lets a shell complete commands, options and files.

The script is a table of all commands and options, written once by shtab and read by the shell alone. The other
way, argcomplete, starts Python at every press of the tab key, which takes this program a second.
"""

from __future__ import annotations

import argparse

from calib_planner.cli.arguments import Commands, add_command
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import MissingExtraError

EXAMPLE = """calib-planner completion bash > ~/.local/share/bash-completion/completions/calib-planner
  calib-planner completion zsh > ~/.zfunc/_calib-planner"""
DESCRIPTION = """Print the script that completes commands, options and files when the tab key is pressed.

bash reads it from the folder below (a new shell has it); zsh from a folder of fpath: put the line
fpath+=~/.zfunc before compinit into ~/.zshrc. Print it again after an update. Needs calib_planner[completion]."""
SHELLS = ("bash", "zsh")
FILES = {"FILE", "R", "E"}
"""Names of values that can be files."""
FOLDERS = {"DIR"}


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "completion", summary, run, EXAMPLE, DESCRIPTION, cell=False)
    parser.add_argument("shell", choices=SHELLS, help="the shell that will read the script")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work.

    Raises:
        MissingExtraError: shtab is not installed.
    """
    try:
        import shtab
    except ImportError:
        raise MissingExtraError("completion", "shtab", "the completion of words in a shell") from None
    top = args.all_commands()
    _mark_files(top, shtab.FILE, shtab.DIRECTORY)
    script = shtab.complete(top, args.shell)
    terminal.answer({"shell": args.shell, "script": script}, lambda console: print(script))


def _mark_files(of: argparse.ArgumentParser, file: object, folder: object) -> None:
    """Say which options of a parser, and of those below it, take a file or a folder."""
    for action in of._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                _mark_files(inner, file, folder)
        elif action.metavar in FILES | FOLDERS:
            action.complete = folder if action.metavar in FOLDERS else file  # type: ignore[attr-defined]
