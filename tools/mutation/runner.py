# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The tests against each mutant, in forks of one process that has imported and collected everything.

``python runner.py JOB`` runs in the copy of the checkout; JOB is a JSON file with what ``main`` reads. Three
steps:

1. *The map.* Every test file runs once in a fork under coverage.py, which says for each line which tests
   execute it. Only tests that pass, and within ``MOST`` seconds, serve. The map is kept for each test file,
   until it or the package changes.
2. *A mutant of a line that only runs in tests* is put in place by giving the functions in memory the code of
   the mutated source; a fork then runs the tests of that line, the quickest and most often successful first,
   until one fails. Since nothing executed the line before, this is what a fresh import would do.
3. *A mutant of a line that already runs while modules are imported* (or of a default value) is written to the
   file and tested in a fork of a process that has imported third-party libraries, pytest among them, but not
   the package.

A mutant is caught if a test fails, or if the processor time exceeds ``LONGER`` times that of the map's run. It
is given up after ``ENOUGH`` seconds (by the map) of tests that pass.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import importlib
import json
import os
import resource
import select
import signal
import sys
import time
from collections import defaultdict
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

MOST = 4.0
"""Processor seconds of a test under coverage, two to three times what it takes without."""
ENOUGH = 12.0
"""Processor seconds, likewise, of the tests that a mutant has to survive."""
LONGER, LEAST = 3.0, 5.0
"""A mutant's limit: so many times the time of its tests under coverage, and this many processor seconds more."""
THIRD = (
    "numpy",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.stats",
    "scipy.sparse.linalg",
    "scipy.spatial",
    "scipy.signal",
    "yaml",
    "hypothesis",
    "hypothesis.extra.numpy",
    "pytest",
    "_pytest.assertion.rewrite",
    "coverage",
)
OPTIONS = ("-q", "-p", "no:cacheprovider", "-p", "no:randomly", "-p", "no:xdist", "-p", "no:rerunfailures", "-s")


def processor_seconds() -> float:
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in usages)


def silent() -> None:
    """No output, a process group of its own."""
    os.setsid()
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)


def waited(child: int, limit: float) -> int | None:
    """The exit status of a child; ``None`` if it was ended, with all its children, because of its time."""
    watch = os.pidfd_open(child)
    # Twenty times the processor time by the clock: a busy machine must not decide.
    ready = select.select([watch], [], [], 20.0 * limit + 60.0)[0]
    os.close(watch)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    return os.WEXITSTATUS(status) if ready and os.WIFEXITED(status) else None


def limited(seconds: float) -> None:
    """End this process after so much processor time."""
    whole = int(seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (whole, whole))


# ── mutants of lines that ran already: a fresh import ────────────────────────────────────────────────


def serve_fresh(requests: int, answers: int) -> None:
    """For each request (JSON: file, text, tests, limit) whether its tests pass with that text in the file."""
    import pytest

    with os.fdopen(requests) as lines, os.fdopen(answers, "w") as out:
        for line in lines:
            asked = json.loads(line)
            path = Path(asked["file"])
            before = path.read_text(encoding="utf-8")
            for compiled in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
                compiled.unlink()
            path.write_text(asked["text"], encoding="utf-8")
            try:
                child = os.fork()
                if not child:
                    silent()
                    limited(asked["limit"])
                    sys.dont_write_bytecode = True
                    sys.path.insert(0, os.getcwd())
                    sys.path.insert(0, str(Path("paper").resolve()))
                    quiet_hypothesis()
                    os._exit(int(pytest.main([*OPTIONS, "-x", *asked["tests"]])))
                status = waited(child, asked["limit"])
            finally:
                path.write_text(before, encoding="utf-8")
            print(json.dumps(status), file=out, flush=True)


def quiet_hypothesis() -> None:
    """The same examples for every mutant, and no search for the simplest one that fails."""
    import hypothesis

    phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    hypothesis.settings.register_profile("mutants", derandomize=True, database=None, deadline=None, phases=phases)
    hypothesis.settings.load_profile("mutants")


# ── in memory ────────────────────────────────────────────────────────────────────────────────────────


def codes(code: CodeType) -> list[CodeType]:
    """A code object and all within it, in order."""
    return [code, *(c for x in code.co_consts if isinstance(x, CodeType) for c in codes(x))]


