"""Plan sheets as CSV and YAML, exact to the bit.

The CSV has a row per stop. Joint columns bear the joints' own names and are in rad or m, and there is a column
``repetitions``: whatever reads a plan from a CSV reads the sheet. ``<joint>_deg`` and ``<joint>_mm`` repeat them
for people. Empty cells are not known; ``not checked`` says so. The YAML holds ``PlanSheet.to_dict``.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

from calib_planner.design.plan_sheet import PlanSheet
from calib_planner.errors import InputError
from calib_planner.files.configurations_csv import REPETITIONS
from calib_planner.files.document import write_document
from calib_planner.files.text import write_text

WORDS = {True: "yes", False: "no", None: "not checked"}


def write_sheet_yaml(path: str | Path, sheet: PlanSheet, field: str = "output") -> None:
    """Write the whole sheet [rad | m | s]; numbers not known are ``.nan``, what was not checked is ``null``.

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    write_document(path, "plan_sheet", sheet.to_dict(), field)


def write_sheet_csv(path: str | Path, sheet: PlanSheet, field: str = "output") -> None:
    """Write the stops.

    Raises:
        InputError: The path cannot be written; or a joint has the name of another column.
    """
    write_text(path, sheet_csv(sheet), field)


def sheet_csv(sheet: PlanSheet) -> str:
    """The text of ``write_sheet_csv``."""
    rows = [_row(sheet, i, stop) for i, stop in enumerate(sheet.to_dict()["stops"])]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(rows[0])
    writer.writerows([_cell(value) for value in row.values()] for row in rows)
    return out.getvalue()


def _row(sheet: PlanSheet, i: int, stop: dict[str, Any]) -> dict[str, Any]:
    """Column name to value, in order; ``stop`` is the i-th of ``to_dict``."""
    plan, sight, times = sheet.plan, sheet.checks.sight, sheet.timetable
    turns = sheet.robot.joint_is_revolute
    row: dict[str, Any] = {"order": stop["order"], "configuration_index": stop["configuration_index"]}

    def put(name: str, value: Any) -> None:
        if name in row:
            raise InputError("joint names", name, "names that are not those of other columns of the sheet")
        row[name] = value

    for name, value in stop["joints"].items():
        put(name, value)
    for name, value, turning in zip(plan.joint_names, sheet.degrees[i], turns, strict=True):
        put(f"{name}_{'deg' if turning else 'mm'}", value)
    put(REPETITIONS, stop["repetitions"])
    for turning, unit in ((True, "rad"), (False, "m")):
        if (turns == turning).any():
            put(f"travel_max_{unit}", sheet.total_travel(True, turning)[i])
            put(f"travel_sum_{unit}", sheet.total_travel(False, turning)[i])
    put("margin", stop["margin"])
    put("margin_joint", stop["margin_joint"])
    put("reachable", WORDS[stop["reachable"]])
    put("visible", WORDS[stop["visible"]])
    put("breaks", "; ".join(" ".join(name.split()) for name in stop["breaks"]))
    for t in range(len(sheet.robot.targets)):
        put(f"range{t + 1}_m", sight.ranges[i, t])
        put(f"elevation{t + 1}_rad", sight.elevations[i, t])
        put(f"incidence{t + 1}_rad", sight.incidences[i, t])
    put("arrive_s", times.arrive[i])
    put("leave_s", times.leave[i])
    return row


def _cell(value: Any) -> str:
    """Numbers exact to the bit; NaN is an empty cell."""
    if isinstance(value, (str, int)):
        return str(value)
    return "" if math.isnan(value) else repr(float(value))
