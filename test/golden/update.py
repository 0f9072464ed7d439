# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Rewrites what the golden tests expect, after an intended change: ``python test/golden/update.py [NAME …]``.

Without names every file, ``nodes`` and ``interfaces`` included. Look at ``git diff test/golden/expected`` before
the commit, and say in its message what changed for users and why.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from cases import CASES, REAL
from doors import doors
from golden import EXPECTED, Inputs, answer, arithmetic, differences, kept, same_arithmetic, store, stored

OTHERS = ("doors", "nodes", "interfaces", "arithmetic")


def main(names: Sequence[str]) -> int:
    """Rewrite the expected files of these names, or of all."""
    known = [*(c.name for c in CASES), *OTHERS]
    if unknown := [name for name in names if name not in known]:
        print(f"update.py: no case {unknown[0]!r}; valid: {', '.join(known)}", file=sys.stderr)
        return 2
    if names and not same_arithmetic():
        print(
            "update.py: this machine's last digits are not those of expected/: rewrite all of it", file=sys.stderr
        )
        return 1
    with tempfile.TemporaryDirectory() as folder:
        inputs = Inputs(_made(Path(folder) / "inputs"))
        for case in CASES:
            if names and case.name not in names:
                continue
            if case.real and not REAL.is_dir():
                print(f"{case.name}: left as it is, no measured data in {REAL}")
                continue
            _write(case.name, kept(answer(case, inputs, _made(Path(folder) / case.name))))
    if not names:
        for path in EXPECTED.glob("*.json"):
            if path.stem not in known:
                path.unlink()
    if not names:
        _write("arithmetic", arithmetic())
    if not names or "doors" in names:
        _write("doors", doors())
    if not names or "interfaces" in names:
        from surface import interfaces

        _write("interfaces", interfaces())
    if not names or "nodes" in names:
        from surface import settled_nodes

        _write("nodes", settled_nodes())
    return 0


def _write(name: str, value: object) -> None:
    changed = not (EXPECTED / f"{name}.json").exists() or list(differences(stored(name), value))
    store(name, value)
    if changed:
        print(f"{name}: changed")


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