class InMemory:
    """The functions of one file that live in this process."""

    def __init__(self, file: str) -> None:
        path = str(Path(file).resolve())
        self.path = path
        self.original = codes(compile(Path(file).read_text(encoding="utf-8"), path, "exec", dont_inherit=True))
        self.functions: dict[tuple[Any, ...], list[FunctionType]] = defaultdict(list)
        for thing in gc.get_objects():
            if isinstance(thing, FunctionType) and thing.__code__.co_filename == path:
                self.functions[place(thing.__code__)].append(thing)

    def pairs(self, text: str) -> list[tuple[FunctionType, CodeType]] | None:
        """Functions and their new code; ``None`` if more than the code of functions differs."""
        mutated = codes(compile(text, self.path, "exec", dont_inherit=True))
        if len(mutated) != len(self.original):
            return None
        changed = [(old, new) for old, new in zip(self.original, mutated, strict=True) if own(old) != own(new)]
        if not all(place(old) in self.functions or nested(old) for old, _ in changed):
            return None
        # A function whose inner function changed has changed, too: its constants hold the inner code.
        pairs = [
            (function, new)
            for old, new in zip(self.original, mutated, strict=True)
            if old != new
            for function in self.functions.get(place(old), [])
        ]
        fits = all(f.__code__.co_freevars == new.co_freevars for f, new in pairs)
        return pairs if pairs and fits else None


def place(code: CodeType) -> tuple[Any, ...]:
    """Where a function stands in its file. (Code that ran is not always equal to the same code that did not.)"""
    return code.co_qualname, code.co_firstlineno, code.co_linetable


def own(code: CodeType) -> tuple[Any, ...]:
    """What a code object does itself, without those within it."""
    constants = tuple((type(x), repr(x)) for x in code.co_consts if not isinstance(x, CodeType))
    return code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars


def nested(code: CodeType) -> bool:
    """Whether this is a function in a function, or a comprehension: its outer function carries it."""
    return "<locals>" in code.co_qualname


