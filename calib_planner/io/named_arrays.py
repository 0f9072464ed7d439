# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Arrays under names as raw lines: NPY, NPZ, MAT and JSON.

All four hold arrays with a row per visit, some with names. An array of one column is a column of that name. One
of several columns is named by what it is: joints and points are told by its name (``q``, ``joints``,
``points``, …) and its columns are numbered; a single array without a telling name is a table without a header.
"""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.errors import FileFormatError
from calib_planner.io.mat import check_elements
from calib_planner.io.text import RawLines
from calib_planner.units import listed

JOINTS = re.compile(
    r"q|q_?(meas|act)\w*|thetas?|joints?|joint_?\w*|angles?|configurations?|positions?_joints?", re.I
)
"""Names of arrays of joint values."""
DEVIATIONS = re.compile(r"(std|sigma|uncertainty)_?\w*|\w+_(std|sigma)", re.I)
"""Names of arrays of standard deviations of points."""
POINTS = re.compile(
    r"p|xyz|points?|targets?|reflectors?|measured\w*|tracker\w*|positions?|(points?|p|xyz)_?\w+", re.I
)
"""Names of arrays of points."""
MOST_VALUES = 20_000_000


def read_npy(path: str | Path, data: bytes) -> RawLines:
    """One array: structured, or a table without a header."""
    array = _loaded(path, lambda: np.load(io.BytesIO(data), allow_pickle=False), "NPY")
    if array.dtype.names:
        return _lines(path, {n: array[n] for n in array.dtype.names}, "NPY")
    return _lines(path, {"": array}, "NPY")


def read_npz(path: str | Path, data: bytes) -> RawLines:
    """Arrays under names."""

    def load() -> dict[str, Any]:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}

    return _lines(path, _loaded(path, load, "NPZ"), "NPZ")


def read_mat(path: str | Path, data: bytes) -> RawLines:
    """Variables of a MATLAB file up to version 7, also the fields of one struct."""
    from scipy.io import loadmat  # 0.1 s, which other files do not pay for

    def load() -> Any:
        check_elements(data)
        return loadmat(io.BytesIO(data), squeeze_me=False, struct_as_record=True)

    variables = _loaded(path, load, "MAT")
    arrays: dict[str, Any] = {}
    for name, value in variables.items():
        if name.startswith("__"):
            continue
        value = np.asarray(value)
        if value.dtype.names and value.size == 1:
            arrays |= {n: value[n].ravel()[0] for n in value.dtype.names}
        elif value.dtype.names:
            arrays |= {n: _stacked(value[n].ravel().tolist()) for n in value.dtype.names}
        elif value.dtype.kind in "iufbU":
            arrays[name] = value
    if not arrays and any(k.startswith("__function") for k in variables):
        advice = "save table2array(…) of it, or writetable as CSV"
        raise FileFormatError(path, "file", "a MATLAB table or object", "numeric arrays", advice)
    return _lines(path, arrays, "MAT")


def read_json(path: str | Path, text: str) -> RawLines:
    """Records, rows, or arrays under names; ``units`` beside them says the units."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        try:
            document = [json.loads(line) for line in text.splitlines() if line.strip()]
        except (ValueError, RecursionError):
            advice = "write a list of records or an object of arrays"
            raise FileFormatError(path, "file", str(error)[:200], "JSON", advice) from None
    units: dict[str, str] = {}
    if isinstance(document, dict):
        said = document.pop("units", {})
        if isinstance(said, (str, list)):
            text = said if isinstance(said, str) else " ".join(map(str, said))
            said = {word: word for word in re.split(r"[\s,]+", text)}
        if isinstance(said, dict):
            units = {str(k): str(v) for k, v in said.items()}
        inner = [k for k, v in document.items() if _is_records(v)]
        if isinstance(document.get("columns"), list) and isinstance(document.get("data"), list):
            document = [dict(zip(map(str, document["columns"]), row, strict=False)) for row in document["data"]]
        elif len(inner) == 1:
            document = document[inner[0]]
        else:
            document = {k: v for k, v in document.items() if isinstance(v, (list, dict))}
    if isinstance(document, list) and document and all(isinstance(row, dict) for row in document):
        keys = list(dict.fromkeys(k for row in document for k in row))
        document = {k: _records(path, k, document) for k in keys}
    elif isinstance(document, list):
        document = {"": document}
    elif isinstance(document, dict):  # pandas: {column: {row: value}}
        document = {k: list(v.values()) if isinstance(v, dict) else v for k, v in document.items()}
    else:
        advice = "write a list of records or an object of arrays"
        raise FileFormatError(path, "file", f"JSON with a {type(document).__name__}", "a table", advice)
    return _lines(path, {k: _stacked(v) for k, v in document.items()}, "JSON", units)


