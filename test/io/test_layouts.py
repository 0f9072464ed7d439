# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements in whatever layout they come: the same numbers, and one line that says what the file is like."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layouts import DATA, LAYOUTS, ROBOT, Layout, write
from robots import mixed, repeats

from calib_planner import CalibPlannerError, FileFormatError, Measurements
from calib_planner.cli.arguments import column_names
from calib_planner.errors import MissingExtraError
from calib_planner.io import Reading, format_table, in_units, read_data, read_joints, read_source, with_units
from calib_planner.io.sizes import angles_by_size, lengths_by_size
from calib_planner.units import ANGLES, LENGTHS, Units


def reading_of(layout: Layout, **more: object) -> Reading:
    stated = dict(layout.stated)
    if "units" in stated:
        stated["units"] = Units.parse(stated["units"])
    if "columns" in stated:
        stated["columns"] = column_names(stated["columns"])
    return Reading(**stated, **more)


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_gives_the_same_measurements(tmp_path: Path, name: str) -> None:
    layout, told = LAYOUTS[name], []
    if layout.kind == "xlsx":
        pytest.importorskip("openpyxl")
    source = read_data(write(tmp_path, DATA, layout), ROBOT, reading_of(layout, note=told.append))
    data = source.data
    assert data.joint_names == ROBOT.joint_names
    np.testing.assert_allclose(data.q, DATA.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(data.p, DATA.p, rtol=0, atol=1e-12)
    assert (data.std is not None) == layout.std and (data.payload is not None) == layout.payload
    if layout.std:
        np.testing.assert_allclose(np.asarray(data.std), np.asarray(DATA.std), rtol=1e-12)
    if layout.payload:
        np.testing.assert_array_equal(np.asarray(data.payload), np.asarray(DATA.payload))
    understanding = source.understanding
    assert understanding.units == Units(layout.length, layout.angle)
    lines = [t for t in told if "columns ignored" not in t]
    assert len(lines) == (not understanding.plain) and not [t for t in lines if "\n" in t]
    if lines:
        assert f"angles in {layout.angle} (" in lines[0] and f"lengths in {layout.length} (" in lines[0]
        assert ("decimal comma" in lines[0]) == (layout.decimal == ",")


MARKS = st.sampled_from([",", ";", "\t", "|", " "])


@st.composite
def any_layout(draw: st.DrawFn) -> Layout:
    """A layout that can be told, or whose units are stated where they are not written."""
    mark = draw(MARKS)
    quoted = draw(st.booleans())
    header = draw(st.booleans())
    decimal = draw(st.sampled_from([".", ","] if mark != "," or quoted else ["."]))
    written = draw(st.sampled_from(["", "row", "square", "suffix", "in"] if header else [""]))
    if mark == " ":
        written = written if written in ("", "row", "square") and not (quoted and written == "square") else ""
    angle, length = draw(st.sampled_from(sorted(ANGLES))), draw(st.sampled_from(sorted(LENGTHS)))
    return Layout(
        separator=mark,
        decimal=decimal,
        line_end=draw(st.sampled_from(["\n", "\r\n", "\r"])),
        encoding=draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])),
        names=draw(st.sampled_from(["", "J{}", "axis_{}", "q{}"])),
        header=header,
        written=written,
        angle=angle,
        length=length,
        titles=draw(st.sampled_from([(), ("Report",), ("Report of cell 4", "", "Ada, Bob")])),
        quoted=quoted,
        trailing=mark != " " and draw(st.booleans()),
        order=draw(st.sampled_from(["", "points", "mixed"])) if header else "",
        # between white space a column without a unit cannot be told in a row of units, which is refused
        more=("temperature",) if header and (mark, written) != (" ", "row") and draw(st.booleans()) else (),
        std=header and draw(st.booleans()),
        stated={} if written else {"units": f"{length},{angle}"},
    )


