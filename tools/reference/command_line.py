# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/reference/command-line.md: what every command's --help says, as lists that fit a phone."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from markdown import MADE, escaped, joined

from calib_planner.cli import EPILOG, parser

INTRODUCTION = """\
What `calib-planner COMMAND --help` says, with all commands on one page. Square brackets hold units; a value in
round brackets at the end is the default."""


def page() -> str:
    """The page."""
    top = parser()
    lines = ["# Command line", "", MADE, "", INTRODUCTION, ""]
    lines += [f"* {escaped(line)}" for line in EPILOG.strip().splitlines() if not line.startswith("Example")]
    for name, command in _commands(top).items():
        lines += ["", f"## {name}", "", *_body(command)]
        for part, inner in _commands(command).items():
            lines += ["", f"### {name} {part}", "", *_body(inner)]
    return joined(lines)


def _commands(of: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    found = [a.choices for a in of._actions if isinstance(a, argparse._SubParsersAction)]
    return dict(found[0]) if found else {}


def _body(command: argparse.ArgumentParser) -> Iterator[str]:
    text = (command.description or "").strip()
    yield from (escaped(line) for line in (text[:1].upper() + text[1:]).splitlines())
    for group in command._action_groups:
        wanted = [a for a in group._group_actions if a.help is not argparse.SUPPRESS and a.dest != "help"]
        wanted = [a for a in wanted if not isinstance(a, argparse._SubParsersAction)]
        if wanted:
            title = "" if group.title in ("options", "positional arguments") else group.title or ""
            yield from ("", f"**{title[:1].upper()}{title[1:]}**" if title else "", "")
            yield from (_option(action) for action in wanted)
    example = (command.epilog or "").strip()
    if example.startswith("Example:"):
        lines = [line.removeprefix("  ") for line in example.splitlines()[1:]]
        yield from ("", "```text", *lines, "```")


def _option(action: argparse.Action) -> str:
    words = ", ".join(action.option_strings) or str(action.metavar or action.dest)
    if action.choices is not None and action.metavar is None:
        value = "{" + ",".join(map(str, action.choices)) + "}"
    else:
        value = str(action.metavar or "")
    shown = f"{words} {value}" if value and action.option_strings and action.nargs != 0 else words
    more = " …" if action.nargs == "+" else ""
    text = escaped((action.help or "") % {"default": action.default, "prog": "calib-planner"})
    return f"* `{shown}{more}`{' (required)' if action.required else ''}: {text}"
