# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""CSV files: what is written is read back to the bit, and every flaw is named by line and column."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from robots import mixed

from calib_planner import FileFormatError, InputError, Measurements, Robot
from calib_planner.io import (
    Reading,
    read_configurations,
    read_data,
    read_plan_csv,
    table,
    text,
    write_configurations,
    write_measurements,
)
from calib_planner.measurements import RejectedPoint
from calib_planner.units import SI, Units

PLANAR = Robot.load("planar_2r")
FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
GOOD = "q2,q1,x1,y1,z1\n0.1,0.2,1,2,3\n"


def put(folder: Path, content: str | bytes) -> Path:
    path = folder / "data.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@st.composite
def measurements(draw: st.DrawFn) -> Measurements:
    n, targets = draw(st.integers(1, 5)), draw(st.integers(1, 3))
    q = draw(hnp.arrays(float, (n, 2), elements=FINITE))
    points = draw(hnp.arrays(float, (n, targets, 3), elements=FINITE))
    points[draw(hnp.arrays(bool, (n, targets)))] = np.nan
    std = None
    if draw(st.booleans()):
        std = draw(hnp.arrays(float, points.shape, elements=st.floats(1e-300, 1e10)))
    payload = draw(hnp.arrays(float, n, elements=st.floats(0.0, 1e10))) if draw(st.booleans()) else None
    return Measurements(PLANAR.joint_names, q, points, std, payload)


@settings(max_examples=60, deadline=None)
@given(data=measurements())
def test_measurements_come_back_to_the_bit(data: Measurements) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.csv"
        write_measurements(path, data)
        back = read_data(path, PLANAR, Reading(units=SI))
    assert back.ignored == ()
    assert back.data.q.tobytes() == data.q.tobytes()
    np.testing.assert_array_equal(back.data.p, data.p)
    assert (back.data.std is None) == (data.std is None)
    if data.std is not None:
        np.testing.assert_array_equal(np.asarray(back.data.std)[data.seen], np.asarray(data.std)[data.seen])
    assert (back.data.payload is None) == (data.payload is None)
    if data.payload is not None:
        np.testing.assert_array_equal(back.data.payload, data.payload)


def test_a_payload_stays_with_its_row() -> None:
    q, points = np.arange(6.0).reshape(3, 2), np.arange(9.0).reshape(3, 1, 3)
    data = Measurements(("q1", "q2"), q, points, payload=[0.0, 2.5, 10.0])
    rejected = [RejectedPoint(1, 1, "", 9.0, 1.0)]
    for other in (data.without(rejected), data.in_order_of(("q2", "q1"))):
        np.testing.assert_array_equal(other.payload, data.payload)
    np.testing.assert_array_equal(data.select([2, 0]).payload, [10.0, 0.0])
    for wrong in ([1.0, 2.0], [1.0, -2.0, 3.0], [1.0, np.nan, 3.0]):
        with pytest.raises(InputError, match="payload"):
            Measurements(("q1", "q2"), q, points, payload=wrong)


def test_a_joint_may_be_named_like_the_column_of_payloads(tmp_path: Path) -> None:
    robot = replace(PLANAR, joint_names=("q1", "payload"))
    data = read_data(put(tmp_path, "q1,payload,x1,y1,z1\n0.1,-0.2,1,2,3\n"), robot).data
    assert data.payload is None and data.q.tolist() == [[0.1, -0.2]]


@settings(max_examples=40, deadline=None)
@given(q=hnp.arrays(float, st.tuples(st.integers(1, 6), st.just(2)), elements=FINITE), k=st.integers(1, 99))
def test_configurations_come_back_to_the_bit(q: np.ndarray, k: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "q.csv"
        write_configurations(path, PLANAR.joint_names, q, np.full(len(q), k))
        again, repetitions = read_plan_csv(path, PLANAR, Reading(units=SI))
        assert read_configurations(path, PLANAR, Reading(units=SI)).tobytes() == q.tobytes() == again.tobytes()
    assert (repetitions == k).all()


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        "\ufeff" + GOOD,
        GOOD.replace("\n", "\r\n"),
        GOOD.replace(",", ";"),
        GOOD.replace(",", "\t"),
        "# made by hand\n\n" + GOOD + "\n# the end\n,,,,\n",
        GOOD.replace(",", " , "),
        "q2,q1,x1,y1,z1,temperature,operator\n0.1,0.2,1,2,3,21.5,Ada\n",
    ],
    ids=["plain", "bom", "crlf", "semicolon", "tab", "comments", "spaces", "extra columns"],
)
def test_joint_columns_come_in_any_order_and_dress(tmp_path: Path, content: str) -> None:
    data = read_data(put(tmp_path, content), PLANAR).data
    np.testing.assert_array_equal(data.q, [[0.2, 0.1]])
    np.testing.assert_array_equal(data.p, [[[1, 2, 3]]])


def test_ignored_columns_are_told(tmp_path: Path) -> None:
    path = put(tmp_path, "q1,q2,x1,y1,z1,temperature\n1,2,3,4,5,6\n")
    assert read_data(path, PLANAR).ignored == ("temperature",)


