# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What kind of file a table is: told by its first bytes, since names lie; and what to do about kinds that are
none.

A file is text unless its first bytes say otherwise. Each kind that can be read becomes *raw lines*: texts whose
cells one separator parts, so that everything behind this file is written once, for all kinds.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

from calib_planner.errors import FileFormatError
from calib_planner.io.named_arrays import read_json, read_mat, read_npy, read_npz
from calib_planner.io.text import RawLines, decode_any, read_bytes, user_path
from calib_planner.io.xlsx import read_xlsx

LINE_END = re.compile(r"\r\n|\r|\n")
TABLE = "a table as text (CSV), XLSX, MAT, NPY, NPZ or JSON"


REFUSED: tuple[tuple[bytes, str, str], ...] = (
    (b"\xd0\xcf\x11\xe0", "an old Excel file (.xls)", "save it as .xlsx or CSV"),
    (b"\x89HDF", "HDF5, as MATLAB writes with -v7.3", "save it with save(…, '-v7')"),
    (b"MATLAB 7.3", "a MATLAB 7.3 file", "save it with save(…, '-v7')"),
    (b"#ROSBAG V", "a ROS 1 bag", "convert it with rosbags-convert"),
    (b"SQLite format 3", "an SQLite file", "name it .db3 if it is a bag"),
    (b"\x89MCAP", "an MCAP file", "name it .mcap if it is a bag"),
    (b"%PDF", "a PDF", "export the table as CSV"),
    (b"\x89PNG", "a PNG picture", "export the table as CSV"),
    (b"\xff\xd8\xff", "a JPEG picture", "export the table as CSV"),
    (b"PAR1", "a Parquet file", "export the table as CSV"),
    (b"\x1f\x8b", "a gzip archive", "unpack it"),
    (b"7z\xbc\xaf", "a 7z archive", "unpack it"),
    (b"\x80\x04", "a Python pickle", "save it with numpy.savez or as CSV"),
    (b"\x80\x05", "a Python pickle", "save it with numpy.savez or as CSV"),
    (b"{\\rtf", "an RTF document", "save it as plain text or CSV"),
    (b"<!DOCTYPE html", "a web page (HTML)", "download the table itself"),
    (b"<html", "a web page (HTML)", "download the table itself"),
    (b"<?xml", "XML", "export the table as CSV"),
    (b"<robot", "a robot description (URDF)", "give it as --robot, and the measured points here"),
)
"""First bytes → what the file is, and the one thing to do."""


READERS: tuple[tuple[Callable[[bytes], bool], Callable[[str | Path, bytes, str], RawLines]], ...] = (
    (lambda data: _archive_with(data, b"[Content_Types].xml", b"xl/workbook"), read_xlsx),
    (lambda data: _archive_with(data, b".npy"), lambda path, data, what: read_npz(path, data)),
    (lambda data: data.startswith(b"\x93NUMPY"), lambda path, data, what: read_npy(path, data)),
    (lambda data: data.startswith(b"MATLAB 5.0"), lambda path, data, what: read_mat(path, data)),
)
"""Kinds of binary files: whether a file is one, and what makes raw lines of its path, its bytes and the word for
what it should hold. The first that says yes reads the file."""


def raw_lines(path: str | Path, what: str) -> RawLines:
    """Read a file of any kind that holds a table.

    Raises:
        FileFormatError: Not readable, or of a kind that holds no table; names the kind and what to do.
        MissingExtraError: Reading this kind needs a package that is not installed.
    """
    data = read_bytes(path, what)
    start = data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith(b"<?xml") and b"<robot" in data[:4096]:
        start = b"<robot"
    for magic, kind, advice in REFUSED:
        marked = magic[:1] in b"<{"  # text, in which blanks and capitals do not count
        if start.lower().startswith(magic.lower()) if marked else data.startswith(magic):
            raise FileFormatError(path, "file", kind, f"{what}: {TABLE}", advice)
    for recognises, read in READERS:
        if recognises(data):
            return read(path, data, what)
    if _archive_with(data, b"opendocument"):
        raise FileFormatError(
            path, "file", "an OpenDocument file (.ods)", f"{what}: {TABLE}", "save it as .xlsx or CSV"
        )
    if _is_archive(data):
        raise FileFormatError(path, "file", "a ZIP archive", f"{what}: {TABLE}", "unpack it")
    text, encoding = decode_any(path, what, data)
    suffix = user_path(path).suffix.lower()
    if suffix in (".yaml", ".yml"):
        raise FileFormatError(path, "file", "a YAML file", f"{what}: {TABLE}", "give the measured table")
    if suffix in (".json", ".jsonl", ".ndjson") or _is_json(text):
        return read_json(path, text)
    lines = text.split("\n") if "\r" not in text else LINE_END.split(text)
    return RawLines(str(path), "text" if encoding == "UTF-8" else f"text in {encoding}", lines)


def _is_json(text: str) -> bool:
    if not text.lstrip().startswith(("{", "[")):
        return False
    try:
        json.loads(text)
    except (ValueError, RecursionError):
        return False
    return True


def _is_archive(data: bytes) -> bool:
    """Whether a file is a ZIP archive inside."""
    return data.startswith(b"PK\x03\x04")


def _archive_with(data: bytes, *parts: bytes) -> bool:
    """Whether it is one with a file whose name holds one of these; names stand at its start and at its end."""
    return _is_archive(data) and any(part in data[: 1 << 16] or part in data[-(1 << 16) :] for part in parts)
