# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements laid out as people have them: one table of layouts, and the writer that makes a file of each."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner import Measurements
from calib_planner.io import parse_urdf
from calib_planner.units import ANGLES, LENGTHS

ORIGINS = ("0 0 0.4", "0.1 0 0.1", "0 0 0.6", "0.1 0 0.1", "0.5 0 0", "0.08 0 0")
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
URDF = '<robot name="arm"><link name="l0"/>' + "".join(
    f'<link name="l{i}"/><joint name="j{i}" type="revolute"><origin xyz="{o}"/><parent link="l{i - 1}"/>'
    f'<child link="l{i}"/><axis xyz="{a}"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
    for i, (o, a) in enumerate(zip(ORIGINS, AXES, strict=True), 1)
)
ROBOT = parse_urdf(URDF + "</robot>", "arm.urdf").with_targets([[0.06, 0, 0.03], [-0.05, 0.04, 0.03]])
_RNG = np.random.default_rng(0)
_Q = _RNG.uniform(-1.6, 1.6, (24, 6))
_P = ROBOT.positions(_Q) + np.array([2.0, 0.5, 0.3])
DATA = Measurements(ROBOT.joint_names, _Q, _P, _RNG.uniform(1e-5, 5e-5, _P.shape), _RNG.integers(0, 9, 24))
"""Two reflectors on an arm of six joints, at 24 visits, before a tracker some metres away."""

BRACKETS = {
    "": "{0}",
    "square": "{0} [{1}]",
    "round": "{0} ({1})",
    "suffix": "{0}_{1}",
    "slash": "{0}/{1}",
    "in": "{0} in {1}",
}
"""How a unit stands with a name."""


@dataclass(frozen=True)
class Layout:
    """How a file looks.

    Attributes:
        separator, decimal, line_end, encoding: Of the text.
        names: Names of the joints with ``{}`` for the number; empty: the robot's own.
        first: Number of the first joint in these.
        points: Names of coordinates with ``{a}``, ``{A}`` for the axis and ``{t}`` for the target.
        header: Whether there is one; ``#`` puts it into a comment.
        written: How units stand with the names: a key of ``BRACKETS``, or ``row`` for a line of their own.
        angle, length: Units of the numbers.
        titles: Lines above the header.
        first_line: What stands above everything.
        quoted: Whether every cell is in quotes.
        counted: Whether a column in front counts the rows, and its name.
        trailing: Whether each line ends with a separator.
        order: How the columns are put: ``points`` first, ``mixed``, or as they are.
        more: Names of further columns, which hold 1.
        sliding: Names of joints that slide.
        std, payload: Whether these are there.
        kind: ``text``, ``xlsx``, ``npy``, ``npz``, ``mat``, ``records``, ``arrays``, …
        ending: Of the file's name.
        stated: Fields of ``Reading``.
    """

    separator: str = ","
    decimal: str = "."
    line_end: str = "\n"
    encoding: str = "utf-8"
    names: str = ""
    first: int = 1
    points: str = "{a}{t}"
    header: bool | str = True
    written: str = ""
    angle: str = "rad"
    length: str = "m"
    titles: tuple[str, ...] = ()
    first_line: str = ""
    quoted: bool = False
    counted: str | None = None
    trailing: bool = False
    order: str = ""
    more: tuple[str, ...] = ()
    sliding: tuple[str, ...] = ()
    std: bool = False
    payload: bool = False
    kind: str = "text"
    ending: str = ""
    stated: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Column:
    name: str
    unit: str
    values: np.ndarray


def columns_of(data: Measurements, layout: Layout) -> list[Column]:
    """The columns with their numbers in the layout's units."""
    angle, metre = ANGLES[layout.angle], LENGTHS[layout.length]
    columns = []
    for j, name in enumerate(data.joint_names):
        name = layout.names.format(j + layout.first) if layout.names else name
        unit, factor = (layout.length, metre) if name in layout.sliding else (layout.angle, angle)
        columns.append(Column(name, unit, data.q[:, j] / factor))
    blocks: list[tuple[str, np.ndarray]] = [("", data.p)]
    blocks += [("std_", np.asarray(data.std))] if layout.std else []
    for prefix, block in blocks:
        for t in range(block.shape[1]):
            for a in range(3):
                name = prefix + layout.points.format(a="xyz"[a], A="XYZ"[a], t=t + 1)
                columns.append(Column(name, layout.length, block[:, t, a] / metre))
    if layout.payload:
        columns.append(Column("payload", "kg", np.asarray(data.payload)))
    columns += [Column(name, "", np.ones(len(data))) for name in layout.more]
    if layout.order == "points":
        columns = columns[len(data.joint_names) :] + columns[: len(data.joint_names)]
    elif layout.order == "mixed":
        columns = [columns[i] for i in np.random.default_rng(3).permutation(len(columns))]
    if layout.counted is not None:
        columns.insert(0, Column(layout.counted, "", np.arange(1, len(data) + 1)))
    return columns