class Runner:
    """A pytest plugin: instead of the tests' own loop."""

    def __init__(self, job: dict[str, Any], ask: int, answer: int, coverage: Any) -> None:
        self.job, self.coverage = job, coverage
        self.ask, self.answer = os.fdopen(ask, "w"), os.fdopen(answer)
        self.kills: dict[str, int] = defaultdict(int)

    def pytest_runtestloop(self, session: Any) -> bool:
        self.coverage.stop()
        data = self.coverage.get_data()
        self.imported = {f: set(data.lines(str(Path(f).resolve())) or []) for f in self.job["files"]}
        self.items = {item.nodeid: item for item in session.items}
        self.session = session
        self.map()
        with Path(self.job["out"]).open("a", encoding="utf-8") as out:
            self.all_tested(out)
        return True

    def all_tested(self, out: Any) -> None:
        """A line of JSON for each mutant."""
        gc.collect()
        gc.freeze()
        for file in self.job["files"]:
            memory = InMemory(file)
            self.kills.clear()
            self.check_clean(file)
            for line in Path(self.job["mutants"][file]).read_text(encoding="utf-8").splitlines():
                mutant = json.loads(line)
                began = time.monotonic()
                mutant["by"] = self.tested(file, mutant, memory)
                mutant["seconds"] = round(time.monotonic() - began, 2)
                del mutant["text"]
                print(json.dumps({"file": file, **mutant}, ensure_ascii=False), file=out, flush=True)

    def check_clean(self, file: str) -> None:
        """The tests pass with the file as it is, in a fresh import as well: else every mutant would be caught."""
        text = Path(file).read_text(encoding="utf-8")
        tests = sorted({t for tests in self.lines[file].values() for t in tests}, key=lambda t: self.seconds[t])
        if (status := self.fresh(file, text, tests[:200], 600.0)) != 0:
            raise RuntimeError(f"{file} unchanged: its tests end with status {status}")

    def fresh(self, file: str, text: str, tests: list[str], limit: float) -> int | None:
        """The exit status of pytest with this text in the file; ``None`` if it takes too long."""
        request = {"file": file, "text": text, "tests": tests, "limit": limit}
        print(json.dumps(request), file=self.ask, flush=True)
        status: int | None = json.loads(self.answer.readline())
        return status

    def map(self) -> None:
        """Fill ``seconds`` (test → processor seconds) and ``lines`` (file → line → tests)."""
        self.seconds: dict[str, float] = {}
        self.lines: dict[str, dict[int, list[str]]] = {f: defaultdict(list) for f in self.job["files"]}
        store = Path(self.job["map"])
        store.mkdir(parents=True, exist_ok=True)
        package = hashlib.sha256()
        for path in [*sorted(Path("calib_planner").rglob("*.py")), Path("test/robots.py")]:
            package.update(path.read_bytes())
        by_file: dict[str, list[Any]] = defaultdict(list)
        for item in self.items.values():
            by_file[item.nodeid.split("::")[0]].append(item)
        for name, items in by_file.items():
            key = hashlib.sha256(package.digest() + Path(name).read_bytes()).hexdigest()[:24]
            part = store / f"{key}.json"
            if not part.exists():
                began = time.monotonic()
                child = os.fork()
                if not child:
                    silent()
                    try:
                        part.write_text(json.dumps(self.measured(items)), encoding="utf-8")
                    finally:
                        os._exit(0)
                waited(child, 3600.0)
                print(f"map of {name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
            if not part.exists():
                continue
            found = json.loads(part.read_text(encoding="utf-8"))
            self.seconds.update({t: s for t, s in found["seconds"].items() if t in self.items})
            for file in self.job["files"]:
                for line, tests in found["lines"].get(file, {}).items():
                    self.lines[file][int(line)] += [t for t in tests if t in self.seconds]

    def measured(self, items: list[Any]) -> dict[str, Any]:
        """Which lines each test executes, and its processor seconds; only of those that pass in time."""
        import coverage
        import pytest

        watch = coverage.Coverage(data_file=None, config_file=False, include=["*/calib_planner/*"])
        seconds = {}

        def late(*_: Any) -> None:
            pytest.skip("too long for a mutant")

        signal.signal(signal.SIGPROF, late)
        watch.start()
        for i, item in enumerate(items):
            watch.switch_context(item.nodeid)
            outcomes = Outcomes()
            item.config.pluginmanager.register(outcomes)
            before = processor_seconds()
            signal.setitimer(signal.ITIMER_PROF, MOST)
            with contextlib.suppress(BaseException):
                following = items[i + 1] if i + 1 < len(items) else None
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            item.config.pluginmanager.unregister(outcomes)
            if outcomes.all and all(x == "passed" for x in outcomes.all):
                seconds[item.nodeid] = round(processor_seconds() - before, 4)
        watch.stop()
        data = watch.get_data()
        here = Path.cwd()
        lines = {}
        for path in data.measured_files():
            by_line = data.contexts_by_lineno(path)
            lines[str(Path(path).relative_to(here))] = {
                line: [t for t in tests if t in seconds] for line, tests in by_line.items()
            }
        return {"seconds": seconds, "lines": lines}

    def tested(self, file: str, mutant: dict[str, Any], memory: InMemory) -> str:
        """The test that catches a mutant, ``"time"``, or nothing."""
        room = file.split("/")[1]
        rows = range(mutant["line"], mutant["last"] + 1)
        known = {t for row in rows for t in self.lines[file].get(row, [])}
        early = any(row in self.imported[file] for row in rows)
        try:
            pairs = memory.pairs(mutant["text"])
        except SyntaxError:
            return "syntax"
        here = set(known)
        if pairs is None or early:  # values of the import: every test of the room may depend on them
            known |= {t for t in self.seconds if t.startswith(f"test/{room}/")}

        def merit(test: str) -> float:
            away = 0.0 if test.startswith(f"test/{room}/") else 0.3
            return (self.seconds[test] + away + 0.02) / (1 + self.kills[test])

        chosen, together = [], 0.0
        for test in sorted(known, key=lambda t: (t not in here, merit(t), t)):
            if together + self.seconds[test] <= ENOUGH:
                chosen.append(test)
                together += self.seconds[test]
        if not chosen:
            return ""
        limit = LONGER * together + LEAST
        if pairs is None or early:
            status = self.fresh(file, mutant["text"], chosen, limit)
            return "time" if status is None else "" if status == 0 else "fresh"
        said, say = os.pipe()
        child = os.fork()
        if not child:
            silent()
            limited(limit)
            for function, code in pairs:
                function.__code__ = code
            for i, test in enumerate(chosen):
                following = self.items[chosen[i + 1]] if i + 1 < len(chosen) else None
                item = self.items[test]
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if self.session.testsfailed:
                    os.write(say, test.encode()[:4000])
                    os._exit(1)
            os._exit(0)
        os.close(say)
        status = waited(child, limit)
        test = os.read(said, 4096).decode()
        os.close(said)
        if test:
            self.kills[test] += 1
        return test or ("time" if status is None else "" if status == 0 else "end")


class Outcomes:
    """What the phases of one test ended with."""

    def __init__(self) -> None:
        self.all: list[str] = []

    def pytest_runtest_logreport(self, report: Any) -> None:
        self.all.append(report.outcome)


def main() -> int:
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    for name in THIRD:
        importlib.import_module(name)
    (theirs, ask), (answer, answers) = os.pipe(), os.pipe()
    server = os.fork()
    if not server:
        os.close(ask)
        os.close(answer)
        try:
            serve_fresh(theirs, answers)
        finally:
            os._exit(0)
    os.close(theirs)
    os.close(answers)
    import coverage
    import pytest

    quiet_hypothesis()
    watch = coverage.Coverage(data_file=None, config_file=False, include=["*/calib_planner/*"])
    watch.start()
    sys.path.insert(0, str(Path("paper").resolve()))
    sys.path.insert(0, os.getcwd())
    for file in job["files"]:
        importlib.import_module(file.removesuffix(".py").replace("/", "."))
    runner = Runner(job, ask, answer, watch)
    status = pytest.main([*OPTIONS, *job["tests"]], plugins=[runner])
    runner.ask.close()
    os.waitpid(server, 0)
    return int(status) if status != 5 else 0


if __name__ == "__main__":
    raise SystemExit(main())