def _is_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def _records(path: str | Path, key: str, rows: Sequence[Mapping[str, Any]]) -> list[Any]:
    """What the records say under ``key``; a point may be an object with x, y and z, or absent."""
    values = [row.get(key) for row in rows]
    if any(isinstance(v, dict) for v in values):
        inner = list(dict.fromkeys(k for v in values if isinstance(v, dict) for k in v))
        return [[v.get(k) for k in inner] if isinstance(v, dict) else [None] * len(inner) for v in values]
    sizes: set[tuple[int, ...]]
    try:
        sizes = {np.shape(v) for v in values if isinstance(v, list)}
    except ValueError:  # lists of different lengths within one record
        sizes = {(), (1,)}
    if len(sizes) > 1:
        got = f"{key!r} of different lengths"
        raise FileFormatError(
            path, "records", got, "as many numbers in every record", "use null where nothing is"
        )
    if sizes:
        (shape,) = sizes
        return [np.full(shape, math.nan).tolist() if v is None else v for v in values]
    return values


def _stacked(values: Any) -> Any:
    """Lists as an array of numbers, ``None`` as NaN; of texts as an array of texts."""
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError):
        pass
    try:
        if isinstance(values, list) and values and isinstance(values[0], np.ndarray):
            return np.array([v.ravel() for v in values])
        return np.array(["" if v is None else v for v in values])
    except (TypeError, ValueError):
        return np.array([], object)


def _loaded(path: str | Path, load: Any, kind: str) -> Any:
    try:
        return load()
    except Exception as error:  # NumPy, zipfile and SciPy raise many kinds on damaged files
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        advice = "save arrays of numbers, without objects" if "pickle" in reason else "save it again"
        raise FileFormatError(path, "file", reason, f"a sound {kind} file", advice) from None


def _lines(
    path: str | Path, arrays: Mapping[str, Any], kind: str, units: Mapping[str, str] | None = None
) -> RawLines:
    """Rows of all arrays that have as many rows as most values have, a header line first if there are names."""
    usable = {n: np.asarray(a) for n, a in arrays.items()}
    usable = {n: _flat(a) for n, a in usable.items() if a.dtype.kind in "iufbUS" and a.size}
    if not usable:
        names = listed(arrays, 10) or "nothing"
        raise FileFormatError(path, "variables", names, "arrays of numbers with a row per visit", "save those")
    if sum(a.size for a in usable.values()) > MOST_VALUES:
        raise FileFormatError(path, "variables", "more numbers", f"at most {MOST_VALUES}", "split the file")
    count = _row_count(list(usable.values()), by_rows=kind == "JSON")
    taken: dict[str, Any] = {}
    for name, array in usable.items():
        if len(array) == count:
            taken[name] = array
        elif array.shape[1] == count and array.dtype.kind != "U":
            taken[name] = array.T
        elif JOINTS.fullmatch(name) or POINTS.fullmatch(name):
            got = f"{name}: {len(array)} rows"
            raise FileFormatError(path, "variables", got, f"{count} rows, as the others", "save as many of each")
    if len(taken) == 1:  # nothing beside it says which part of it is what
        taken = {"" if a.shape[1] > 1 else n: a for n, a in taken.items()}
    header: list[str] = []
    for name, array in taken.items():
        header += _column_names(name, array.shape[1])
    columns = [c for a in taken.values() for c in np.asarray(a).T.tolist()]
    rows = ["\t".join(map(_text, row)) for row in zip(*columns, strict=True)]
    named = any(header)
    where = f"{kind}, {'variables' if len(taken) > 1 else 'variable'} {listed(taken, 8)}" if any(taken) else kind
    texts = ["\t".join(header), *rows] if named else rows
    return RawLines(str(path), where, texts, "row", "\t", dict(units or {}), 0 if named else 1)


def _flat(array: Any) -> Any:
    """(rows, columns) of any array: one dimension is a column, and more than two are flattened behind the
    first."""
    if array.ndim < 2:
        return array.reshape(-1, 1)
    return array.reshape(len(array), -1)


def _row_count(arrays: Sequence[Any], *, by_rows: bool) -> int:
    """How many visits the arrays hold: the size that most of them share, along whichever of their two axes.

    Of sizes that as many share, the larger one; for ``by_rows`` the one of the first axis, as for a single array.
    """
    if len(arrays) == 1:
        return len(arrays[0])
    sizes = [size for a in arrays for size in {*a.shape}]
    first = [len(a) for a in arrays]
    return max({*sizes}, key=lambda k: (sizes.count(k), first.count(k) if by_rows else 0, k))


def _column_names(name: str, width: int) -> list[str]:
    if not name:
        return [""] * width
    if width == 1:
        return [name]
    if DEVIATIONS.fullmatch(name) and width % 3 == 0:
        return [f"std_{a}{t}" for t in range(1, width // 3 + 1) for a in "xyz"]
    if POINTS.fullmatch(name) and width % 3 == 0 and not JOINTS.fullmatch(name):
        one = re.fullmatch(r"\D+(\d+)", name)
        targets = [int(one[1])] if one and width == 3 else range(1, width // 3 + 1)
        return [f"{a}{t}" for t in targets for a in "xyz"]
    if JOINTS.fullmatch(name):
        return [f"q{i}" for i in range(1, width + 1)]
    return [f"{name}_{i}" for i in range(1, width + 1)]


def _text(value: Any) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return " ".join(str(value).split())