def cell(value: float, layout: Layout) -> str:
    if np.isnan(value):
        return ""
    text = repr(int(value)) if float(value).is_integer() and abs(value) < 1e9 else repr(float(value))
    return text.replace(".", layout.decimal)


def line(cells: Sequence[str], layout: Layout) -> str:
    if layout.separator == "columns":  # of a fixed width
        return "".join(f"{c:>26}" for c in cells)
    if layout.quoted:
        text = layout.separator.join(f'"{c}"' for c in cells)
    else:
        out = io.StringIO()
        csv.writer(out, delimiter=layout.separator[0], lineterminator="").writerow(cells)
        text = out.getvalue().replace(layout.separator[0], layout.separator) if len(layout.separator) > 1 else ""
        text = text or (layout.separator.join(cells) if layout.separator == " " else out.getvalue())
    return text + (layout.separator if layout.trailing else "")


def write(folder: Path, data: Measurements, layout: Layout) -> Path:
    """Write ``data`` as the layout says; the file."""
    columns = columns_of(data, layout)
    if layout.kind == "text":
        return _text(folder / f"data{layout.ending or '.csv'}", columns, layout)
    path = folder / f"data{layout.ending or ENDINGS[layout.kind]}"
    if layout.kind == "xlsx":
        return _xlsx(path, columns, layout)
    if layout.kind in ("records", "rows", "lines", "columns_and_data", "pandas"):
        return _json(path, columns, layout)
    return _arrays(path, data, columns, layout)


ENDINGS = {
    "xlsx": ".xlsx",
    "npy": ".npy",
    "structured": ".npy",
    "npz": ".npz",
    "mat": ".mat",
    "mat_columns": ".mat",
    "mat_transposed": ".mat",
    "mat_struct": ".mat",
    "mat_matrix": ".mat",
    "records": ".json",
    "rows": ".json",
    "lines": ".jsonl",
    "columns_and_data": ".json",
    "pandas": ".json",
    "arrays": ".json",
}


def lines_of(columns: list[Column], layout: Layout) -> list[list[str]]:
    """The lines of a table, header and units among them, cell by cell."""
    names = [
        BRACKETS["" if layout.written == "row" or not c.unit else layout.written].format(c.name, c.unit)
        for c in columns
    ]
    rows = [names] if layout.header else []
    if layout.written == "row":
        rows.append([c.unit for c in columns])
    return rows + [[cell(v, layout) for v in row] for row in zip(*(c.values for c in columns), strict=True)]


def _text(path: Path, columns: list[Column], layout: Layout) -> Path:
    rows = [line(cells, layout) for cells in lines_of(columns, layout)]
    if layout.header == "#":
        rows[0] = f"# {rows[0]}"
    rows = [*filter(None, [layout.first_line]), *layout.titles, *rows, ""]
    path.write_bytes(layout.line_end.join(rows).encode(layout.encoding))
    return path


def _xlsx(path: Path, columns: list[Column], layout: Layout) -> Path:
    from openpyxl import Workbook

    book = Workbook()
    sheet = book.active
    for title in layout.titles:
        sheet.append([title])
    header = lines_of([Column(c.name, c.unit, c.values[:0]) for c in columns], layout)
    for cells in header:
        sheet.append(cells)
    for row in zip(*(c.values.tolist() for c in columns), strict=True):
        sheet.append([None if np.isnan(v) else v for v in row])
    book.create_sheet("notes").append(["measured on Monday", 1])
    book.save(path)
    return path


