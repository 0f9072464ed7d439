# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The examples of a Markdown page, run in their order as one shell session in a folder that is like a checkout.

    ```bash run        commands that a reader can copy: every one must succeed
    ```python          a script of its own, in the same folder
    ```text output     lines that the example before must have printed; runs of blanks count as one, … is any text
    <!-- not run: why -->   before a block that needs what only the reader has
    <!-- file: name -->     before a file for the reader's cell, which has a test of its own

Files that examples write stay for those that follow. ``env.sh`` is empty there: the environment is the test's.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(
    r"(?P<mark><!-- (?:not run|file): [^>]+ -->\n)?^```(?P<info>[^\n`]*)\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)
BORDER = "@@ example"
COPIED = ("docs/examples", "config")


@dataclass(frozen=True)
class Example:
    """A block of a page: what it is (``bash run``, ``python``, ``text output``, …) and its text."""

    kind: str
    text: str
    line: int


@dataclass(frozen=True)
class Run:
    """What came of a page: exit status, what each example printed, and the end of stderr."""

    status: int
    printed: list[str]
    errors: str


def blocks(page: Path) -> list[Example]:
    """All fenced blocks of a page that are not marked as not run."""
    text = page.read_text(encoding="utf-8")
    found = (m for m in BLOCK.finditer(text) if not m["mark"])
    return [Example(m["info"].strip(), m["text"], text.count("\n", 0, m.start()) + 1) for m in found]


def examples(page: Path) -> list[Example]:
    """The blocks that run."""
    return [e for e in blocks(page) if e.kind in ("bash run", "python")]


def expectations(page: Path) -> list[tuple[int, str]]:
    """(number of the example, line that it must have printed)."""
    found, number = [], -1
    for block in blocks(page):
        number += block.kind in ("bash run", "python")
        if block.kind == "text output":
            found += [(number, line) for line in block.text.splitlines() if line.strip(" …")]
    return found


def said(line: str, printed: str) -> bool:
    """Whether ``printed`` has the line, … standing for anything."""
    pattern = ".*".join(re.escape(" ".join(part.split())) for part in line.split("…"))
    return any(re.search(pattern, " ".join(row.split())) for row in printed.splitlines())


def run(
    page: Path, folder: Path, timeout: float = 240.0, programs: Path | None = None, shell: str = "bash"
) -> Run:
    """Run the examples of ``page`` in ``folder``; ends at the first that fails.

    ``programs``: a folder that comes first in PATH. ``shell``: ``bash`` or ``zsh``.
    """
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name)
    (folder / "env.sh").write_text("")
    scripts = folder / ".scripts"
    scripts.mkdir()
    lines = ["set -euo pipefail"]
    for example in examples(page):
        lines.append(f"echo; echo '{BORDER}'")
        if example.kind == "python":
            script = scripts / f"line_{example.line}.py"
            script.write_text(example.text, encoding="utf-8")
            lines.append(f"python {script}")
        else:
            lines.append(example.text)
    done = subprocess.run(
        [shell, "-c", "\n".join(lines)],
        cwd=folder,
        env=environment(programs),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    return Run(done.returncode, done.stdout.split(f"\n{BORDER}\n")[1:], done.stderr[-3000:])


def environment(programs: Path | None = None) -> dict[str, str]:
    """``programs`` and this interpreter's commands first, one thread, no colours."""
    first = [] if programs is None else [str(programs)]
    path = os.pathsep.join([*first, str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    return {**os.environ, "PATH": path, "OMP_NUM_THREADS": "1", "NO_COLOR": "1"}
