# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The two lines about copyright and licence at the top of every source file.

    python tools/headers.py            print the files without them; status 1 if there are any
    python tools/headers.py --write    put them there

They are the form of the SPDX standard, which REUSE, Debian and companies' scanners read. The linter
``ament_copyright`` (0.17) knows only the thirteen lines of the Apache header; ``package.xml`` does not name it.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINES = ("Copyright 2026 calib_planner contributors", "SPDX-License-Identifier: Apache-2.0")
COMMENTS = {".py": "# {}\n", ".sh": "# {}\n", ".c": "/* {} */\n"}
"""Suffix → how a line of comment is written. Interfaces have no header, since their first comment is what
``ros2 interface show`` and the reference page begin with; nor has what is copied into pages that users pass on
(templates, styles, scripts), nor pages, tables and settings."""


def comment(path: Path) -> str:
    """How the file writes a line of comment; empty if it has no header."""
    return COMMENTS.get(path.suffix, "")


def sources(root: Path = ROOT) -> list[Path]:
    """Files that need a header: those under version control, or about to be, of the suffixes above."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"],
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    paths = [root / name for name in listed.stdout.split("\0") if name]
    return sorted(p for p in paths if comment(p) and p.is_file() and p.stat().st_size)


def with_header(path: Path, text: str) -> str:
    """The text with the header, behind ``#!`` if that is the first line; as it is where the header is there."""
    header = "".join(comment(path).format(line) for line in LINES)
    first, rest = "", text
    if text.startswith("#!"):
        end = text.find("\n") + 1 or len(text)
        first, rest = text[:end], text[end:]
    return text if rest.startswith(header) else first + header + rest


def main() -> int:
    """Print or write; see the top of the file."""
    without = []
    for path in sources():
        text = path.read_text(encoding="utf-8")
        if (headed := with_header(path, text)) != text:
            without.append(path)
            if "--write" in sys.argv[1:]:
                path.write_text(headed, encoding="utf-8")
    if "--write" in sys.argv[1:]:
        print(f"{len(without)} files got the header")
        return 0
    print("\n".join(str(path.relative_to(ROOT)) for path in without))
    return int(bool(without))


if __name__ == "__main__":
    raise SystemExit(main())
