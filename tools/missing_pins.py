# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Print the pins of a constraints file for packages that this interpreter does not have yet.

Used with a sourced ROS: what the system already provides (numpy above all) must stay as it is.
"""

import re
import sys
from importlib.metadata import distributions
from pathlib import Path


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


present = {normal(d.metadata["Name"]) for d in distributions() if d.metadata["Name"]}
for line in Path(sys.argv[1]).read_text().splitlines():
    if "==" in line and normal(line.split("==")[0]) not in present:
        print(line)
