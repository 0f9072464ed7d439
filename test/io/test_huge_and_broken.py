# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""CSV files as people and programs really leave them: too large, in the wrong dress, cut off, or no text at all.

Whatever the bytes: numbers come back as they were written, or one error in one line says where and why.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from calib_planner import CalibPlannerError, FileFormatError, Robot
from calib_planner.io import Reading, read_configurations, read_data, read_plan_csv, table, text
from calib_planner.units import SI

PLANAR = Robot.load("planar_2r")
HEADER = "q1,q2,x1,y1,z1\n"
ROW = "0.1,-0.2,1.5,0.25,1e-3\n"
GOOD = HEADER + ROW


def put(folder: Path, content: str | bytes) -> Path:
    path = folder / "data.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refused(path: Path, read: Callable = read_data) -> str:
    """The error's text, which is one line, not long, printable and names the file."""
    with pytest.raises(FileFormatError) as caught:
        read(path, PLANAR)
    message = str(caught.value)
    assert str(path) in message and message.isprintable() and len(message) < 2500
    return message


BROKEN: dict[str, tuple[str | bytes, list[str]]] = {
    "NUL in a cell": (GOOD + "0.1,\0,1,2,3\n", ["line 3", "a NUL character"]),
    "NULs at the end": (GOOD + "\0" * 4096, ["line 3", "a NUL character"]),
    "a spreadsheet": (b"PK\x03\x04\x14\x00\x06\x00\x08\x00\x00\x00!\x00\xb5U0#", ["a ZIP archive", "unpack it"]),
    "a picture": (b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR", ["a PNG picture", "export the table as CSV"]),
    "HTML": ("<!DOCTYPE html>\n<html></html>\n", ["a web page (HTML)", "download the table"]),
    "JSON": ('{"q1": [1, 2],\n"q2": [3, 4]}\n', ["no column x1, y1, z1 among q1, q2"]),
    "YAML": ("joints: 2\nrows: 3\n", ["no header, and 2 columns", 'state --columns "q1 q2 x1 y1 z1"']),
    "escape codes": ("\x1b[31mq1,q2,x1,y1,z1\n1,2,3,4,5\n", ["no column q1", "\\x1b[31mq1"]),
    "decimal commas": ("q1,q2,x1,y1,z1\n0,1,-0,2,1,5,0,25,0,001\n", ["line 2", "10 cells", "use decimal points"]),
    "thousands": ("q1;q2;x1;y1;z1\n0;0;1.500,25;0;0\n", ["column x1", "'1.500,25'", "use a decimal point"]),
    "quote not closed": (HEADER + '0,0,1,0,"0\n', ["text of line 2"]),
    "quote over two lines": (HEADER + '0,0,1,0,"0\n0"\n', ["text of line 2", "end on their line"]),
    "columns twice": ("q1,q2,x1,y1,z1,x1,z1\n0,0,1,2,3,4,5\n", ["x1, z1 twice", "each column name once"]),
    "ignored columns twice": ("q1,q2,x1,y1,z1,note,note\n0,0,1,2,3,a,b\n", ["note twice"]),
    "spaces, so twice": ("q1, q1 ,q2,x1,y1,z1\n0,0,0,1,2,3\n", ["q1 twice"]),
    "inf": (HEADER + "0,inf,1,2,3\n", ["line 2, column q2", "'inf'", "finite"]),
    "Infinity": (HEADER + "0,0,-Infinity,2,3\n", ["column x1", "'-Infinity'"]),
    "nan": (HEADER + "NaN,0,1,2,3\n", ["column q1", "'NaN'"]),
    "n/a": (HEADER + "0,0,n/a,2,3\n", ["column x1", "leave the cell empty"]),
    "overflow": (HEADER + "0,0,1e400,2,3\n", ["column x1", "'1e400'"]),
    "no digits of ours": (HEADER + "0,0,١٢,2,3\n", ["column x1", "a finite number"]),
    "true minus sign": (HEADER + "0,\u22121,1,2,3\n", ["column q2", "a finite number"]),
    "unit in the cell": (HEADER + "0,90°,1,2,3\n", ["column q2", "'90°'"]),
    "hexadecimal": (HEADER + "0,0x1,1,2,3\n", ["column q2", "'0x1'"]),
    "FORTRAN": (HEADER + "0,1.0D-3,1,2,3\n", ["column q2", "'1.0D-3'"]),
    "huge cell": (HEADER + "0," + "7" * 200_000 + ",1,2,3\n", ["column q2", "finite"]),
    "huge word": (HEADER + "0," + "a" * 200_000 + ",1,2,3\n", ["column q2", "'aaaa"]),
    "huge quoted cell": (HEADER + '0,"' + "a" * 200_000 + '",1,2,3\n', ["line 2", "field limit"]),
    "huge name": ("q1,q2,x1,y1," + "z" * 200_000 + "\n0,0,0,0,0\n", ["no column z1", "zzz"]),
    "cut off in a row": (GOOD + "0.1,-0.2,1.", ["line 3", "3 cells"]),
    "many columns": (
        ",".join(f"c{i}" for i in range(100_000)) + "\n" + ",".join("1" * 100_000) + "\n",
        ["100000 columns", "at most 10000"],
    ),
    "many strangers": (
        ",".join(f"c{i}" for i in range(9_000)) + "\n" + ",".join("1" * 9_000) + "\n",
        ["no column q1, q2 among c0, c1", "and 8970 more"],
    ),
    "nearly a name, huge": (
        "q1,q2,x1,y1,z1,X" + "1" * 99_999 + "\n0,0,1,2,3,4\n",
        ["column 'X1111", "x1, y1, z1 and std_", "rename it"],
    ),
    "many columns of one name": (",".join("a" * 10_000) + "\n1\n", ["no header, and 1 column for q1"]),
    "all targets but one cell": (
        "q1,q2," + ",".join(f"{a}{t}" for t in range(1, 3001) for a in "xyz")[:-6] + "\n0\n",
        ["cells, one per column"],
    ),
    "a target far up": ("q1,q2,x9999,y9999,z9999\n0,0,1,2,3\n", ["no column x1, y1, z1"]),
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_is_wrong_is_said(tmp_path: Path, case: str) -> None:
    content, words = BROKEN[case]
    message = refused(put(tmp_path, content))
    assert [w for w in words if w not in message] == [], message[:500]


@pytest.mark.parametrize(
    "content",
    [
        GOOD + "# 20 °C, Prüfstand\n",
        GOOD.replace("\n", "\r"),
        GOOD.replace("\n", "\r\n"),
        "q1;q2;x1;y1;z1;remark, free\n0.1;-0.2;1.5;0.25;1e-3;a, b, c\n",
        'q1,q2,x1,y1,z1,"remark, free"\n0.1,-0.2,"1.5",0.25,1e-3,"a, ""b"""\n',
        "q1,q2,x1,y1,z1,größe_mm,температура\n0.1,-0.2,1.5,0.25,1e-3,1_0,²\n",
        "q1,q2,x1,y1,z1,,\n0.1,-0.2,1.5,0.25,1e-3,,\n,,,,,,\n",
        "z1,note,y1,q2,x1,q1\n1e-3,\u2028\x0b,0.25,-0.2,1.5,0.1\n",
        GOOD.encode("utf-16"),
        GOOD.encode("utf-16-le"),
        GOOD.encode("utf-16-be"),
        (GOOD + "# 20 °C\n").encode("latin-1"),
        "q1;q2;x1;y1;z1\n0,1;-0,2;1,5;0,25;0,001\n",
        "q1\tq2\tx1\ty1\tz1\n0,1\t-0,2\t1,5\t,25\t1e-3\n",
        'q1,q2,x1,y1,z1\n"0,1","-0,2","1,5","0,25","0,001"\n',
        GOOD.replace("q1,q2", "joint_1,joint_2"),
        GOOD.replace("x1,y1,z1", "x0,y0,z0"),
        ROW,
        "q1,q2,x1,y1,z1\n +.1 ,\t-2E-1,01.5, 0.25 ,\u00a01e-3\n",
    ],
    ids=[
        "UTF-8",
        "CR",
        "CRLF",
        "semicolons",
        "quotes",
        "letters",
        "trailing",
        "odd breaks",
        "UTF-16",
        "UTF-16-LE",
        "UTF-16-BE",
        "Latin-1",
        "decimal commas",
        "with tabs",
        "quoted",
        "by number",
        "from 0",
        "no header",
        "spellings",
    ],
)
def test_what_is_odd_but_clear_is_read(tmp_path: Path, content: str | bytes) -> None:
    data = read_data(put(tmp_path, content), PLANAR).data
    assert data.q.tolist() == [[0.1, -0.2]] and data.p.tolist() == [[[1.5, 0.25, 1e-3]]]


def test_line_numbers_are_the_editors(tmp_path: Path) -> None:
    odd = "# \x0b \x0c \x1c \x85 \u2028 no line ends\n\n" + HEADER + ROW + "0,zero,1,2,3\n"
    assert "line 5, column q2" in refused(put(tmp_path, odd))


def test_millimetres_are_read_as_they_stand(tmp_path: Path) -> None:
    """No file reader's business: a robot may be large. What identifies may suspect it."""
    data = read_data(put(tmp_path, HEADER + "0,0,1800.0,0,0\n"), PLANAR).data
    assert data.p[0, 0, 0] == 1800.0


@pytest.mark.parametrize("read", [read_configurations, read_plan_csv])
@pytest.mark.parametrize("case", ["NUL in a cell", "decimal commas", "inf", "many columns"])
def test_configurations_are_read_the_same_way(tmp_path: Path, read: Callable, case: str) -> None:
    content, words = BROKEN[case]
    message = refused(put(tmp_path, content), read)
    assert all(w in message for w in words)


def test_many_rows_are_all_there_and_in_order(tmp_path: Path) -> None:
    values = np.random.default_rng(0).standard_normal((3 * table.BLOCK + 7, 5))
    lines = [",".join(map(repr, row)) for row in values.tolist()]
    holes = [5, table.BLOCK - 1, table.BLOCK, len(lines) - 1]
    for i in holes:
        lines[i] = ",".join([*lines[i].split(",")[:2], "", "", ""])
        values[i, 2:] = np.nan
    lines[100] = '"' + lines[100].replace(",", '","') + '"'
    data = read_data(put(tmp_path, HEADER + "\n".join(lines)), PLANAR).data
    np.testing.assert_array_equal(data.q, values[:, :2])
    np.testing.assert_array_equal(data.p[:, 0], values[:, 2:])
    bad = lines.copy()
    bad[2 * table.BLOCK] = "0,0,1,2,x"
    message = refused(put(tmp_path, HEADER + "\n".join(bad)))
    assert f"line {2 * table.BLOCK + 2}, column z1" in message


def test_too_many_rows_are_counted(tmp_path: Path) -> None:
    path = put(tmp_path, HEADER + "0,0,0,0,0\n" * (table.MAX_ROWS + 1))
    assert "at most 1000000, got 1000001" in refused(path)


def test_a_file_of_gigabytes_is_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / "huge.csv"
    with open(path, "wb") as file:
        file.write(GOOD.encode())
        file.truncate(20 * text.MAX_BYTES)  # sparse
    assert "at most 50 MB, got a larger file" in refused(path)


CHARACTERS = st.one_of(st.sampled_from(list('q12xyz,;\t."#-+e0_\n\r \0naif')), st.characters())


def encoded(text: str) -> bytes:
    """UTF-8; lone surrogates become bytes that no UTF-8 has."""
    return text.encode("utf-8", "surrogatepass")


@settings(max_examples=300, deadline=None)
@given(content=st.one_of(st.binary(max_size=200), st.text(CHARACTERS, max_size=200).map(encoded)))
@example(content=b'"')
@example(content=b"\xef\xbb\xbf")
@example(content=b"q1,q2\n1,\x1c2\n")
def test_no_text_brings_a_traceback(content: bytes) -> None:
    survives(content)


@settings(max_examples=300, deadline=None)
@given(
    edits=st.lists(st.tuples(st.integers(0, 60), st.integers(0, 4), st.text(CHARACTERS, max_size=3)), max_size=6)
)
def test_no_edit_of_a_good_file_brings_a_traceback(edits: list[tuple[int, int, str]]) -> None:
    content = HEADER + ROW * 2
    for at, cut, put_in in edits:
        content = content[:at] + put_in + content[at + cut :]
    survives(content.encode("utf-8", "replace"))


def survives(content: bytes) -> None:
    """Either finite numbers or one of our errors, in a line."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.csv"
        path.write_bytes(content)
        for read in (read_data, read_configurations, read_plan_csv):
            try:
                found = read(path, PLANAR)
            except CalibPlannerError as error:
                assert "\n" not in str(error) and len(str(error)) < 2500
                continue
            q = found.data.q if read is read_data else found[0] if read is read_plan_csv else found
            assert len(q) and np.isfinite(q).all()


@settings(max_examples=100, deadline=None)
@given(
    values=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=5, max_size=5),
    order=st.permutations(["q1", "q2", "x1", "y1", "z1"]),
    mark=st.sampled_from([",", ";", "\t"]),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    spell=st.sampled_from([repr, "{:.17g}".format, "{:+.16e}".format, '"{!r}"'.format, " {!r} ".format]),
)
def test_any_order_and_spelling_of_the_columns_gives_the_same(
    values: list[float], order: list[str], mark: str, end: str, spell: Callable[[float], str]
) -> None:
    by_name = dict(zip(["q1", "q2", "x1", "y1", "z1"], values, strict=True))
    rows = [mark.join(order), mark.join(spell(by_name[n]) for n in order), ""]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.csv"
        path.write_bytes(end.join(rows).encode())
        data = read_data(path, PLANAR, Reading(units=SI)).data
    assert [*data.q[0], *data.p[0, 0]] == values
