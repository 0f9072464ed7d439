# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/reference/codes.md: every status, reason and error that a program may meet, with what to do.

All of it is read from the tables that the library itself uses: statuses are dictionaries, and the reasons of a
verdict are ``Rule``s.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping

from markdown import MADE, code, escaped, joined, table

from calib_planner import errors
from calib_planner.campaign import OUTCOMES
from calib_planner.campaign import RULES as CAMPAIGN
from calib_planner.cli import CLOSED_PIPE, DONE, FAILED, INTERRUPTED, WRONG_USAGE
from calib_planner.compensation import STATUS as COMPENSATION
from calib_planner.identification import RULES, Rule
from calib_planner.identification import STATUS as ESTIMATE
from calib_planner.io import DECISIONS
from calib_planner.planning import PROOF_STATUS
from calib_planner.planning import STATUS as PLAN

INTRODUCTION = """\
Programs should look at these words; the messages beside them are for people. Those of ROS 2 interfaces are
constants in the [interfaces](interfaces.md)."""

CAMPAIGN_VERDICT = """\
It has the reasons of its estimate and these; without an estimate its only reason is the outcome."""

EXIT = {
    DONE: "done",
    FAILED: "the work could not be done; one line on stderr says why",
    WRONG_USAGE: "wrong usage, also a value that no run could accept",
    INTERRUPTED: "interrupted (Ctrl-C)",
    CLOSED_PIPE: "nobody reads the output any more",
}

NAME = re.compile(r"\{\w+\}")
"""A name in the text of a rule."""


def page() -> str:
    """The page."""
    lines = ["# Status and reason codes", "", MADE, "", INTRODUCTION, ""]
    for title, status in (
        ("Plan", PLAN),
        ("Bound of a plan, with `--prove`", PROOF_STATUS),
        ("Standstill of the identifier node", DECISIONS),
        ("Estimate", ESTIMATE),
        ("Corrected targets (`compensate`), row by row", COMPENSATION),
    ):
        lines += [f"## {title}", "", *_statuses(status)]
    lines += ["## Verdict of an estimate", "", _sentence(inspect.getmodule(Rule)), ""]
    lines += table(("code", "level", "text", "advice"), reasons(RULES.values()))
    lines += ["## Outcome of a campaign", "", *_statuses(OUTCOMES)]
    lines += ["## Verdict of a campaign", "", CAMPAIGN_VERDICT, ""]
    lines += table(
        ("code", "level", "text", "advice"), reasons(r for k, r in CAMPAIGN.items() if k not in OUTCOMES)
    )
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


def reasons(rules: Iterable[Rule]) -> list[tuple[str, str, str, str]]:
    """(code, levels, what was found, advice) of every reason; … stands for what is known at run time only."""
    return [
        (
            code(rule.code),
            " / ".join(rule.advice),
            escaped(NAME.sub("…", rule.text)),
            escaped(NAME.sub("…", " / ".join(dict.fromkeys(filter(None, rule.advice.values()))))),
        )
        for rule in rules
    ]