def _json(path: Path, columns: list[Column], layout: Layout) -> Path:
    names = [c.name for c in columns]
    rows = [[None if np.isnan(v) else v for v in row] for row in np.array([c.values for c in columns]).T.tolist()]
    records = [dict(zip(names, row, strict=True)) for row in rows]
    if layout.kind == "lines":
        path.write_text("\n".join(map(json.dumps, records)))
        return path
    document: Any = {
        "records": records,
        "rows": rows,
        "columns_and_data": {"columns": names, "data": rows},
        "pandas": {n: {str(i): row[k] for i, row in enumerate(rows)} for k, n in enumerate(names)},
    }[layout.kind]
    if layout.written:
        document = {"units": {"angle": layout.angle, "length": layout.length}, "measurements": document}
    path.write_text(json.dumps(document))
    return path


def _arrays(path: Path, data: Measurements, columns: list[Column], layout: Layout) -> Path:
    from scipy.io import savemat

    q = data.q / ANGLES[layout.angle]
    p = data.p / LENGTHS[layout.length]
    table = np.array([c.values for c in columns]).T
    by_column = {c.name: c.values for c in columns}
    if layout.kind == "npy":
        np.save(path, table)
    elif layout.kind == "structured":
        np.save(path, np.array([tuple(r) for r in table.tolist()], [(n, float) for n in by_column]))
    elif layout.kind == "npz":
        np.savez(path, joints=q, points=p)
    elif layout.kind == "arrays":
        document = {"joints": q.tolist(), "points": np.where(np.isnan(p), None, p).tolist()}
        path.write_text(json.dumps(document))
    elif layout.kind == "mat":
        savemat(path, {"q": q, "xyz": p.reshape(len(p), -1)})
    elif layout.kind == "mat_columns":
        savemat(path, by_column)
    elif layout.kind == "mat_transposed":
        savemat(path, {"theta": q.T, "points": p.reshape(len(p), -1).T})
    elif layout.kind == "mat_struct":
        savemat(path, {"measured": {"q": q, "points": p.reshape(len(p), -1), "note": "cell 4"}})
    elif layout.kind == "mat_matrix":
        savemat(path, {"A": table})
    return path


