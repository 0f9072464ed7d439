# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Checks of stops against oracles of their own; sheets keep plan and order, and claim nothing unchecked."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pytest
from robots import changed, mixed, plan_of, random_configurations
from scipy.spatial.transform import Rotation

from calib_planner import Robot
from calib_planner.errors import InputError
from calib_planner.io import read_constraints
from calib_planner.planning import Feasibility, ReflectorAcceptance, TrackerElevation, TrackerRange, plan_sheet
from calib_planner.planning.constraints import Custom
from calib_planner.planning.sheet import check_visits, plan_identity
from calib_planner.tracker import Isotropic, LaserTracker

CONSTRAINTS = Path(__file__).resolve().parents[2] / "config" / "constraints.yaml"
STATION, UP, NORMAL = np.array([4.0, 1.5, 1.2]), np.array([0.1, -0.2, 1.0]), np.array([0.3, 0.5, -0.2])


@pytest.fixture
def kuka() -> Robot:
    return Robot.load("kuka_kr270")


def test_reachable_and_visible_together_are_what_a_search_allows(kuka):
    constraints = read_constraints(CONSTRAINTS, kuka)
    q = np.concatenate(
        [
            random_configurations(kuka, 3000, 5),
            Feasibility(kuka, constraints).sample(np.random.default_rng(1), 20),
        ]
    )
    checks = check_visits(kuka, q, constraints)
    assert checks.visible is not None
    np.testing.assert_array_equal(checks.reachable & checks.visible, Feasibility(kuka, constraints).mask(q))
    assert checks.reachable.any() and checks.visible.any() and (checks.reachable != checks.visible).any()
    for reach, view, a, b in zip(
        checks.reachable, checks.visible, checks.reach_breaks, checks.view_breaks, strict=True
    ):
        assert reach == (not a) and view == (not b)
    for constraint in constraints:
        told = [constraint.name in broken for broken in checks.breaks]
        np.testing.assert_array_equal(~np.array(told), constraint.allowed(kuka, q))
    assert "self-collision" in checks.unchecked and "line of sight" not in checks.unchecked


def test_joint_limits_and_margins(kuka):
    q = np.tile(kuka.joint_limits.mean(axis=1), (4, 1))
    q[1, 2] = kuka.joint_limits[2, 1]  # on the limit
    q[2, 2] = kuka.joint_limits[2, 1] + 0.01
    q[3, 0] = kuka.joint_limits[0, 0] + 0.02
    checks = check_visits(kuka, q)
    assert checks.reachable.tolist() == [True, True, False, True]
    assert checks.breaks == [(), (), ("joint limits",), ()]
    assert checks.margins[2, 2] == pytest.approx(-0.01) and checks.margins[1, 2] == 0.0
    sheet = plan_sheet(plan_of(kuka, q), kuka)
    assert sheet.tightest()[1:] == [(2, 0.0), (2, pytest.approx(-0.01)), (0, pytest.approx(0.02))]


def test_nothing_is_said_about_the_view_without_a_tracker(kuka):
    q = random_configurations(kuka, 3)
    for noise in (None, Isotropic(1e-5)):
        checks = check_visits(kuka, q, (Custom("mine", lambda q: q[:, 0] > 9),), noise)
        assert checks.visible is None and checks.sight.station is None
        assert np.isnan(checks.sight.ranges).all() and np.isnan(checks.sight.incidences).all()
        assert checks.checked == ("joint limits", "mine") and not checks.reachable.any()
        assert {"tracker range", "reflector acceptance", "line of sight"} <= set(checks.unchecked)
    told = check_visits(kuka, q, (), LaserTracker(station=STATION))
    assert told.visible is None and np.isfinite(told.sight.ranges).all()  # seen, not judged
    assert np.isfinite(told.sight.elevations).all() and np.isnan(told.sight.incidences).all()