def test_degrees_leave_sliding_joints_alone(tmp_path: Path) -> None:
    robot = mixed()
    path = put(tmp_path, "turn,slide,spin,nod\n180,0.5,90,-45\n")
    expected = [[np.pi, 0.5, np.pi / 2, -np.pi / 4]]
    np.testing.assert_allclose(read_configurations(path, robot, Reading(otherwise=Units(angle="deg"))), expected)


def test_empty_cells_are_targets_not_measured(tmp_path: Path) -> None:
    path = put(tmp_path, "q1,q2,x1,y1,z1,x2,y2,z2\n0,0,,,,1,2,3\n0,1,1,2,3,,,\n")
    data = read_data(path, PLANAR).data
    np.testing.assert_array_equal(data.seen, [[False, True], [True, False]])


BAD = {
    "empty": ("", "header", "first line with column names"),
    "header only": ("q1,q2,x1,y1,z1\n", "rows", "at least one row"),
    "joint missing": ("q1,x1,y1,z1\n1,2,3,4\n", "no column q2 among q1, x1, y1, z1", "q1, q2"),
    "joint misspelt": ("q1,q22x,x1,y1,z1\n1,2,3,4,5\n", "no column q2", "is 'q22x' meant to be 'q2'?"),
    "no points": ("q1,q2\n1,2\n", "no column x1, y1, z1", "coordinates"),
    "half a target": ("q1,q2,x1,y1\n1,2,3,4\n", "no column z1", "x1, y1, z1"),
    "target skipped": ("q1,q2,x1,y1,z1,x3,y3,z3\n1,2,3,4,5,6,7,8\n", "no column x2", "x2, y2, z2"),
    "nearly a name": ("q1,q2,x1,y1,z1,X2\n1,2,3,4,5,6\n", "column 'X2'", "rename it"),
    "payload below zero": ("q1,q2,x1,y1,z1,payload\n1,2,3,4,5,-1\n", "line 2, column payload", "0 kg or more"),
    "payload empty": ("q1,q2,x1,y1,z1,payload\n1,2,3,4,5,\n", "line 2, column payload", "fill it"),
    "payload infinite": ("q1,q2,x1,y1,z1,payload\n1,2,3,4,5,inf\n", "line 2, column payload", "finite"),
    "word": ("q1,q2,x1,y1,z1\n1,2,3,4,5\n1,two,3,4,5\n", "line 3, column q2", "'two'"),
    "two decimal marks": ("q1;q2;x1;y1;z1\n1;2,5;3.5;4;5\n", "line 2, column q2", "decimal point"),
    "nan": ("q1,q2,x1,y1,z1\n1,2,nan,4,5\n", "line 2, column x1", "leave the cell empty"),
    "infinite": ("q1,q2,x1,y1,z1\n1,2,1e999,4,5\n", "line 2, column x1", "finite"),
    "underscore": ("q1,q2,x1,y1,z1\n1,2_0,3,4,5\n", "line 2, column q2", "finite number"),
    "joint empty": ("q1,q2,x1,y1,z1\n1,,3,4,5\n", "line 2, column q2", "an empty cell"),
    "partly measured": ("q1,q2,x1,y1,z1\n1,2,3,,5\n", "line 2, column x1, y1, z1", "all three or none"),
    "ragged": ("q1,q2,x1,y1,z1\n1,2,3,4\n", "line 2", "5 cells"),
    "twice": ("q1,q1,q2,x1,y1,z1\n1,1,2,3,4,5\n", "q1 twice", "each column name once"),
    "std incomplete": ("q1,q2,x1,y1,z1,std_x1\n1,2,3,4,5,1\n", "no column std_y1, std_z1", "std_x1"),
    "std zero": ("q1,q2,x1,y1,z1,std_x1,std_y1,std_z1\n1,2,3,4,5,1,0,1\n", "column std_y1", "> 0 [m]"),
    "quote": ('q1,q2,x1,y1,z1\n1,2,3,4,"5\n', "text of line 2", "quotes enclose"),
    "binary": (b"\x89PNG\r\n\x1a\n", "file", "a PNG picture; export the table as CSV"),
}


@pytest.mark.parametrize("case", BAD)
def test_flaws_are_named(tmp_path: Path, case: str) -> None:
    content, where, advice = BAD[case]
    path = put(tmp_path, content)
    with pytest.raises(FileFormatError) as caught:
        read_data(path, PLANAR)
    message = str(caught.value)
    assert str(path) in message and where in message and advice in message


@pytest.mark.parametrize("cell", ["0", "1.5", "-1", "1e9"])
def test_repetitions_are_whole(tmp_path: Path, cell: str) -> None:
    with pytest.raises(FileFormatError, match=r"line 2, column repetitions.*whole number"):
        read_plan_csv(put(tmp_path, f"q1,q2,repetitions\n0,0,{cell}\n"), PLANAR)


def test_huge_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path, GOOD + "0.1,0.2,1,2,3\n" * 10)
    monkeypatch.setattr(table, "MAX_ROWS", 5)
    with pytest.raises(FileFormatError, match="at most 5, got 11; split the file"):
        read_data(path, PLANAR)
    monkeypatch.setattr(text, "MAX_BYTES", 100)
    with pytest.raises(FileFormatError, match="a larger file"):
        read_data(path, PLANAR)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path, word in ((tmp_path / "none.csv", "check the path"), (tmp_path, "a rosbag2 folder")):
        with pytest.raises(FileFormatError, match=word):
            read_data(path, PLANAR)