@settings(max_examples=repeats(60, 1000), deadline=None)
@given(layout=any_layout(), holes=st.lists(st.tuples(st.integers(0, 23), st.integers(0, 1)), max_size=4))
def test_any_layout_that_is_written_is_read_as_the_same(layout: Layout, holes: list[tuple[int, int]]) -> None:
    points = np.array(DATA.p)
    for row, target in holes if layout.separator != " " else ():
        points[row, target] = np.nan
    std = np.where(np.isnan(points), np.nan, np.asarray(DATA.std))
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), replace(DATA, points=points, std=std), layout)
        data = read_data(path, ROBOT, reading_of(layout)).data
    np.testing.assert_allclose(data.q, DATA.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(data.p, points, rtol=0, atol=1e-12)
    assert (data.std is None) == (not layout.std)
    if layout.std:
        np.testing.assert_allclose(np.asarray(data.std), std, rtol=1e-12)


# ── what is refused ──────────────────────────────────────────────────────────────────────────────────

HEAD = "j1,j2,j3,j4,j5,j6,x1,y1,z1\n"
ROW = "0.1,0.2,0.3,0.4,0.5,0.6,1.5,0.25,1e-3\n"
REFUSED: dict[str, tuple[str | bytes, dict, list[str]]] = {
    "old Excel": (
        b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1",
        {},
        ["an old Excel file (.xls)", "save it as .xlsx or CSV"],
    ),
    "MATLAB 7.3": (b"MATLAB 7.3 MAT-file", {}, ["a MATLAB 7.3 file", "'-v7'"]),
    "HDF5": (b"\x89HDF\r\n\x1a\n", {}, ["HDF5", "'-v7'"]),
    "OpenDocument": (
        b"PK\x03\x04mimetypeapplication/vnd.oasis.opendocument",
        {},
        ["OpenDocument", ".xlsx or CSV"],
    ),
    "broken XLSX": (b"PK\x03\x04[Content_Types].xml", {}, ["save it again"]),
    "broken MAT": (b"MATLAB 5.0 MAT-file" + b"x" * 200, {}, ["a sound MAT file", "save it again"]),
    "broken NPY": (b"\x93NUMPY\x01\x00", {}, ["a sound NPY file"]),
    "PDF": (b"%PDF-1.7\n", {}, ["a PDF", "export the table as CSV"]),
    "Parquet": (b"PAR1\x15\x04", {}, ["a Parquet file", "as CSV"]),
    "pickle": (b"\x80\x04\x95", {}, ["a Python pickle", "numpy.savez"]),
    "gzip": (b"\x1f\x8b\x08", {}, ["a gzip archive", "unpack it"]),
    "ROS 1": (b"#ROSBAG V2.0\n", {}, ["a ROS 1 bag", "rosbags-convert"]),
    "URDF": ("<robot name='x'/>", {}, ["a robot description (URDF)", "--robot"]),
    "URDF with its first line": (
        '<?xml version="1.0"?>\n<robot name="x"/>',
        {},
        ["a robot description", "--robot"],
    ),
    "XML": ('<?xml version="1.0"?><Workbook/>', {}, ["XML", "as CSV"]),
    "JSON of nothing": ('{"a": {}, "b": "c"}', {}, ["arrays of numbers"]),
    "JSON of unequal records": ('[{"q": [1, 2]}, {"q": [1]}]', {}, ["'q' of different lengths", "null"]),
    "columns missing, no header": ("1,2,3,4,5,6,7\n", {}, ["no header, and 7 columns", 'state --columns "j1 j2']),
    "strange header": ("a,b,c,d,e,f,g,h,i\n" + ROW, {}, ["no column j1", "among a, b, c", "state --columns"]),
    "a joint missing": (HEAD.replace("j3", "j7") + ROW, {}, ["no column j3", "rename or add them"]),
    "numbers with a gap": (HEAD.upper().replace("J3", "J7") + ROW, {}, ["no column j1"]),
    "two sets of joints": (
        "q1,q2,q3,q4,q5,q6,a1,a2,a3,a4,a5,a6,x,y,z\n" + "1,2,3,4,5,6," + ROW,
        {},
        ["q 1 … 6 and a 1 … 6", "state --columns"],
    ),
    "two points of one target": (HEAD.strip() + ",tracker x1\n" + ROW.strip() + ",1\n", {}, []),
    "x twice": (
        HEAD.replace("x1,y1,z1", "X,Y,Z,measured X") + ROW.strip() + ",1\n",
        {},
        ["X, measured X", "one column of x per reflector"],
    ),
    "a joint in two units": (
        HEAD.replace("j1", "j1 [rad],j1 [deg]") + "0.1," + ROW,
        {},
        ["j1 [rad], j1 [deg]", "one column of j1", "state --columns"],
    ),
    "unknown unit": (HEAD.replace("x1", "x1 [Zoll]") + ROW, {}, ["x1 [Zoll]", "'Zoll'", "state --columns"]),
    "angle of a length": (HEAD.replace("x1", "x1 [deg]") + ROW, {}, ["x1 [deg]", "a unit of length"]),
    "length of an angle": (HEAD.replace("j1", "j1 [mm]") + ROW, {}, ["column j1", "a unit of angle", "mm"]),
    "units row that contradicts": (
        HEAD.replace("x1", "x1 [mm]") + "rad,rad,rad,rad,rad,rad,m,m,m\n" + ROW,
        {},
        ["unit of column 'x1 [mm]'", "got m"],
    ),
    "units against the file": (
        HEAD.replace("x1", "x1 [mm]") + ROW,
        {"units": Units("m")},
        ["units", "mm, as the file says", "--units m"],
    ),
    "too few names": (ROW, {"columns": ("j1", "j2")}, ["--columns", "9 names", "got 2 names", "'-'"]),
    "a line between header and rows": (
        HEAD + "see next page\n" + ROW,
        {},
        ["line 2", "'see next page'", "remove"],
    ),
    "a note at the end": (HEAD + ROW + "measured by Ada\n", {}, ["line 3", "1 cells", "9 cells"]),
    "both decimal marks": (
        (HEAD + ROW).replace(",", ";").replace("0.25", "0,25"),
        {},
        ["line 2, column y1", "'0,25'", "use a decimal point in every number"],
    ),
    "thousands": (
        (HEAD + ROW).replace(",", ";").replace(".", ",").replace("1,5", "1.001,5"),
        {},
        ["line 2, column", "no mark between thousands"],
    ),
    "an empty cell in white space": (
        (HEAD + ROW * 3 + ROW[:4] + ROW[8:]).replace(",", " "),
        {},
        ["line 5", "8 cells", "another separator"],
    ),
    "fewer units than columns in white space": (
        (HEAD[:-1] + ",temperature\n" + "rad," * 6 + "m,m,m\n" + (ROW[:-1] + ",21\n") * 3).replace(",", " "),
        {},
        ["line 2", "9 units for 10 columns", "write - where there is none"],
    ),
    "a header only": (HEAD, {}, ["rows: expected at least one row of numbers, got a header only"]),
    "strange sep": ("sep=#\n" + HEAD + ROW, {}, ["first line", "sep=#", "semicolon"]),
    "comments only": ("# nothing\n", {}, ["comments only"]),
    "YAML by name": ("a: 1\n", {"name": "plan.yaml"}, ["a YAML file", "give the measured table"]),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_told_is_refused_with_one_thing_to_do(tmp_path: Path, name: str) -> None:
    content, how, words = REFUSED[name]
    path = tmp_path / how.pop("name", "data.csv") if "name" in how else tmp_path / "data.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    if not words:
        assert read_data(path, ROBOT).ignored == ("tracker x1",)  # the exact names win, and it is said
        return
    if name == "broken XLSX":
        pytest.importorskip("openpyxl")
    with pytest.raises(FileFormatError) as caught:
        read_data(path, ROBOT, Reading(**how))
    text = str(caught.value)
    assert str(path) in text and text.isprintable() and len(text) < 1500
    assert [w for w in words if w not in text] == [], text


def test_without_openpyxl_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "data.xlsx").write_bytes(b"PK\x03\x04[Content_Types].xml")
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'calib_planner\[files\]'"):
        read_data(tmp_path / "data.xlsx", ROBOT)


@pytest.mark.parametrize("unit", ["cm", "in", "ft"])
def test_lengths_that_sizes_do_not_tell_are_told_by_the_fit(tmp_path: Path, unit: str) -> None:
    path = write(tmp_path, DATA, Layout(length=unit))
    assert read_data(path, ROBOT).understanding.units.length == "m"
    with pytest.raises(FileFormatError, match=f"add --units {unit}"):
        read_source(path, ROBOT, Reading(), placed=False)


def test_what_sizes_tell_is_told_in_either_unit_only() -> None:
    """A joint that turns several times is in radians, a robot far away in metres; the rest is left open."""
    q = np.array(DATA.q)
    q[:, 5] *= 6.0
    assert angles_by_size(ROBOT, q, ROBOT.joint_is_revolute) == ("rad", [])
    q[:, 5] *= 2.0
    unit, (remark,) = angles_by_size(ROBOT, q, ROBOT.joint_is_revolute)
    assert unit == "rad" and "are they degrees" in remark
    assert angles_by_size(ROBOT, np.rad2deg(DATA.q), ROBOT.joint_is_revolute)[0] == "deg"
    assert angles_by_size(ROBOT, np.rad2deg(0.05 * DATA.q), ROBOT.joint_is_revolute) == ("rad", [])
    assert lengths_by_size(ROBOT, DATA.p + 100.0) == ("m", [])
    for factor, unit in ((1e3, "mm"), (1e2, "m"), (39.37, "m"), (1e6, "m"), (1.0, "m")):
        assert lengths_by_size(ROBOT, factor * DATA.p)[0] == unit


def test_sliding_joints_are_in_the_unit_of_lengths(tmp_path: Path) -> None:
    robot = mixed()
    q = np.array([[0.1, 0.5, 0.2, 0.3], [0.3, -0.2, 1.2, -0.3]])
    data = Measurements(robot.joint_names, q, robot.positions(q))
    plain = Layout(angle="deg", length="mm", sliding=("slide",))
    for layout in (plain, replace(plain, written="square")):
        reading = Reading() if layout.written else Reading(units=Units("mm", "deg"))
        np.testing.assert_allclose(read_data(write(tmp_path, data, layout), robot, reading).data.q, q, atol=1e-12)
    path = tmp_path / "mm.csv"
    path.write_text("turn,slide,spin,nod\n0.1,500,0.2,0.3\n")
    table = read_joints(path, robot)
    np.testing.assert_allclose(table.configurations, [[0.1, 0.5, 0.2, 0.3]], atol=1e-12)
    assert "slide in mm (by its size)" in table.understanding.describe()


def test_configurations_are_read_in_any_layout_and_go_out_in_their_units(tmp_path: Path) -> None:
    path = write(tmp_path, DATA, LAYOUTS["German Excel, old"])
    table = read_joints(path, ROBOT)
    np.testing.assert_allclose(table.configurations, DATA.q, rtol=0, atol=1e-12)
    assert table.understanding.units.angle == "deg"
    again = in_units(ROBOT, table.configurations, table.understanding.units)
    names = with_units(ROBOT, table.understanding.units)
    assert names[0] == "j1 [deg]"
    (tmp_path / "out.csv").write_text(format_table(names, again.tolist()))
    np.testing.assert_allclose(read_joints(tmp_path / "out.csv", ROBOT).configurations, DATA.q, atol=1e-15)


def test_a_column_without_unit_wins_over_its_twins(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text("j1_deg," + HEAD.strip() + ",x1_mm\n7," + ROW.strip() + ",9\n")
    source = read_data(path, ROBOT)
    assert source.data.q[0].tolist() == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    assert source.data.p[0, 0].tolist() == [1.5, 0.25, 1e-3] and source.ignored == ("j1_deg", "x1_mm")


def test_the_line_that_is_said(tmp_path: Path) -> None:
    said: list[str] = []
    path = write(tmp_path, DATA, LAYOUTS["German Excel, old"])
    read_data(path, ROBOT, Reading(note=said.append))
    assert said == [
        f"{path}: text in Windows-1252 with semicolon, 24 rows; decimal comma; 2 title lines skipped; columns by "
        "name: j1 j2 j3 j4 j5 j6 x1 y1 z1 x2 y2 z2; angles in deg (as written); lengths in m (as written)"
    ]


@pytest.mark.parametrize("kind", ["npy", "structured", "npz", "mat", "mat_struct", "records", "xlsx"])
def test_no_byte_of_another_kind_of_file_brings_a_traceback(tmp_path: Path, kind: str) -> None:
    if kind == "xlsx":
        pytest.importorskip("openpyxl")
    path = write(tmp_path, DATA.select(range(4)), Layout(kind=kind))
    sound, rng = path.read_bytes(), np.random.default_rng(5)
    refused = 0
    for turn in range(repeats(15, 300)):
        data = bytearray(sound)
        for at in rng.integers(len(data), size=rng.integers(1, 20)):
            data[at] = rng.integers(256)
        path.write_bytes(data[: rng.integers(1, len(data))] if turn % 3 == 0 else data)
        try:
            assert np.isfinite(read_data(path, ROBOT).data.q).all()
        except CalibPlannerError as error:
            assert "\n" not in str(error) and len(str(error)) < 2500
            refused += 1
    assert refused > 3


def test_rows_of_separators_only_and_cells_beyond_the_names_are_nothing(tmp_path: Path) -> None:
    """As spreadsheet programs write them below and beside a table."""
    path = tmp_path / "data.csv"
    path.write_text(HEAD + ROW + ",,\n" + ROW + ",,,,,,,,\n")
    np.testing.assert_array_equal(read_data(path, ROBOT).data.q, [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]] * 2)
    path.write_text(ROW.replace("\n", ",,\n") * 2)
    names = ("j1", "j2", "j3", "j4", "j5", "j6", "x1", "y1", "z1")
    data = read_data(path, ROBOT, Reading(columns=names, units=Units("m", "rad"))).data
    np.testing.assert_array_equal(data.p[:, 0], [[1.5, 0.25, 1e-3]] * 2)


def test_numbers_of_rows_without_a_heading_are_no_joint(tmp_path: Path) -> None:
    """As R writes them between white space."""
    path = tmp_path / "data.txt"
    rows = [f"{k} {ROW}".replace(",", " ") for k in (1, 2)]
    path.write_text(HEAD.replace(",", " ") + "".join(rows))
    np.testing.assert_array_equal(read_data(path, ROBOT).data.q, [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]] * 2)


def test_joints_may_have_units_of_their_own_which_is_said(tmp_path: Path) -> None:
    said: list[str] = []
    path = tmp_path / "data.csv"
    path.write_text(HEAD.replace("j1", "j1 [deg]").replace("j2", "j2 [rad]") + ROW)
    source = read_data(path, ROBOT, Reading(note=said.append))
    assert source.data.q[0, :2].tolist() == [np.deg2rad(0.1), 0.2]
    assert "joints in deg, rad" in said[0]


def test_the_sheet_with_the_table_is_the_one_with_numbers(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.title = "notes"
    path = tmp_path / "data.xlsx"
    book.save(path)
    with pytest.raises(FileFormatError, match="sheets: expected a sheet with numbers, got notes; fill one"):
        read_data(path, ROBOT)
    for name in ("monday", "tuesday"):
        sheet = book.create_sheet(name)
        for line in (HEAD, ROW):
            cells = line.strip().split(",")
            sheet.append(cells if line is HEAD else list(map(float, cells)))
        book.save(path)
        if name == "monday":
            assert read_data(path, ROBOT).data.q.tolist() == [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]]
    with pytest.raises(FileFormatError, match="monday, tuesday alike; delete the others, or save one as CSV"):
        read_data(path, ROBOT)