@pytest.mark.parametrize("make", [lambda: Robot.load("kuka_kr270"), mixed], ids=["kuka", "mixed"])
def test_sight_against_plain_geometry(make):
    robot = make().with_base(Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix(), [0.5, -1.0, 0.3])
    q = random_configurations(robot, 20, 7)
    constraints = (TrackerElevation(STATION, UP), ReflectorAcceptance(STATION, NORMAL, 0.5))
    sight = check_visits(robot, q, constraints).sight
    points = robot.positions(q)
    # The normal in the frame of positions: the way from each target to one moved along it.
    ahead = robot.with_targets(robot.target_offsets + NORMAL).positions(q) - points
    for i in range(20):
        for t in range(points.shape[1]):
            beam = points[i, t] - STATION
            assert sight.ranges[i, t] == pytest.approx(np.sqrt(beam @ beam))
            height = beam @ UP / np.linalg.norm(UP)
            level = np.sqrt(beam @ beam - height**2)
            assert sight.elevations[i, t] == pytest.approx(np.arctan2(height, level))
            across = np.linalg.norm(np.cross(ahead[i, t], -beam))
            assert sight.incidences[i, t] == pytest.approx(np.arctan2(across, ahead[i, t] @ -beam), abs=1e-7)


def test_two_stations_give_no_range(kuka):
    q = random_configurations(kuka, 2)
    here, there = TrackerRange(STATION, 0, 100), LaserTracker(station=STATION + 1)
    checks = check_visits(kuka, q, (here,), there)
    assert checks.sight.station is None and np.isnan(checks.sight.ranges).all()
    assert checks.visible is not None and checks.visible.all()
    agreed = check_visits(kuka, q, (here,), LaserTracker(station=STATION))
    np.testing.assert_array_equal(agreed.sight.station, STATION)


def test_a_sheet_keeps_the_plan_and_its_order(kuka):
    q = random_configurations(kuka, 5, 2)
    plan = plan_of(kuka, q, 3)
    turned = replace(
        plan,
        joint_names=plan.joint_names[::-1],
        configurations=q[:, ::-1],
        test_poses=plan.test_poses[:, ::-1],
    )
    for given in (plan, turned):
        sheet = plan_sheet(given, kuka)
        np.testing.assert_array_equal(sheet.plan.configurations, q)
        np.testing.assert_array_equal(sheet.plan.test_poses, q[:1])
        assert sheet.plan.joint_names == kuka.joint_names
        stops = sheet.to_dict()["stops"]
        assert [s["order"] for s in stops] == [1, 2, 3, 4, 5]
        assert [list(s["joints"].values()) for s in stops] == q.tolist()
    np.testing.assert_allclose(np.radians(sheet.degrees), q, rtol=1e-15)
    np.testing.assert_allclose(sheet.total_travel(True, True)[1:], np.abs(np.diff(q, axis=0)).max(axis=1))
    np.testing.assert_allclose(sheet.total_travel(False, True)[1:], np.abs(np.diff(q, axis=0)).sum(axis=1))
    with pytest.raises(FrozenInstanceError):
        sheet.identity = "x"
    with pytest.raises(ValueError, match="read-only"):
        sheet.checks.margins[0, 0] = 0
    with pytest.raises(ValueError, match="read-only"):
        sheet.timetable.arrivals[0] = 0


def test_identity_is_that_of_what_is_measured(kuka):
    q = random_configurations(kuka, 5, 2)
    plan = plan_of(kuka, q)
    assert plan_identity(plan) == plan_identity(changed(plan, seconds=7.0, message="other"))
    nudged = q.copy()
    nudged[4, 5] = np.nextafter(q[4, 5], 9)
    others = [plan_of(kuka, nudged), plan_of(kuka, q, 2), plan_of(kuka, q[::-1])]
    assert len({plan_identity(p) for p in (plan, *others)}) == 4


def test_plans_of_other_robots_and_empty_ones_are_refused(kuka):
    plan = plan_of(Robot.load("planar_2r"), np.zeros((2, 2)))
    with pytest.raises(InputError, match="joint_a1"):
        plan_sheet(plan, kuka)
    empty = plan_of(kuka, np.zeros((0, 6)), test_poses=np.zeros((0, 6)), weights=np.zeros(0))
    with pytest.raises(InputError, match="no configurations"):
        plan_sheet(empty, kuka)
