# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The mutants of a file, as cosmic-ray makes them. Runs in an environment of its own, which has cosmic-ray.

python cosmic.py FILE              one JSON line for all mutants: [operator, occurrence, line, column, function]
python cosmic.py FILE < CHOSEN     … and for each line [operator, occurrence] of CHOSEN the source of that mutant
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from cosmic_ray.commands.init import _all_work_items
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator


def main() -> None:
    path = Path(sys.argv[1])
    source = path.read_text(encoding="utf-8")
    items = [m for item in _all_work_items([path], {}) for m in item.mutations]
    print(
        json.dumps([[m.operator_name, m.occurrence, *m.start_pos, m.definition_name or ""] for m in items]),
        flush=True,
    )
    for line in sys.stdin:
        operator, occurrence = json.loads(line)
        print(json.dumps(mutate_code(source, get_operator(operator)(), occurrence)), flush=True)


if __name__ == "__main__":
    main()
