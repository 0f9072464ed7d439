# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Write docs/reference/ from the code: interfaces, node parameters, command line, codes.

    python tools/reference [FOLDER]

A file for each page; a test compares what is committed with what the code says. Two pages need ROS 2 (source
env.sh), since the nodes are asked what they offer; without it they stay as they are. The page of the Python
interface is not among them: Sphinx makes it from the docstrings.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

import cell
import codes
import command_line
import interfaces
import parameters

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference"
PAGES = {
    "command-line.md": command_line.page,
    "cell.md": cell.page,
    "codes.md": codes.page,
    "parameters.md": parameters.page,
    "interfaces.md": interfaces.page,
}
"""Name of the file → what makes its text."""
WITH_ROS = ("parameters.md", "interfaces.md")
NEEDED = ("rclpy", "calib_planner_msgs")


def main() -> int:
    """Write the pages that changed."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        path = folder / name
        if name in WITH_ROS and any(find_spec(package) is None for package in NEEDED):
            print(f"left as it is, without ROS 2: {path}", file=sys.stderr)
            continue
        text = page()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(f"written: {path}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
