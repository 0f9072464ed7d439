"""Processor time of the tests by room, printed at the end of a run (a pytest plugin, also with pytest-xdist).

Every report of a test carries the processor time that its process and the ended children of that process used
since the report before, with the test's set-up and tear-down. What is left is start, collection and end. Time by
the clock would count the neighbours of a busy machine; a test that waits costs little processor time, so the
clock's time stands beside it.
"""

from __future__ import annotations

import resource
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

TESTS = Path(__file__).parent


def processor_seconds() -> float:
    """Processor time [s] that this process and its ended children have used."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--time-by", choices=("room", "file"), default="room", help="processor time by room or file")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(ProcessorTime(), "processor time")


class ProcessorTime:
    """What one process counts, and in the process that reports, what all of them count."""

    def __init__(self) -> None:
        self._before = 0.0
        self._apart = 0.0
        self._total = 0.0

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

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        self._apart += getattr(node, "workeroutput", {}).get("processor_seconds_apart", 0.0)

    def pytest_terminal_summary(self, terminalreporter: Any, config: pytest.Config) -> None:
        by_file = config.getoption("time_by") == "file"
        rows: dict[str, list[float]] = defaultdict(lambda: [0, 0.0, 0.0])
        for reports in terminalreporter.stats.values():
            for report in reports:
                if hasattr(report, "processor_seconds"):
                    path = Path(report.location[0])
                    row = rows[str(path) if by_file else room(path)]
                    row[0] += report.when == "call"
                    row[1] += report.processor_seconds
                    row[2] += report.duration
        rows["start, collection, end"] = [0, self._apart, 0.0]
        rows["together"] = [sum(column) for column in zip(*rows.values(), strict=True)]
        terminalreporter.section("processor time by room")
        terminalreporter.write_line(f"{'':44} {'tests':>6} {'processor s':>12} {'clock s':>9}")
        for name, (count, processor, clock) in sorted(rows.items(), key=lambda item: -item[1][1]):
            terminalreporter.write_line(f"{name:44} {count:6.0f} {processor:12.1f} {clock:9.1f}")


def room(path: Path) -> str:
    """The room that a test file, relative to the repository's root, belongs to: its folder in test/."""
    folders = path.parts[:-1]
    return "/".join(folders[:2]) or "."
