# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Several files of measurements are one set of rows, if they say the same kinds of things."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import FileFormatError, Measurements, Robot
from calib_planner.io import Reading, read_sources, write_measurements

ROBOT = Robot.load("planar_2r")


def data(seed: int, rows: int = 4) -> Measurements:
    q = random_configurations(ROBOT, rows, seed)
    return Measurements(ROBOT.joint_names, q, ROBOT.positions(q), np.full((rows, 1, 3), 1e-5), np.full(rows, 2.0))


def files(folder: Path, *parts: Measurements) -> list[str]:
    paths = [folder / f"part{k}.csv" for k in range(len(parts))]
    for path, part in zip(paths, parts, strict=True):
        write_measurements(path, part)
    return [str(path) for path in paths]


def read(paths: list[str]):
    return read_sources(paths, ROBOT, Reading(), noise_given=False)


def test_rows_follow_each_other_and_know_where_they_came_from(tmp_path: Path) -> None:
    one, two = data(1), data(2, 3)
    paths = files(tmp_path, one, two)
    both = read(paths)
    np.testing.assert_array_equal(both.data.q, np.concatenate([one.q, two.q]))
    np.testing.assert_array_equal(np.asarray(both.data.payload), np.full(7, 2.0))
    assert both.where(0) == f"line 2 of {paths[0]}" and both.where(4) == f"line 2 of {paths[1]}"
    assert both.where(6) == f"line 4 of {paths[1]}"
    with pytest.raises(IndexError):
        both.where(7)


@pytest.mark.parametrize(
    ("left_out", "needle"),
    [({"payload": None}, "no column payload; add it: 0"), ({"std": None}, "no std_… columns; add them")],
)
def test_what_one_file_says_and_another_does_not_is_refused(
    tmp_path: Path, left_out: dict[str, None], needle: str
) -> None:
    paths = files(tmp_path, data(1), replace(data(2), **left_out))
    with pytest.raises(FileFormatError, match=needle) as caught:
        read(paths)
    assert caught.value.path == paths[1]


def test_files_of_several_numbers_of_targets_are_refused(tmp_path: Path) -> None:
    robot = ROBOT.with_targets(np.zeros((2, 3)))
    q = random_configurations(robot, 4, 3)
    paths = files(tmp_path, data(1), Measurements(robot.joint_names, q, robot.positions(q)))
    with pytest.raises(FileFormatError, match=r"points: expected 1, as in .*part0\.csv, got 2 targets"):
        read(paths)
