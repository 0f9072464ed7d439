# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Plan sheets as CSV and YAML come back to the bit, and the CSV is read as a plan by whatever reads one."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from robots import mixed, plan_of, random_configurations

from calib_planner import Robot
from calib_planner.arrays import plain
from calib_planner.errors import InputError
from calib_planner.io import parse_urdf, read_plan_csv, write_sheet_csv, write_sheet_yaml
from calib_planner.io.plan import sheet_csv
from calib_planner.io.table import read_table
from calib_planner.planning import PlanSheet, TrackerRange, plan_sheet

ANGLES = st.floats(-7, 7, allow_subnormal=True)


def sheets() -> dict[str, PlanSheet]:
    kuka, other = Robot.load("kuka_kr270"), mixed()
    view = (TrackerRange(np.array([4.0, 1.5, 1.2]), 1.0, 4.0),)
    made = {
        "kuka": plan_sheet(plan_of(kuka, random_configurations(kuka, 6, 1), 3), kuka),
        "mixed": plan_sheet(plan_of(other, random_configurations(other, 5, 2)), other, view, start=np.zeros(4)),
    }
    return made


@pytest.mark.parametrize("name", ["kuka", "mixed"])
def test_every_number_of_the_csv_comes_back_to_the_bit(name: str, tmp_path: Path) -> None:
    sheet = sheets()[name]
    path = tmp_path / "sheet.csv"
    write_sheet_csv(path, sheet)
    q, repetitions = read_plan_csv(path, sheet.robot)
    np.testing.assert_array_equal(q, sheet.plan.configurations)
    np.testing.assert_array_equal(repetitions, sheet.plan.repetitions)
    table = read_table(path, "a sheet", lambda name: name in sheet.robot.joint_names)
    sight, times = sheet.checks.sight, sheet.timetable

    def column(name: str) -> np.ndarray:
        return table.numbers([table.columns.index(name)], [name], empty=True)[:, 0]

    pairs = {"arrive_s": times.arrive, "leave_s": times.leave, "margin": [m for _, m in sheet.tightest()]}
    for unit, turning in (("rad", True), ("m", False)):
        if f"travel_max_{unit}" in table.columns:
            pairs[f"travel_max_{unit}"] = sheet.total_travel(True, turning)
            pairs[f"travel_sum_{unit}"] = sheet.total_travel(False, turning)
    for t in range(len(sheet.robot.targets)):
        pairs[f"range{t + 1}_m"] = sight.ranges[:, t]
        pairs[f"incidence{t + 1}_rad"] = sight.incidences[:, t]
    for j, (joint, turns) in enumerate(zip(sheet.plan.joint_names, sheet.robot.joint_is_revolute, strict=True)):
        shown = np.degrees(q[:, j]) if turns else 1e3 * q[:, j]
        np.testing.assert_allclose(column(f"{joint}_{'deg' if turns else 'mm'}"), shown, rtol=1e-15)
    for name_of, values in pairs.items():
        np.testing.assert_array_equal(column(name_of), values, err_msg=name_of)
    assert ("travel_max_m" in table.columns) == (name == "mixed")
    rows = list(csv.DictReader(path.read_text().splitlines()))
    words = {row["visible"] for row in rows}
    assert words == ({"not checked"} if name == "kuka" else {"yes", "no"})
    assert [row["breaks"] for row in rows] == ["; ".join(b) for b in sheet.checks.breaks]


@settings(max_examples=40, deadline=None)
@given(q=hnp.arrays(float, (3, 2), elements=ANGLES))
def test_any_float_survives(q: np.ndarray) -> None:
    robot = Robot.load("planar_2r")
    sheet = plan_sheet(plan_of(robot, q), robot)
    rows = [line.split(",") for line in sheet_csv(sheet).splitlines()]
    back = np.array([[float(row[rows[0].index(n)]) for n in robot.joint_names] for row in rows[1:]])
    assert back.tobytes() == q.tobytes()


@pytest.mark.parametrize("name", ["kuka", "mixed"])
def test_the_yaml_is_the_sheet(name: str, tmp_path: Path) -> None:
    sheet = sheets()[name]
    path = tmp_path / "sheet.yaml"
    write_sheet_yaml(path, sheet)
    read = yaml.safe_load(path.read_text())
    assert read.pop("format") == "calib_planner/plan_sheet"
    assert plain(read) == plain(sheet.to_dict())  # equal floats, not close ones
    back = np.array([list(stop["joints"].values()) for stop in read["stops"]])
    assert back.tobytes() == sheet.plan.configurations.tobytes()
    assert read["visible"] is (None if name == "kuka" else False)


def test_joint_names_may_be_anything_but_another_column(tmp_path: Path) -> None:
    template = """<robot name="r"><link name="a"/><link name="b"/><joint name='{}' type="revolute">
      <parent link="a"/><child link="b"/><axis xyz="0 0 1"/><origin xyz="1 0 0"/>
      <limit lower="-1" upper="1"/></joint></robot>"""
    for name in ("a; b", "é &quot;q&quot;", "#1", "joint"):
        robot = parse_urdf(template.format(name), "r.urdf")
        path = tmp_path / "sheet.csv"
        write_sheet_csv(path, plan_sheet(plan_of(robot, np.array([[0.1], [0.2]])), robot))
        assert read_plan_csv(path, robot)[0].tolist() == [[0.1], [0.2]]
    for name in ("order", "repetitions", "leave_s"):
        robot = parse_urdf(template.format(name), "r.urdf")
        with pytest.raises(InputError, match=name):
            sheet_csv(plan_sheet(plan_of(robot, np.array([[0.1]])), robot))
