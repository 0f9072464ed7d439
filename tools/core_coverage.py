# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How many branches of the core the tests take: ``make coverage``.

The *core* is the package without ``calib_planner/ros``. A *branch* is one of the ways on from a line that has
several: of an ``if`` both, of a loop another turn and the end. The tests are those of the core's own rooms, of
the command line, of the pages of the documentation and the golden ones; those of nodes are left out, though they
take some more branches. coverage.py counts, in children of the tests too.

The pages with every line are ``build/coverage/index.html``, the figures ``build/coverage/core.json``. ``--write``
puts the table into docs/proof.md and the figure into docs/quality-declaration.md; ``--more FILE …`` adds what
these tests take to the last measurement. Arguments that are not known go to pytest.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build" / "coverage"
PAGE, DECLARATION = ROOT / "docs" / "proof.md", ROOT / "docs" / "quality-declaration.md"
TOLD = re.compile(r"[\d.]+ % of the branches of the core")
"""The same figure in the declaration."""
BEGIN, END = "<!-- coverage: written by tools/core_coverage.py --write -->\n", "<!-- end of coverage -->\n"
NOT_OF_THE_CORE = (
    "test/ros",
    "test/page",
    "test/golden/test_nodes.py",
    "test/test_docs_build.py",
    "test/test_packaging.py",
    "test/test_rooms.py",
)
"""Tests of nodes, and those that run no code of the core."""
CANNOT = "test/cli/test_commands.py::test_commands_import_what_they_use"
"""It looks at what a command imports, and coverage.py is imported then."""
KEYS = ("num_branches", "covered_branches", "num_statements", "covered_lines")


def coverage(*arguments: str) -> int:
    environment = os.environ | {"COVERAGE_FILE": str(FOLDER / "data")}
    return subprocess.run([sys.executable, "-m", "coverage", *arguments], cwd=ROOT, env=environment).returncode


def measured(arguments: list[str], more: list[str]) -> int:
    """Run the tests; what was measured before goes, unless there are ``more``. pytest's status."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for old in FOLDER.glob("data*"):
        if not (more and old.name == "data"):
            old.unlink()
    chosen = more or ["test", *(f"--ignore={path}" for path in NOT_OF_THE_CORE), f"--deselect={CANNOT}"]
    status = coverage(
        "run", "--parallel-mode", "-m", "pytest", "-q", "-p", "no:cacheprovider", *chosen, *arguments
    )
    coverage("combine", "--quiet", "--append")
    return status


def rooms_of(document: dict) -> dict[str, list[int]]:
    """Room → branches, branches taken, statements and statements run; files that are no room together."""
    rooms: dict[str, list[int]] = defaultdict(lambda: [0] * len(KEYS))
    for file, told in document["files"].items():
        inside = Path(file).parts[Path(file).parts.index("calib_planner") + 1 :]
        room = inside[0] if len(inside) > 1 else "single files"
        rooms[room] = [a + told["summary"][k] for a, k in zip(rooms[room], KEYS, strict=True)]
    return dict(sorted(rooms.items()))


def table(document: dict) -> str:
    """Markdown: a row a room, and all together."""
    rooms = rooms_of(document)
    rooms["**core**"] = [sum(column) for column in zip(*rooms.values(), strict=True)]
    lines = ["| room | branches | taken | share | lines |", "|---|---|---|---|---|"]
    for room, (branches, taken, statements, run) in rooms.items():
        lines.append(f"| {room} | {branches} | {taken} | {taken / branches:.2%} | {run / statements:.2%} |")
    return "\n".join(lines).replace("%", " %") + "\n"


def commit() -> str:
    command = ["git", "rev-parse", "--short=7", "HEAD"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.strip() or "no commit"


def write(rows: str) -> None:
    """Put the table, the date and the commit into the page, and the figure into the declaration."""
    share = rows.rstrip().splitlines()[-1].split("|")[4].strip()
    declaration = TOLD.sub(f"{share} of the branches of the core", DECLARATION.read_text(encoding="utf-8"))
    DECLARATION.write_text(declaration, encoding="utf-8")
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    python = ".".join(map(str, sys.version_info[:2]))
    told = f"Measured on {datetime.date.today().isoformat()} at commit {commit()} with Python {python}:\n"
    PAGE.write_text(f"{before}{BEGIN}\n{told}\n{rows}\n{END}{after}", encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", action="store_true", help="put table and figure into docs/")
    parser.add_argument("--report", action="store_true", help="the last measurement again; no test runs")
    parser.add_argument(
        "--more", nargs="+", default=[], metavar="FILE", help="tests that are added to the last ones"
    )
    args, rest = parser.parse_known_args()
    status = 0 if args.report else measured(rest, args.more)
    coverage("html", "--quiet", "--directory", str(FOLDER))
    coverage("json", "--quiet", "-o", str(FOLDER / "core.json"))
    rows = table(json.loads((FOLDER / "core.json").read_text(encoding="utf-8")))
    print(rows, end="")
    if args.write:
        write(rows)
    print(f"make coverage: {FOLDER.relative_to(ROOT) / 'index.html'}")
    return status


if __name__ == "__main__":
    sys.exit(main())
