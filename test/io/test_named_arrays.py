# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Arrays under names, in the shapes in which programs write them: what each means, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from calib_planner import FileFormatError, Measurements, Robot
from calib_planner.io import named_arrays, read_data

ROBOT = Robot.load("planar_2r")
Q = np.array([[0.1, 0.2], [0.3, -0.4], [0.5, 0.6], [-0.7, 0.8]])
P = ROBOT.positions(Q)[:, 0]


def read(path: Path) -> Measurements:
    return read_data(path, ROBOT).data


def written(folder: Path, document: object) -> Path:
    (folder / "data.json").write_text(json.dumps(document))
    return folder / "data.json"


def assert_same(data: Measurements, points: np.ndarray = P) -> None:
    np.testing.assert_allclose(data.q, Q, atol=1e-15)
    np.testing.assert_allclose(data.p[:, 0], points, atol=1e-15)


@pytest.mark.parametrize("units", ["mm deg", "deg, mm", ["mm", "deg"], {"p": "mm", "q": "deg"}])
def test_units_beside_the_arrays_of_a_json_file_count(tmp_path: Path, units: object) -> None:
    """As words, or by the names of the arrays."""
    document = {"units": units, "q": np.degrees(Q).tolist(), "p": (1e3 * P).tolist()}
    assert_same(read(written(tmp_path, document)))


def test_units_that_are_none_say_nothing(tmp_path: Path) -> None:
    assert_same(read(written(tmp_path, {"units": 5, "q": Q.tolist(), "p": P.tolist()})))


def test_points_of_records_may_be_objects_and_absent(tmp_path: Path) -> None:
    rows: list[dict[str, object]] = [
        {"q": q.tolist(), "p": dict(zip("xyz", p, strict=True))} for q, p in zip(Q, P, strict=True)
    ]
    rows[2]["p"] = None
    del rows[3]["p"]
    missing = P.copy()
    missing[2:] = np.nan
    assert_same(read(written(tmp_path, rows)), missing)


def test_lists_of_records_may_be_absent(tmp_path: Path) -> None:
    rows = [{"q": q.tolist(), "p": p.tolist()} for q, p in zip(Q, P, strict=True)]
    rows[1]["p"] = None  # type: ignore[assignment]
    missing = P.copy()
    missing[1] = np.nan
    assert_same(read(written(tmp_path, rows)), missing)


@pytest.mark.parametrize(("document", "kind"), [(3, "int"), ("text", "str"), (True, "bool"), (None, "NoneType")])
def test_json_that_is_no_table_is_refused(tmp_path: Path, document: object, kind: str) -> None:
    with pytest.raises(FileFormatError, match=f"a table, got JSON with a {kind}"):
        read(written(tmp_path, document))


def test_a_struct_array_of_matlab_is_a_row_per_struct(tmp_path: Path) -> None:
    rows = np.zeros((len(Q), 1), [("q", object), ("p", object)])
    for row, q, p in zip(rows[:, 0], Q, P, strict=True):
        row["q"], row["p"] = q[None], p[None]
    savemat(tmp_path / "data.mat", {"visits": rows})
    assert_same(read(tmp_path / "data.mat"))


def test_cells_of_matlab_play_no_part(tmp_path: Path) -> None:
    labels = np.array([["a"], ["b"]], dtype=object)
    savemat(tmp_path / "data.mat", {"q": Q, "p": P, "remarks": labels})
    assert_same(read(tmp_path / "data.mat"))


def test_numbers_and_texts_keep_their_rows(tmp_path: Path) -> None:
    labels = np.array(["one", "two words", "", "four"])
    np.savez(tmp_path / "data.npz", q=Q, p=P, label=labels, count=np.arange(4))
    source = read_data(tmp_path / "data.npz", ROBOT)
    assert_same(source.data)
    assert source.ignored == ("label", "count")


def test_arrays_of_standard_deviations_are_of_the_points(tmp_path: Path) -> None:
    sigma = np.full((4, 3), 1e-5) * [1.0, 2.0, 3.0]
    np.savez(tmp_path / "data.npz", q=Q, p=P, sigma=sigma)
    data = read(tmp_path / "data.npz")
    assert_same(data)
    np.testing.assert_allclose(np.asarray(data.std)[:, 0], sigma)


def test_points_without_a_row_for_every_visit_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "data.npz", q=Q, p1=P, p2=P[:3], temperature=np.zeros(9))
    with pytest.raises(FileFormatError, match="variables: expected 4 rows, as the others, got p2: 3 rows"):
        read(tmp_path / "data.npz")


def test_more_numbers_than_a_table_may_have_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez(tmp_path / "data.npz", q=Q, p=P)
    monkeypatch.setattr(named_arrays, "MOST_VALUES", Q.size + P.size)
    assert_same(read(tmp_path / "data.npz"))
    monkeypatch.setattr(named_arrays, "MOST_VALUES", Q.size + P.size - 1)
    with pytest.raises(FileFormatError, match="at most 19"):
        read(tmp_path / "data.npz")
