"""Write docs/reference/ from the code: interfaces, node parameters, command line, codes.

    python tools/reference            # with ROS 2 (source env.sh): the nodes are asked what they offer

A file for each page; a test compares what is committed with what the code says. The page of the Python
interface is not among them: Sphinx makes it from the docstrings.
"""

from __future__ import annotations

import sys
from pathlib import Path

import codes
import command_line
import interfaces
import parameters

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference"
PAGES = {
    "command-line.md": command_line.page,
    "codes.md": codes.page,
    "parameters.md": parameters.page,
    "interfaces.md": interfaces.page,
}
"""Name of the file → what makes its text."""


def main() -> int:
    """Write the pages that changed."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        path, text = FOLDER / name, page()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(f"written: docs/reference/{name}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
