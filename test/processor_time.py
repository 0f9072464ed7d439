# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Processor time of the tests by room, printed at the end of a run (a pytest plugin, also with pytest-xdist).

Every report of a test carries the processor time that its process and the ended children of that process used
since the report before, with the test's set-up and tear-down. What is left is start, collection and end. Time by
the clock would count the neighbours of a busy machine; a test that waits costs little processor time, so the
clock's time stands beside it.
"""

from __future__ import annotations

import resource
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import pytest

MOST = 60
"""So many lines are printed, the costliest ones."""


def used_seconds(who: int) -> float:
    """Processor time [s] that this process (``RUSAGE_SELF``) or its ended children (``RUSAGE_CHILDREN``) used."""
    usage = resource.getrusage(who)
    return usage.ru_utime + usage.ru_stime


def processor_seconds() -> float:
    """Processor time [s] that this process and its ended children have used."""
    return used_seconds(resource.RUSAGE_SELF) + used_seconds(resource.RUSAGE_CHILDREN)


def file_of(test: str) -> str:
    return test.split("::")[0]


def room_of(test: str) -> str:
    """The room that a test belongs to: its folder in test/."""
    return "/".join(file_of(test).split("/")[:-1][:2])


NAMES: dict[str, Callable[[str], str]] = {"room": room_of, "file": file_of, "test": str}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--time-by", choices=NAMES, default="room", help="of what the processor time is printed at the end"
    )


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(ProcessorTime(), "processor time")


class ProcessorTime:
    """What one process counts, and in the process that reports, what all of them count."""

    def __init__(self) -> None:
        self._before = 0.0
        self._apart = 0.0
        self._workers = 0.0

    def _lap(self) -> float:
        """Processor time [s] since the last call."""
        before, self._before = self._before, processor_seconds()
        return self._before - before

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self) -> None:
        self._apart += self._lap()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Any:
        report = yield
        report.processor_seconds = self._lap()
        return report

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        output = getattr(session.config, "workeroutput", None)
        self._apart += self._lap()
        if output is not None:
            output["processor_seconds_apart"] = self._apart
        elif self._workers:
            # Workers are children that have ended: what they used is counted by themselves.
            self._apart = used_seconds(resource.RUSAGE_SELF)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        self._workers += getattr(node, "workeroutput", {}).get("processor_seconds_apart", 0.0)

    def pytest_terminal_summary(self, terminalreporter: Any, config: pytest.Config) -> None:
        if config.option.collectonly:
            return
        name_of = NAMES[config.getoption("time_by")]
        rows: dict[str, list[float]] = defaultdict(lambda: [0, 0.0, 0.0])
        for reports in terminalreporter.stats.values():
            for report in reports:
                if hasattr(report, "processor_seconds"):
                    row = rows[name_of(report.nodeid)]
                    row[0] += report.when == "call"
                    row[1] += report.processor_seconds
                    row[2] += report.duration
        rows["start, collection, end"] = [0, self._apart + self._workers, 0.0]
        rows["together"] = [sum(column) for column in zip(*rows.values(), strict=True)]
        terminalreporter.section("processor time")
        terminalreporter.write_line(f"{'processor s':>12} {'clock s':>9} {'tests':>6}")
        for name, (count, processor, clock) in sorted(rows.items(), key=lambda item: -item[1][1])[:MOST]:
            terminalreporter.write_line(f"{processor:12.1f} {clock:9.1f} {count:6.0f}  {name}")
