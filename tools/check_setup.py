# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Say what is missing in this environment, one line each; exit status 1 if anything is.

``make setup`` asks before it says "ready". The stamps that it keeps tell what was done once, not that it is still
there: a package may have been taken away since, or a folder emptied.

    python tools/check_setup.py ROOT [REQUIREMENTS…]

Every name in the requirements files has to be installed, in the pinned version where there is one. The library,
its interfaces and rclpy have to be importable, the library from ROOT.
"""

import importlib
import re
import sys
from importlib.metadata import Distribution, distributions
from pathlib import Path

LINE = re.compile(r"([A-Za-z0-9][\w.-]*)(?:\[.*\])?(?:==([^\s;]+))?")
MODULES = ("numpy", "scipy", "yaml", "rclpy", "calib_planner_msgs.msg", "calib_planner")


def normal(name: str) -> str:
    """The name as the package index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def whole(distribution: Distribution) -> bool:
    """Whether the files and folders that the package put side by side are still there."""
    record = distribution.read_text("RECORD") or ""
    tops = {line.split(",")[0].split("/")[0].strip('"') for line in record.splitlines()} - {"..", ""}
    return all(Path(str(distribution.locate_file(top))).exists() for top in tops if top != "__pycache__")


def missing_packages(files: list[str]) -> list[str]:
    """Requirements that are not installed."""
    present = {normal(d.metadata["Name"]): d.version for d in distributions() if d.metadata["Name"] and whole(d)}
    wanted = [LINE.match(line) for file in files for line in Path(file).read_text().splitlines()]
    return [
        f"{match[1]} {match[2] or ''} is not installed".replace("  ", " ")
        for match in wanted
        if match and (normal(match[1]) not in present or (match[2] and present[normal(match[1])] != match[2]))
    ]


def missing_modules(root: str) -> list[str]:
    """Modules that cannot be imported, and why."""
    found = []
    for name in MODULES:
        try:
            module = importlib.import_module(name)
        except Exception as error:  # whatever it is, the set-up is not ready
            found.append(f"import {name}: {error}")
            continue
        where = Path(module.__file__ or "").resolve()
        if name == "calib_planner" and Path(root).resolve() not in where.parents:
            found.append(f"calib_planner comes from {where.parent}, not from this folder")
    return found


if __name__ == "__main__":
    missing = [*missing_packages(sys.argv[2:]), *missing_modules(sys.argv[1])]
    print("\n".join(missing))
    sys.exit(bool(missing))