NAMES = "j1 j2 j3 j4 j5 j6 x1 y1 z1 x2 y2 z2"
GERMAN = ("Messprotokoll Zelle 4", "Bediener: Müller", "")
LAYOUTS: dict[str, Layout] = {
    # what ../shared/cases names
    "plain": Layout(),
    "no header": Layout(header=False),
    "spaces, degrees, mm": Layout(separator=" ", header=False, angle="deg", length="mm"),
    "pipes": Layout(separator="|"),
    "title line": Layout(titles=("Measurement report of cell 4",)),
    "units row": Layout(written="row"),
    "centimetres, stated": Layout(length="cm", stated={"units": "cm"}),
    "inches, stated": Layout(length="in", stated={"units": "in,rad"}),
    # text
    "semicolons": Layout(separator=";"),
    "tabs": Layout(separator="\t"),
    "tabs, no header, degrees": Layout(separator="\t", header=False, angle="deg"),
    "comma and blank": Layout(separator=", "),
    "fixed width": Layout(separator="columns", names="J{}", points="{A}{t}"),
    "fixed width, decimal comma": Layout(separator="columns", decimal=",", header=False),
    "German Excel": Layout(separator=";", decimal=",", line_end="\r\n", encoding="utf-8-sig", first_line="sep=;"),
    "German Excel, old": Layout(
        separator=";", decimal=",", written="square", angle="deg", encoding="cp1252", titles=GERMAN
    ),
    "Excel's Unicode text": Layout(separator="\t", encoding="utf-16", line_end="\r\n"),
    "UTF-16 without mark": Layout(encoding="utf-16-le"),
    "old Mac": Layout(line_end="\r"),
    "decimal comma in quotes": Layout(decimal=",", quoted=True),
    "all in quotes": Layout(quoted=True),
    "bar, decimal comma": Layout(separator="|", decimal=",", length="mm"),
    "white space, decimal comma": Layout(separator=" ", decimal=",", header=False, angle="deg", length="mm"),
    "tabs, decimal comma, row of units": Layout(
        separator="\t", decimal=",", written="row", angle="deg", length="mm"
    ),
    "trailing separators": Layout(separator=";", trailing=True),
    "titles, one of them padded": Layout(separator=";", titles=("Report;;;;;;;;;;;", "Cell 4;;;;;;;;;;;")),
    "many titles": Layout(separator=";", titles=tuple(f"setting {i}: on" for i in range(60)), header=False),
    "title with a date": Layout(titles=("2026-11-28, 12:00, cell 4",)),
    "NumPy's savetxt": Layout(separator=" ", header="#"),
    "MATLAB's comment": Layout(separator="\t", titles=("% made by MATLAB", "%"), header=False),
    "pandas with its index": Layout(counted=""),
    "numbered rows": Layout(counted="No"),
    "numbered rows, no header": Layout(counted="", header=False, separator=";"),
    "stated separator": Layout(separator=";", header=False, stated={"separator": "semicolon"}),
    "stated columns": Layout(header=False, order="points", stated={"columns": "x1 y1 z1 x2 y2 z2 j1 … j6"}),
    "stated columns over a foreign header": Layout(
        names="Gelenk{}", points="Wert {a}{t}", stated={"columns": NAMES}
    ),
    "stated columns with units": Layout(
        header=False,
        angle="deg",
        stated={"columns": " ".join(f"{n}[deg]" if n[0] == "j" else n for n in NAMES.split())},
    ),
    # names and units
    "mixed order": Layout(order="mixed"),
    "points first": Layout(order="points"),
    "other columns": Layout(more=("temperature", "operator", "rx", "qd1")),
    "capitals": Layout(names="J{}", points="{A}{t}"),
    "joint_1": Layout(names="joint_{}"),
    "Joint 1, from Excel": Layout(names="Joint {}", separator=";", decimal=","),
    "KUKA": Layout(names="A{}", angle="deg", length="mm", points="{A}{t}"),
    "KUKA's variables": Layout(names="$AXIS_ACT.A{}", angle="deg"),
    "ABB": Layout(names="rax_{}", angle="deg", length="mm"),
    "UR's RTDE": Layout(names="actual_q_{}", first=0, more=("actual_qd_0", "target_q_0", "timestamp")),
    "theta": Layout(names="θ{}", written="square", angle="deg"),
    "axis of joint states": Layout(names="j{}/position"),
    "square brackets": Layout(written="square", angle="deg", length="mm"),
    "round brackets": Layout(written="round", angle="mrad", length="µm"),
    "suffixes": Layout(written="suffix", angle="deg", length="cm"),
    "behind a slash": Layout(written="slash", length="mm"),
    "in words": Layout(written="in", angle="deg", length="in"),
    "feet and gon": Layout(written="square", angle="gon", length="ft"),
    "white space and units": Layout(separator=" ", written="square", length="mm"),
    "by size alone": Layout(angle="deg", length="mm"),
    "degrees by size": Layout(angle="deg"),
    "millimetres by size": Layout(length="mm"),
    "stated millimetres and degrees": Layout(angle="deg", length="mm", stated={"units": "mm,deg"}),
    "points as P1_X": Layout(points="P{t}_{A}"),
    "points as target_1.x": Layout(points="target_{t}.{a}"),
    "points as Measured X 1": Layout(points="Measured {A} {t}", separator=";"),
    "with standard deviations": Layout(std=True),
    "standard deviations in mm": Layout(std=True, written="square", length="mm"),
    "standard deviations by size": Layout(std=True, length="mm", decimal=",", separator=";"),
    "with payload": Layout(payload=True),
    # other kinds of files
    "XLSX": Layout(kind="xlsx"),
    "XLSX, titles and units": Layout(
        kind="xlsx", titles=("Report", "Cell 4"), written="row", angle="deg", length="mm"
    ),
    "XLSX named .csv": Layout(kind="xlsx", ending=".csv"),
    "NPY": Layout(kind="npy"),
    "NPY, degrees and mm": Layout(kind="npy", angle="deg", length="mm"),
    "NPY of records": Layout(kind="structured"),
    "NPZ": Layout(kind="npz"),
    "NPZ, stated": Layout(kind="npz", length="mm", stated={"units": "mm"}),
    "MAT": Layout(kind="mat", angle="deg", length="mm"),
    "MAT, a variable per column": Layout(kind="mat_columns"),
    "MAT, transposed": Layout(kind="mat_transposed"),
    "MAT, a struct": Layout(kind="mat_struct"),
    "MAT, one matrix": Layout(kind="mat_matrix"),
    "JSON, records": Layout(kind="records"),
    "JSON, records with units": Layout(kind="records", written="row", angle="deg", length="mm"),
    "JSON, rows": Layout(kind="rows"),
    "JSON, lines": Layout(kind="lines"),
    "JSON, columns and data": Layout(kind="columns_and_data"),
    "JSON of pandas": Layout(kind="pandas"),
    "JSON, arrays": Layout(kind="arrays"),
}
"""Every one of these holds the same measurements."""
