# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Print the exact version of everything pip put into this interpreter's environment.

Run with Python 3.10's environment, whose versions also install on 3.11 and 3.12:
    .venv/bin/python tools/lock.py > requirements/constraints.txt
The ROS wheels carry metadata of packages (rclpy, std_msgs, ...) that pip did not install; these
have no INSTALLER file and are left out, as is the package itself.
"""

from importlib.metadata import distributions

LEFT_OUT = {"pip", "calib-planner", "calib_planner"}

pins = {
    f"{d.metadata['Name']}=={d.version}"
    for d in distributions()
    if d.read_text("INSTALLER") and d.metadata["Name"] not in LEFT_OUT
}
print("# Made by tools/lock.py: exact versions of everything, for Python 3.10, 3.11 and 3.12.")
print("\n".join(sorted(pins, key=str.lower)))
