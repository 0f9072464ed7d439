# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of joint configurations and of measurements as CSV, as this package writes them: exact to the bit.

A configuration has a column per joint [rad | m], and ``repetitions`` if that is given. Measurements have the
joint columns, ``x1,y1,z1[,x2…]`` and optionally ``std_x1,…`` [m], and ``payload`` [kg]. Empty cells: the target
was not measured. ``read_data`` and ``read_joints`` read these, and whatever else people have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import check_configurations
from calib_planner.io.columns import PAYLOAD, REPETITIONS, coordinate_names
from calib_planner.io.text import write_text
from calib_planner.measurements import Measurements


def format_table(columns: Sequence[str], rows: Sequence[Sequence[float]]) -> str:
    """CSV text, exact to the bit; NaN becomes an empty cell and whole numbers given as int stay so."""
    lines = [",".join(columns)]
    lines += [",".join("" if math.isnan(v) else repr(v) for v in row) for row in rows]
    return "\n".join(lines) + "\n"


def write_configurations(
    path: str | Path,
    joint_names: tuple[str, ...],
    configurations: ArrayLike,
    repetitions: ArrayLike | None = None,
    field: str = "output",
) -> None:
    """Write configurations [rad | m], exact to the bit, with a ``repetitions`` column if given."""
    rows = check_configurations("configurations", configurations, joint_names).tolist()
    columns = list(joint_names)
    if repetitions is not None:
        columns.append(REPETITIONS)
        counts = np.asarray(repetitions, np.int64).tolist()
        rows = [[*row, k] for row, k in zip(rows, counts, strict=True)]
    write_text(path, format_table(columns, rows), field)


def write_measurements(path: str | Path, data: Measurements, field: str = "output") -> None:
    """Write measurements [rad | m], exact to the bit."""
    write_text(path, measurements_text(data), field)


def measurements_text(data: Measurements) -> str:
    """The text that ``write_measurements`` writes."""
    n, count = data.p.shape[:2]
    blocks = [data.q, data.p.reshape(n, -1)]
    columns = [*data.joint_names, *coordinate_names(count, "")]
    if data.std is not None:
        std = np.where(data.seen[:, :, None], np.asarray(data.std), np.nan)
        blocks.append(std.reshape(n, -1))
        columns += coordinate_names(count, "std_")
    if data.payload is not None and PAYLOAD not in data.joint_names:
        blocks.append(np.asarray(data.payload)[:, None])
        columns.append(PAYLOAD)
    return format_table(columns, np.hstack(blocks).tolist())
