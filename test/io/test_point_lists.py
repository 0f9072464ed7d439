# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Points in files of their own: matched by name, by time or by order, and it is said which."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from layouts import DATA, ROBOT

from calib_planner import FileFormatError, InputError
from calib_planner.io import Reading, read_data
from calib_planner.units import Units

COUNT = 12
Q, P = DATA.q[:COUNT], DATA.p[:COUNT, 0]
TIMES = np.cumsum(np.random.default_rng(2).uniform(2.0, 4.0, COUNT))
NAMES = [f"P{i}" for i in range(1, COUNT + 1)]
BEGIN = datetime(2026, 11, 28, 9, 0, 0)


def joints_file(folder: Path, keys: Sequence[str] = (), key: str = "", *, degrees: bool = False) -> Path:
    q = np.rad2deg(Q) if degrees else Q
    rows = [",".join([*([keys[i]] if keys else []), *map(repr, row)]) for i, row in enumerate(q.tolist())]
    path = folder / "joints.csv"
    path.write_text("\n".join([",".join([*([key] if keys else []), *ROBOT.joint_names]), *rows]) + "\n")
    return path


def points_file(
    folder: Path,
    keys: Sequence[str] = (),
    header: str = "",
    *,
    order: Sequence[int] = range(COUNT),
    separator: str = " ",
    scale: float = 1.0,
    name: str = "points.txt",
) -> Path:
    rows = [separator.join([*([keys[i]] if keys else []), *map(repr, (scale * P[i]).tolist())]) for i in order]
    path = folder / name
    path.write_text("\n".join([*filter(None, [header]), *rows]) + "\n")
    return path


def read(joints: Path, *points: Path, **how: object) -> tuple[np.ndarray, str]:
    """(rows, targets, 3) the points of each row, and the line that is said."""
    told: list[str] = []
    source = read_data(joints, ROBOT, Reading(points=tuple(map(str, points)), note=told.append, **how))
    np.testing.assert_allclose(source.data.q, Q, rtol=0, atol=1e-12)
    assert len(told) == 1
    return source.data.p, told[0]


SHUFFLED = np.random.default_rng(1).permutation(COUNT).tolist()
CLOCK = [(BEGIN + timedelta(seconds=float(t))).strftime("%H:%M:%S.%f") for t in TIMES]
ISO = [(BEGIN + timedelta(seconds=float(t))).isoformat() for t in TIMES]
GERMAN = [(BEGIN + timedelta(seconds=float(t))).strftime("%d.%m.%Y %H:%M:%S") for t in TIMES]


def late(texts: Sequence[float]) -> list[str]:
    return [repr(t + 0.3) for t in texts]


CASES: dict[str, tuple[Sequence[str], str, dict, str]] = {
    # keys of the joints, their heading, the list of points, how they are matched
    "names": (NAMES, "name", {"keys": NAMES, "order": SHUFFLED}, "name"),
    "names, a header of the list": (
        NAMES,
        "point",
        {"keys": NAMES, "header": "Point X Y Z", "order": SHUFFLED},
        "name",
    ),
    "folders of SpatialAnalyzer": (
        NAMES,
        "name",
        {"keys": [f"A::Main::{n}" for n in NAMES], "order": SHUFFLED, "separator": ", "},
        "name",
    ),
    "numbers at the end": (
        [str(i) for i in range(1, COUNT + 1)],
        "No",
        {"keys": [f"meas{i:03d}" for i in range(1, COUNT + 1)], "order": SHUFFLED, "separator": "\t"},
        "name",
    ),
    "times": (
        [repr(t) for t in TIMES.tolist()],
        "time",
        {"keys": late(TIMES.tolist()), "order": SHUFFLED, "header": "t x y z"},
        "time",
    ),
    "times without header": ([repr(t) for t in TIMES.tolist()], "t [s]", {"keys": late(TIMES.tolist())}, "time"),
    "dates": (
        ISO,
        "timestamp",
        {"keys": ISO, "header": "time;x;y;z", "separator": ";", "order": SHUFFLED},
        "time",
    ),
    "times of day": (CLOCK, "time", {"keys": CLOCK, "separator": ";"}, "time"),
    "German dates": (GERMAN, "Zeit", {"keys": GERMAN, "separator": ";"}, "time"),
    "order": ((), "", {}, "order"),
    "order, names on one side": ((), "", {"keys": NAMES}, "order"),
    "order, millimetres by size": ((), "", {"scale": 1e3}, "order"),
    "order, millimetres written": ((), "", {"scale": 1e3, "header": "x[mm] y[mm] z[mm]"}, "order"),
}


@pytest.mark.parametrize("name", CASES)
def test_points_belong_to_their_rows(tmp_path: Path, name: str) -> None:
    keys, heading, how, match = CASES[name]
    points, told = read(joints_file(tmp_path, keys, heading), points_file(tmp_path, **how))
    np.testing.assert_allclose(points[:, 0], P, rtol=0, atol=1e-12)
    assert f"by {match}: {COUNT} of {COUNT} rows" in told and "points.txt" in told


