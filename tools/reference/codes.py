"""docs/reference/codes.md: every status, reason and error that a program may meet, with what to do.

Statuses are dictionaries of the modules. The verdict's reasons are read from the source of ``verdict.py``: each
is ``yield Reason(level, code, text, advice)``, where level, text and advice may have been assigned before, and a
dictionary of words has a code for each key.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping

from markdown import MADE, code, escaped, joined, table

from calib_planner import errors
from calib_planner.cli.main import CLOSED_PIPE, DONE, FAILED, INTERRUPTED, WRONG_USAGE
from calib_planner.compensation import STATUS as COMPENSATION
from calib_planner.identification import verdict
from calib_planner.identification.estimate import STATUS as ESTIMATE
from calib_planner.planning.certify.prove import PROOF_STATUS
from calib_planner.planning.result import STATUS as PLAN

INTRODUCTION = """\
Programs should look at these words; the messages beside them are for people. Those of ROS 2 interfaces are
constants in the [interfaces](interfaces.md)."""

EXIT = {
    DONE: "done",
    FAILED: "the work could not be done; one line on stderr says why",
    WRONG_USAGE: "wrong usage, also a value that no run could accept",
    INTERRUPTED: "interrupted (Ctrl-C)",
    CLOSED_PIPE: "nobody reads the output any more",
}

Words = dict[str, str]
KEY = "·key"
"""Among the words: the key of the item that a dictionary of words stands for."""


def page() -> str:
    """The page."""
    lines = ["# Status and reason codes", "", MADE, "", INTRODUCTION, ""]
    for title, status in (
        ("Plan", PLAN),
        ("Bound of a plan, with `--prove`", PROOF_STATUS),
        ("Estimate", ESTIMATE),
        ("Corrected targets (`compensate`), row by row", COMPENSATION),
    ):
        lines += [f"## {title}", "", *_statuses(status)]
    lines += ["## Verdict of an estimate", "", _sentence(verdict), ""]
    lines += table(("code", "level", "found", "advice"), reasons())
    exits = [(str(status), words) for status, words in EXIT.items()]
    lines += ["## Exit status of `calib-planner`", "", *table(("status", "meaning"), exits)]
    lines += ["## Errors of the library", "", "All are children of `CalibPlannerError`.", ""]
    lines += table(("error", "meaning"), _errors())
    return joined(lines)


def _statuses(status: Mapping[str, str]) -> list[str]:
    return table(("status", "meaning"), ((code(k), escaped(v)) for k, v in status.items()))


def _sentence(module: object) -> str:
    return escaped(" ".join((inspect.getdoc(module) or "").split("\n\n", 2)[1].split()))


def _errors() -> Iterator[tuple[str, str]]:
    for name, kind in vars(errors).items():
        if isinstance(kind, type) and issubclass(kind, errors.CalibPlannerError):
            yield code(name), escaped((inspect.getdoc(kind) or "").split("\n\n")[0].replace("\n", " "))


def reasons() -> list[tuple[str, str, str, str]]:
    """(code, levels, what was found, advice) of every reason, in the order of the checks."""
    module = ast.parse(inspect.getsource(verdict))
    functions = {f.name: f for f in module.body if isinstance(f, ast.FunctionDef)}
    returned = {name: " / ".join(_returns(f)) for name, f in functions.items()}
    found: dict[tuple[str, str], tuple[str, str, str, str]] = {}
    for function in functions.values():
        for row in _walk(function.body, [dict(returned)])[0]:
            found.setdefault((row[0], row[2]), row)
    return list(found.values())


def _returns(function: ast.FunctionDef) -> Iterator[str]:
    for node in ast.walk(function):
        if isinstance(node, ast.Return) and node.value is not None:
            yield _text(node.value, {})


def _walk(body: list[ast.stmt], words: list[Words]) -> tuple[list[tuple[str, str, str, str]], list[Words]]:
    """Reasons of a block, and what its names say at its end; ``words``: the same at its beginning, by branch."""
    rows = []
    for statement in body:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            name, value = statement.targets[0].id, statement.value
            if isinstance(value, ast.Dict):  # one reason for each of its items
                items = [(_text(k, {}), _text(v, {})) for k, v in zip(value.keys, value.values, strict=True) if k]
                words = [{**known, KEY: key, name: text} for known in words for key, text in items]
            else:
                words = [{**known, name: _text(value, known)} for known in words]
        elif isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Yield):
            rows += [_reason(statement.value.value, known) for known in words]
        elif isinstance(statement, ast.If):
            (one, first), (other, second) = (_walk(b, words) for b in (statement.body, statement.orelse))
            rows, words = [*rows, *one, *other], [*first, *second]
        elif isinstance(statement, ast.For):
            rows += _walk(statement.body, words)[0]
    return rows, words


def _reason(call: ast.expr | None, words: Words) -> tuple[str, str, str, str]:
    assert isinstance(call, ast.Call)
    level, name, text, advice = ([_text(a, words) for a in call.args] + [""])[:4]
    name = name if isinstance(call.args[1], ast.Constant) else words[KEY]
    level = " / ".join(sorted(level.split(" / "), key=verdict.LEVELS.index))
    return code(name), level, escaped(text), escaped(advice)


def _text(value: ast.expr, words: Words) -> str:
    """What an expression says, with … for what is known at run time only."""
    if isinstance(value, ast.Constant):
        return str(value.value)
    if isinstance(value, ast.JoinedStr):
        return "".join(_text(v, words) for v in value.values)
    if isinstance(value, ast.FormattedValue):
        return _text(value.value, words) if isinstance(value.value, ast.Subscript) else "…"
    if isinstance(value, ast.Subscript) and isinstance(value.value, ast.Name):
        return words.get(value.value.id, "…")
    if isinstance(value, ast.IfExp):
        either = (_text(v, words) for v in (value.body, value.orelse))
        return " / ".join(dict.fromkeys(filter(None, either)))
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name):
        return words.get(value.func.id, "…")
    if isinstance(value, ast.Name):
        return words.get(value.id, "…")
    return f"the {value.attr}" if isinstance(value, ast.Attribute) else "…"
