# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What is said about a command line that cannot be understood: which word, what is valid, what was meant.

``argparse`` reports the first thing that it stumbles over, which is often not the fault: a mistyped ``--robt`` as
a missing ``--robot``, a pose without quotes as unknown arguments. So options and numbers are looked at first.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Iterator, Sequence
from difflib import get_close_matches
from typing import NoReturn

from calib_planner.errors import InputError

NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?,?")
KINDS = {"int": "a whole number", "float": "a number"}
"""Type of a value → the words for it."""


ALIKE = 0.7
"""Share of equal letters from which a word is a mistyped one: two exchanged letters of four are 0.75."""


class UsageError(InputError):
    """A command line that cannot be understood."""


class HelpfulParser(argparse.ArgumentParser):
    """A parser that raises ``UsageError``, of one line, where others print their usage and exit."""

    def error(self, message: str) -> NoReturn:
        """Raise the error that one of ``argparse``'s messages stands for."""
        raise _read(message, f"{self.prog} --help shows all options")


def _read(message: str, where: str) -> UsageError:
    """The error of one of ``argparse``'s messages; ``where`` more is said."""
    named = re.fullmatch(r"argument ([^:]+): (.*)", message, re.DOTALL)
    if named is None:
        missing = re.fullmatch(r"the following arguments are required: (.*)", message)
        if missing:
            return UsageError(missing[1], "nothing", "a value: it is required", where)
        several = re.fullmatch(r"one of the arguments (.*) is required", message)
        if several:
            return UsageError("arguments", "none of them", f"one of the arguments {several[1]}", where)
        unknown = re.sub(r"^unrecognized arguments: ", "", message)
        return UsageError("arguments", unknown, "options and their values only", where)
    field, text = named[1], named[2]
    kind = re.fullmatch(r"invalid (\w+) value: (.*)", text, re.DOTALL)
    if kind:
        return UsageError(field, kind[2], KINDS.get(kind[1], kind[1]))
    choice = re.fullmatch(r"invalid choice: '?(.*?)'? \(choose from (.*)\)", text, re.DOTALL)
    if choice:
        valid = [c.strip(" '") for c in choice[2].split(",")]
        return UsageError(field, repr(choice[1]), f"one of: {', '.join(valid)}", suggestion(choice[1], valid))
    pair = re.fullmatch(r"expected (.*?), got (.*?)(?:; (.*))?", text, re.DOTALL)
    if pair:
        return UsageError(field, pair[2], pair[1], pair[3] or "")
    count = re.fullmatch(r"expected (.* arguments?)", text)
    if count:
        return UsageError(field, "no value", count[1].replace("argument", "value"))
    other = re.fullmatch(r"not allowed with argument (.*)", text)
    if other:
        return UsageError(field, f"{other[1]} beside it", "one of the two")
    return UsageError(field, "a value that cannot be used", text)


def suggestion(word: str, valid: Iterable[str]) -> str:
    """What was probably meant, as advice; empty where nothing is near."""
    names, bare = list(valid), word.lstrip("-")
    longer = [n for n in names if len(bare) > 3 and n.startswith(word)]
    close = get_close_matches(bare, [n.lstrip("-") for n in names], n=1, cutoff=ALIKE)
    near = longer[:1] or [n for n in names if n.lstrip("-") in close][:1]
    return f"did you mean {near[0]}?" if near else ""


def with_cell(top: argparse.ArgumentParser, words: Sequence[str]) -> list[str]:
    """The words with the options that the file of --cell states, unless they, or one in their place, are given.

    Raises:
        FileFormatError: The file is not a cell.
    """
    chain = list(_parsers(top, words))
    command = chain[-1]
    given = {word.split("=")[0] for word in words if word.startswith("--")}
    path = next((_value(words, i) for i, w in enumerate(words) if w.split("=")[0] == "--cell"), "")
    if "--cell" not in command._option_string_actions or not path:
        return list(words)
    from calib_planner.io import EITHER, read_cell  # NumPy and YAML, for this option alone

    cell = read_cell(path)
    either = [{f"--{key}" for key in pair} for pair in EITHER]
    either += [
        {f for a in g._group_actions for f in a.option_strings} for g in command._mutually_exclusive_groups
    ]
    taken = given.union(*(group for group in either if group & given))
    if "--robot" in given:  # links are of the cell's robot
        taken |= {"--base-link", "--tip-link", "--couple"}
    if "--units" in given:
        taken |= {"--degrees", "--millimetres"}
    added: list[str] = []
    for flag, values in cell.options().items():
        action = command._option_string_actions.get(flag)
        if action is None or flag in taken or action.dest != flag[2:].replace("-", "_"):
            continue  # compensate has --targets of its own
        added += [flag] if action.nargs == 0 else [f"{flag}={value}" for value in values]
    for action in command._actions:
        if action.nargs == "?" and not action.option_strings and getattr(cell, action.dest, None) is not None:
            action.default = getattr(cell, action.dest)
    last = max(i for i, w in enumerate(words) if any(w in _choices(p) for p in chain))
    return [*words[: last + 1], *added, *words[last + 1 :]]


def _value(words: Sequence[str], i: int) -> str:
    """The value of the option in ``words[i]``; empty where there is none."""
    _, equals, value = words[i].partition("=")
    return value if equals else next(iter(words[i + 1 : i + 2]), "")


def _choices(of: argparse.ArgumentParser) -> Iterable[str]:
    """Names of the commands, or actions, below a parser."""
    return (name for a in of._actions if isinstance(a, argparse._SubParsersAction) for name in a.choices)


def refuse_unknown_options(top: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """Refuse an option that the command does not have, and say which one is near.

    Raises:
        UsageError: Names the option.
    """
    parsers = list(_parsers(top, words))
    known = {flag: a for p in parsers for flag, a in p._option_string_actions.items()}
    for word in words:
        if word == "--":
            return
        flag = word.split("=")[0]
        if word.startswith("--") and flag not in known:
            where = f"{parsers[-1].prog} --help shows all options"
            near = suggestion(flag, [f for f in known if f.startswith("--")])
            raise UsageError(flag, "an unknown option", f"an option of {parsers[-1].prog}", near or where)


def refuse_unquoted_numbers(top: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """Refuse several numbers after an option that takes them as one word, such as ``--test-pose -1.2 0.3``.

    Raises:
        UsageError: Names the option and shows the numbers in quotes.
    """
    lists = {
        flag
        for p in _parsers(top, words)
        for a in p._actions
        for flag in a.option_strings
        if a.nargs is None and str(a.metavar).startswith('"')
    }
    for i, word in enumerate(words):
        flag, equals, first = word.partition("=")
        if flag not in lists:
            continue
        numbers = [first] if equals else []
        for following in words[i + 1 :]:
            if NUMBER.fullmatch(following) is None:
                break
            numbers.append(following)
        if len(numbers) > 1 and (not equals or NUMBER.fullmatch(first)):
            got = f"{len(numbers)} words"
            advice = f'quote it: {flag} "{" ".join(numbers)}"'
            raise UsageError(flag, got, "all its numbers as one word", advice)


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


def _parsers(top: argparse.ArgumentParser, words: Sequence[str]) -> Iterator[argparse.ArgumentParser]:
    """The parser of all commands, that of the command in ``words``, and that of its action."""
    yield top
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            chosen = next((w for w in words if w in action.choices), None)
            if chosen is not None:
                yield from _parsers(action.choices[chosen], words)
