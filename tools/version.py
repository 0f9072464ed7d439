# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The version of both packages, in every file that states it.

    python tools/version.py            print it; status 1 and the files if they do not agree
    python tools/version.py 1.0.0      write it everywhere, and make the changelog's "Unreleased" that release

docs/conf.py takes it from the library. ``test/test_packaging.py`` asks the same question as the first line.
"""

from __future__ import annotations

import re
import sys
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VERSION = r"\d+\.\d+\.\d+"
PLACES = {
    "calib_planner/__init__.py": rf'^__version__ = "({VERSION})"$',
    "setup.py": rf'^    version="({VERSION})",$',
    "package.xml": rf"^  <version>({VERSION})</version>$",
    "msg_defs/package.xml": rf"^  <version>({VERSION})</version>$",
    "CITATION.cff": rf"^version: ({VERSION})$",
}
"""File → the line that states the version, as a pattern with one group."""
CHANGELOG = "CHANGELOG.md"
HEADING = re.compile(rf"^## ({VERSION}) \(\d{{4}}-\d\d-\d\d\)$", re.MULTILINE)
UNRELEASED = "## Unreleased\n"


def versions(root: Path = ROOT) -> dict[str, str]:
    """File → the version that it states, an empty text where it states none or several.

    The changelog states the version of its newest release; it is left out while it has none.
    """
    stated = {}
    for name, pattern in PLACES.items():
        matches = re.findall(pattern, (root / name).read_text(encoding="utf-8"), re.MULTILINE)
        stated[name] = matches[0] if len(matches) == 1 else ""
    release = HEADING.search((root / CHANGELOG).read_text(encoding="utf-8"))
    return stated | ({CHANGELOG: release[1]} if release else {})


def write(version: str, day: date, root: Path = ROOT) -> None:
    """Write the version everywhere, and name the changelog's unreleased changes after it."""
    for name, pattern in PLACES.items():
        path = root / name
        text = path.read_text(encoding="utf-8")
        found = re.search(pattern, text, re.MULTILINE)
        if found is None:
            sys.exit(f"{name} states no version; expected a line like {pattern}")
        path.write_text(text[: found.start(1)] + version + text[found.end(1) :], encoding="utf-8")
    path = root / CHANGELOG
    text = path.read_text(encoding="utf-8")
    if UNRELEASED not in text:
        sys.exit(f"{CHANGELOG} has no heading {UNRELEASED.strip()!r}: nothing to release")
    path.write_text(text.replace(UNRELEASED, f"## {version} ({day.isoformat()})\n", 1), encoding="utf-8")


def main() -> int:
    """Print or write; see the top of the file."""
    if len(sys.argv) > 1:
        if not re.fullmatch(VERSION, sys.argv[1]):
            sys.exit(f"{sys.argv[1]!r} is no version; expected three numbers, such as 1.0.0")
        write(sys.argv[1], date.today())
    stated = versions()
    if len(set(stated.values())) > 1 or "" in stated.values():
        print("\n".join(f"{name}: {version or 'none'}" for name, version in stated.items()))
        return 1
    print(next(iter(stated.values())))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