def test_two_reflectors_have_a_list_each_and_some_points_are_missing(tmp_path: Path) -> None:
    one = points_file(tmp_path, NAMES, order=SHUFFLED[2:], name="one.txt")
    two = points_file(tmp_path, [*NAMES], order=SHUFFLED[:-3], name="two.txt", scale=1e3)
    with open(two, "a") as file:
        file.write("drift_check 1 2 3\n")
    points, told = read(joints_file(tmp_path, NAMES, "name", degrees=True), one, two)
    seen = ~np.isnan(points[:, :, 0])
    expected = np.ones((COUNT, 2), bool)
    expected[SHUFFLED[:2], 0] = False
    expected[SHUFFLED[-3:], 1] = False
    np.testing.assert_array_equal(seen, expected)
    for t in range(2):
        np.testing.assert_allclose(points[seen[:, t], t], P[seen[:, t]], rtol=0, atol=1e-12)
    assert "10 of 12 rows" in told and "9 of 12 rows, 1 point of no row" in told and "angles in deg" in told


def test_what_is_stated_wins(tmp_path: Path) -> None:
    joints = joints_file(tmp_path, NAMES, "name")
    points, told = read(joints, points_file(tmp_path, NAMES[::-1]), match="order")
    np.testing.assert_allclose(points[:, 0], P, rtol=0, atol=1e-12)
    assert "by order" in told
    swapped = points_file(tmp_path, NAMES, order=SHUFFLED, header="a b c d")
    points, _ = read(joints, swapped, point_columns=("name", "x", "y", "z"), units=Units("m", "rad"))
    np.testing.assert_allclose(points[:, 0], P, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="name, time, order"):
        read(joints, swapped, match="colour")


def test_names_that_do_not_agree_are_said(tmp_path: Path) -> None:
    names = [f"Q-{chr(97 + i)}" for i in range(COUNT)]
    _, told = read(joints_file(tmp_path, NAMES, "name"), points_file(tmp_path, names))
    assert "by order (not by name: names such as 'P1' here and 'Q-a' there): 12 of 12 rows" in told


def test_points_that_belong_to_nothing_are_refused(tmp_path: Path) -> None:
    joints = joints_file(tmp_path, NAMES, "name")
    short = points_file(tmp_path, order=range(5))
    with pytest.raises(FileFormatError, match="5 points for 12 rows") as caught:
        read(joints, short)
    assert "no names in" in str(caught.value) and "no times in" in str(caught.value)
    with pytest.raises(FileFormatError, match="by name: no names in"):
        read(joints, short, match="name")
    twice = points_file(tmp_path, ["P1", *NAMES[:-1]])
    with pytest.raises(FileFormatError, match="the name 'P1' is there twice"):
        read(joints, twice, match="name")
    times = joints_file(tmp_path, [repr(t) for t in TIMES.tolist()], "time")
    hours = points_file(tmp_path, [repr(t + 3600.0) for t in TIMES.tolist()][:8], order=range(8))
    with pytest.raises(FileFormatError, match=r"times from \d.* s and from 36\d\d"):
        read(times, hours)
    with pytest.raises(FileFormatError, match="--point-columns"):
        (tmp_path / "strange.txt").write_text("1 2\n3 4\n")
        read(joints, tmp_path / "strange.txt")


def test_a_list_of_points_may_have_standard_deviations_and_all_or_none_have(tmp_path: Path) -> None:
    joints = joints_file(tmp_path, NAMES, "name")
    one, two = tmp_path / "one.csv", points_file(tmp_path, NAMES, name="two.txt")
    rows = [[NAMES[i], *map(repr, (1e3 * P[i]).tolist()), "0.01", "0.02", repr(0.01 * (i + 1))] for i in SHUFFLED]
    one.write_text(
        "name,x[mm],y[mm],z[mm],std_x[mm],std_y[mm],std_z[mm]\n" + "\n".join(map(",".join, rows)) + "\n"
    )
    source = read_data(joints, ROBOT, Reading(points=(str(one),)))
    np.testing.assert_allclose(source.data.p[:, 0], P, rtol=0, atol=1e-12)
    expected = [[1e-5, 2e-5, 1e-5 * (i + 1)] for i in range(COUNT)]
    np.testing.assert_allclose(np.asarray(source.data.std)[:, 0], expected, rtol=1e-9)
    with pytest.raises(FileFormatError, match="no standard deviations; add them, or remove them") as caught:
        read_data(joints, ROBOT, Reading(points=(str(one), str(two))))
    assert caught.value.path == str(two)


def test_one_time_twice_tells_no_row(tmp_path: Path) -> None:
    times = [repr(t) for t in TIMES.tolist()]
    joints = joints_file(tmp_path, [*times[:-1], times[0]], "time")
    points = points_file(tmp_path, times, header="t x y z")
    with pytest.raises(FileFormatError, match="has one time twice"):
        read(joints, points, match="time")
    _, told = read(joints, points)
    assert "by order (not by time: " in told and "has one time twice): 12 of 12 rows" in told


def test_fractions_of_seconds_may_have_any_number_of_digits(tmp_path: Path) -> None:
    """Also more than Python 3.10 reads, and none."""
    texts = [f"2026-11-28 09:00:{10 + i}" + "." * (i > 0) + "1234567"[:i] for i in range(8)]
    texts += [f"2026-11-28T09:00:{30 + i}.5Z" for i in range(4)]
    points, told = read(
        joints_file(tmp_path, texts, "time"),
        points_file(tmp_path, texts, header="time;x;y;z", separator=";", order=SHUFFLED),
    )
    np.testing.assert_allclose(points[:, 0], P, rtol=0, atol=1e-12)
    assert "by time: 12 of 12 rows" in told
