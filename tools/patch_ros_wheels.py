# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Make the ROS wheels' exported CMake files name this environment's folders.

The wheels name the include folders of the machine that built them. Run with the environment's own
python; prints how many files were changed.
"""

import re
import sys
import sysconfig
from pathlib import Path

import numpy

FOLDERS = [
    (
        re.compile(r"/opt/python/cp3\d+-cp3\d+/lib/python3\.\d+/site-packages/numpy/_core/include"),
        numpy.get_include(),
    ),
    (
        re.compile(r"/opt/python/cp3\d+-cp3\d+/include/python3\.\d+"),
        sysconfig.get_paths()["include"],
    ),
]

changed = 0
for path in sorted(Path(sys.prefix, "share").glob("*/cmake/*.cmake")):
    old = text = path.read_text()
    for pattern, folder in FOLDERS:
        text = pattern.sub(lambda _match, folder=folder: folder, text)
    if text != old:
        path.write_text(text)
        changed += 1
print(f"{changed} CMake files patched")
