# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""MATLAB files: what SciPy writes passes the check of elements; what its reader would not survive does not."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat
from scipy.sparse import eye

from calib_planner import FileFormatError, Robot
from calib_planner.io import read_data
from calib_planner.io.mat import check_elements

HEAD = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
DOUBLE, CHAR, CELL, STRUCT = 6, 4, 1, 2


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def array(flags: int, sizes: tuple[int, ...], *parts: bytes) -> bytes:
    head = element(6, struct.pack("<II", flags, 0)) + element(5, struct.pack(f"<{len(sizes)}i", *sizes))
    return element(14, head + element(1, b"q") + b"".join(parts))


NUMBER = element(9, struct.pack("<d", 1.5))
SOUND = array(DOUBLE, (1, 1), NUMBER)


@pytest.mark.parametrize("packed", [False, True])
def test_what_scipy_writes_passes(packed: bool) -> None:
    values = {
        "matrix": np.arange(6.0).reshape(2, 3),
        "complex": np.array([[1 + 2j]]),
        "bytes": np.int8([[1, 2]]),
        "texts": np.array(["ab", "cde"]),
        "nothing": np.empty((0, 3)),
        "cell": np.array([[np.arange(3), "abc"]], dtype=object),
        "struct": {"x": np.arange(3), "inner": {"y": "text", "z": np.empty((0, 0))}},
        "records": np.array([(1, 2.0), (3, 4.0)], dtype=[("a", "i4"), ("b", "f8")]),
    }
    out = io.BytesIO()
    savemat(out, values, do_compression=packed)
    check_elements(out.getvalue())


def test_the_builder_of_these_tests_builds_what_scipy_reads() -> None:
    check_elements(HEAD + SOUND)
    assert loadmat(io.BytesIO(HEAD + SOUND))["q"] == [[1.5]]
    turned = HEAD[:124] + b"\x01\x00MI" + struct.pack(">II", 9, 0)
    with pytest.raises(ValueError, match="type 9 where an array"):
        check_elements(turned)


def nested(depth: int) -> bytes:
    inner = SOUND
    for _ in range(depth):
        inner = array(CELL, (1, 1), inner)
    return inner


BROKEN = {
    "imaginary parts are missing": (array(DOUBLE | 1 << 11, (1, 1), NUMBER), "missing at the end"),
    "imaginary parts are an array": (array(DOUBLE | 1 << 11, (1, 1), NUMBER, SOUND), "type 14 where numbers"),
    "numbers of no type": (array(DOUBLE, (1, 1), element(8, b"12345678")), "type 8 where numbers"),
    "characters of no type": (array(CHAR, (1, 1), element(19, b"1")), "type 19 where numbers"),
    "characters without content": (array(CHAR, (99_999, 9_999), element(4, b"")), "an array of 999890001"),
    "an array of no class": (array(18, (1, 1), NUMBER), "class 18"),
    "a negative size": (array(DOUBLE, (1, -1), NUMBER), "less than 0"),
    "no sizes": (array(DOUBLE, (), NUMBER), "0 sizes"),
    "cells that are not there": (array(CELL, (30_000, 30_000), SOUND), "an array of 900000000"),
    "cells of numbers": (array(CELL, (1, 1), NUMBER), "type 9 where an array"),
    "fields without a length": (
        array(STRUCT, (1, 1), element(5, struct.pack("<i", 0)), element(1, b"ab"), SOUND),
        "without a length",
    ),
    "no fields, without end": (
        array(STRUCT, (60_000, 60_000), element(5, struct.pack("<i", 4)), element(1, b"")),
        "an array of 3600000000",
    ),
    "more in a cell than belongs to it": (
        array(CELL, (1, 1), element(14, SOUND[8:] + NUMBER)),
        "more in an array",
    ),
    "arrays in arrays in arrays": (nested(40), "within each other"),
    "sparse": (array(5, (3, 3), NUMBER, NUMBER, NUMBER), r"save full\(…\)"),
    "flags of another length": (element(14, element(6, b"1234")), "flags"),
    "five bytes in a tag": (element(14, struct.pack("<HH", 9, 5) + b"12345678"), "room for 4"),
    "longer than the file": (struct.pack("<II", 14, 999) + b"12345678", "longer than what holds it"),
    "numbers at the top": (NUMBER, "type 9 where an array"),
    "half a tag": (SOUND + b"\x0e\0\0", "missing at the end"),
    "compressed numbers": (element(15, zlib.compress(NUMBER)), "type 9 where an array"),
    "not compressed": (element(15, b"12345678"), "header check"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_does_not_fit_is_refused_before_scipy_reads_it(tmp_path: Path, case: str) -> None:
    content, needle = BROKEN[case]
    path = tmp_path / "data.mat"
    path.write_bytes(HEAD + content)
    with pytest.raises(FileFormatError, match=needle) as caught:
        read_data(path, Robot.load("planar_2r"))
    assert "a sound MAT file" in str(caught.value)


def test_what_would_unpack_to_more_than_a_table_may_have_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calib_planner.io.mat.MOST_INSIDE", 1 << 20)
    bomb = element(15, zlib.compress(array(DOUBLE, (1, 1 << 18), element(9, bytes(1 << 21)))))
    assert len(bomb) < 10_000
    with pytest.raises(ValueError, match="more than 1 MB"):
        check_elements(HEAD + bomb)


def test_a_sparse_array_says_what_to_do(tmp_path: Path) -> None:
    savemat(tmp_path / "data.mat", {"q": eye(3).tocsc()})
    with pytest.raises(FileFormatError, match=r"save full\(…\) of it"):
        read_data(tmp_path / "data.mat", Robot.load("planar_2r"))


@pytest.mark.parametrize("kind", [3, 16, 17])
def test_objects_and_functions_are_walked_through(kind: int) -> None:
    """Tables and objects of MATLAB: their own kind of array, whose content is a struct or another array."""
    if kind == 17:
        texts = [element(1, b"s0"), element(1, b"MCOS"), element(1, b"table")]
        one = element(14, element(6, struct.pack("<II", kind, 0)) + b"".join(texts) + SOUND)
    elif kind == 16:
        one = array(kind, (1, 1), SOUND)
    else:
        names = element(5, struct.pack("<i", 2)) + element(1, b"ab")
        one = array(kind, (1, 1), element(1, b"class"), names, SOUND)
    check_elements(HEAD + one)
    instead = element(9, bytes(len(SOUND) - 8))
    with pytest.raises(ValueError, match="type 9 where an array"):
        check_elements(HEAD + one.replace(SOUND, instead))
