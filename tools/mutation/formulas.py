# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Which mutants change a formula: a rule, applied to the source and to the name of the mutation.

A *formula line* is code in a function (or a lambda) that computes. Not counted is what does not compute:

* annotations, decorators, imports, docstrings, text with values in it (f-strings), and whole functions that
  return text (``-> str``, ``__repr__``);
* ``raise``, ``assert``, an ``if`` that does nothing but raise, calls of the gatekeepers (``check_…``), warnings
  and log lines: these guard a formula;
* keywords that change no value (``KEYWORDS``).

Some mutations of such lines are left out as well, because they would be caught, or would survive, for a reason
that says nothing about a test:

* arithmetic replaced by a bit operator, and the other way round: a number of type float raises TypeError, and
  ``&`` and ``*`` of masks are the same function;
* a comparison replaced by identity, or identity by a comparison: ``is None`` and ``== None`` are the same,
  ``<`` with None raises TypeError;
* the kind of exception that is expected.

One kind of mutant gives the same values wherever it stands, and is listed by rule (``same_by_rule``): ``-2``
for the unknown size of ``reshape``.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

Place = tuple[int, int]
"""Line, counted from 1, and column, counted from 0 in characters."""

KEYWORDS = {"strict", "copy", "write", "check_finite", "overwrite_a", "overwrite_b", "optimize"}
"""Refuse what cannot come, protect an array, or choose between two ways to the same value."""
BITS = {"BitAnd", "BitOr", "BitXor"}
SHIFTS = {"LShift", "RShift", "Invert"}
IDENTITY = {"Is", "IsNot"}


def changes_formula(operator: str) -> bool:
    """Whether a mutation of cosmic-ray can be that of a formula, by its name (``core/NumberReplacer``)."""
    kind, *changed = operator.removeprefix("core/").split("_")
    if kind in ("ExceptionReplacer", "RemoveDecorator"):
        return False
    if any(name in SHIFTS for name in changed):
        return False
    return all(len({name in names for name in changed}) <= 1 for names in (BITS, IDENTITY))


def same_by_rule(old: str, new: str) -> str | None:
    """Why these two texts of a line compute the same, if a rule says so."""
    at = next((i for i, (a, b) in enumerate(zip(old, new, strict=False)) if a != b), 0)
    call = old[old.rfind("reshape(", 0, at) : at]
    unknown = call.startswith("reshape(") and call.count("(") == call.count(")") + 1 and call.endswith("-")
    if unknown and old[at : at + 2] in ("1)", "1,") and new[at:] == " 2" + old[at + 1 :]:
        return "NumPy takes every negative size as the unknown one."
    return None


class Formulas:
    """The formula lines of one source."""

    def __init__(self, source: str) -> None:
        self.lines = source.splitlines()
        self.inside: list[tuple[Place, Place]] = []
        self.outside: list[tuple[Place, Place]] = []
        self.statements: dict[int, tuple[int, int]] = {}
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.stmt):
                self.add_statement(node)
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                self.inside.append(self.range(node))
                if node.name == "__repr__" or (isinstance(node.returns, ast.Name) and node.returns.id == "str"):
                    self.outside.append(self.range(node))
            elif isinstance(node, ast.Lambda):
                self.inside.append(self.range(node))
            self.outside += [self.range(part) for part in idle(node)]

    def add_statement(self, node: ast.stmt) -> None:
        """Remember its lines; of an ``if`` or a loop those of its head. Inner statements prevail."""
        body = getattr(node, "body", None)
        last = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno or node.lineno
        for line in range(node.lineno, last + 1):
            self.statements[line] = (node.lineno, last)

    def range(self, node: ast.AST) -> tuple[Place, Place]:
        """Begin and end of a node, in characters (``ast`` counts bytes)."""
        places = ((getattr(node, f"{x}lineno"), getattr(node, f"{x}col_offset")) for x in ("", "end_"))
        first, last = ((line, len(self.lines[line - 1].encode()[:column].decode())) for line, column in places)
        return first, last

    def __contains__(self, place: Place) -> bool:
        return any(a <= place < b for a, b in self.inside) and not any(a <= place < b for a, b in self.outside)


def idle(node: ast.AST) -> Iterator[ast.AST]:
    """The parts of a node, or the node itself, that compute nothing."""
    for name in ("annotation", "returns"):
        if isinstance(part := getattr(node, name, None), ast.expr):
            yield part
    yield from getattr(node, "decorator_list", [])
    if (
        isinstance(node, (ast.Raise, ast.Assert, ast.Import, ast.ImportFrom, ast.JoinedStr))
        or (isinstance(node, ast.If) and not node.orelse and all(isinstance(x, ast.Raise) for x in node.body))
        or (isinstance(node, ast.keyword) and node.arg in KEYWORDS)
    ):
        yield node
    elif isinstance(node, ast.Call):
        called = node.func
        name = (
            called.id
            if isinstance(called, ast.Name)
            else called.attr
            if isinstance(called, ast.Attribute)
            else ""
        )
        holder = (
            called.value.id if isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name) else ""
        )
        if name.startswith("check_") or holder in ("warnings", "logging", "log", "logger", "_log"):
            yield node
