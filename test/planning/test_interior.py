# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Descents inside the allowed set: known minima on edges, normals by hand, plans as good as a long search's."""

from __future__ import annotations

import numpy as np
import pytest
from robots import repeats

from calib_planner import PlanProblem, Robot, plan
from calib_planner.planning import (
    Feasibility,
    MinimumHeight,
    ReflectorAcceptance,
    Search,
    TrackerElevation,
    TrackerRange,
    WorkspaceBox,
)
from calib_planner.planning.constraints import Custom
from calib_planner.planning.feasibility import PlanWalls
from calib_planner.planning.search.interior import HALVINGS, _direction, descend_inside

STATION = np.array([4.0, 1.5, 1.2])
WIDE = np.full(4, 9.0)


class Disc:
    """Two points of the plane a row, each within the unit disc, and left of ``right`` without a margin."""

    def __init__(self, right=np.inf):
        self.right = right

    def margins(self, x):
        return 1.0 - np.sum(x.reshape(len(x), 2, 2) ** 2, axis=2, keepdims=True)

    def normals(self, x):
        return -2.0 * x.reshape(len(x), 2, 1, 2)

    def step(self, old, new, margins, normals):
        promised = margins + np.einsum("rckj,rcj->rck", normals, (new - old).reshape(len(new), 2, 2))
        points = new.reshape(len(new), 2, 2)
        radius = np.sqrt(np.sum(points**2, axis=2, keepdims=True))
        points = np.where(radius > 1.0, points / radius * np.sqrt(1.0 - np.clip(promised, 0.0, 0.5)), points)
        ok = points[..., 0] <= self.right
        x = np.where(ok[..., None], points, old.reshape(points.shape)).reshape(new.shape)
        return x, self.margins(x)


def squares(centre, weights):
    """½ Σ w (x − c)²."""

    def objective(x):
        return 0.5 * np.sum(weights * (x - centre) ** 2, axis=1), weights * (x - centre)

    return objective


@pytest.mark.parametrize("seed", range(3))
def test_minima_on_a_circle_and_inside(seed):
    """Of equal weights the nearest point of the disc: c/|c| outside of it, c within."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, 2)
    centre = np.concatenate([3.0 * np.array([np.cos(angle[0]), np.sin(angle[0])]), 0.5 * np.cos(angle)])
    start = rng.uniform(-0.5, 0.5, (6, 4))
    ended = descend_inside(squares(centre, np.ones(4)), Disc(), start, -WIDE, WIDE, pressures=(1e-2, 1e-7))
    wanted = np.concatenate([centre[:2] / 3.0, centre[2:]])
    np.testing.assert_allclose(ended.x, np.tile(wanted, (6, 1)), atol=1e-3)
    assert (Disc().margins(ended.x) > 0).all()


def test_the_edge_is_followed_a_long_way():
    """Unequal weights: the minimum on the circle, a quarter turn from the start, is where ∇f is radial."""
    weights, centre = np.array([1.0, 30.0, 1.0, 30.0]), np.array([0.3, 3.0, 3.0, 0.1])
    start = np.array([[0.99, 0.0, 0.0, -0.99]])
    ended = descend_inside(squares(centre, weights), Disc(), start, -WIDE, WIDE, pressures=(1e-2, 1e-7))
    points = ended.x.reshape(2, 2)
    force = (weights * (centre - ended.x)).reshape(2, 2)
    assert np.abs(points[:, 0] * force[:, 1] - points[:, 1] * force[:, 0]).max() < 0.05
    assert (np.sum(points * force, axis=1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-4)


def test_joint_limits_and_a_mere_no_hold_beside_the_margins():
    objective = squares(np.array([3.0, 0.0, 0.0, 3.0]), np.ones(4))
    low, high = np.array([-9.0, -9.0, -9.0, -9.0]), np.array([9.0, 9.0, 9.0, 0.5])
    ended = descend_inside(objective, Disc(right=0.4), np.zeros((1, 4)), low, high)
    x = ended.x[0]
    assert x[0] <= 0.4 and x[3] <= 0.5
    np.testing.assert_allclose(x[2:], [0.0, 0.5], atol=1e-3)
    assert x[0] > 0.3  # rejected steps are shortened, not given up


class Planes:
    """Two points of the plane a row, each below ``edges`` (2,): walls that are their own tangents."""

    def __init__(self, edges):
        self.edges, self.steps = np.array(edges), 0

    def margins(self, x):
        return self.edges - x.reshape(len(x), 2, 2)

    def normals(self, x):
        return np.tile(-np.eye(2), (len(x), 2, 1, 1))

    def step(self, old, new, margins, normals):
        self.steps += 1
        left = self.margins(new)
        assert (left >= 0.05 * margins - 1e-12).all()  # no step goes more than 0.95 of the way to an edge
        return new, left


class NoWalls(Planes):
    def margins(self, x):
        return np.zeros((len(x), 2, 0))

    def normals(self, x):
        return np.zeros((len(x), 2, 0, 2))


def counted(objective, walls, start, **settings):
    """``descend_inside`` within ±9, and the number of its iterations."""
    calls = []
    ended = descend_inside(objective, walls, start, -WIDE, WIDE, cancel=lambda: bool(calls.append(0)), **settings)
    return ended, len(calls)


@pytest.mark.parametrize(("pressure", "most"), [(1.0, 9), (1e-2, 14), (1e-5, 16)])
def test_steps_are_newtons_on_the_barrier(pressure, most):
    """½(x − c)² − µ log(b − x) is least where (x − c)(b − x) + µ = 0. With B exact from the first step, the steps
    are those of the primal-dual method, which double the digits at every step near its end."""
    rng = np.random.default_rng(0)
    edges, centre = np.array([0.7, 1.5]), np.array([3.0, -0.5, 0.8, 2.0])
    b = np.tile(edges, 2)
    wanted = 0.5 * (b + centre - np.sqrt((b - centre) ** 2 + 4.0 * pressure))
    start = rng.uniform(-1.5, 0.6, (5, 4))
    settings = {"pressures": (pressure, pressure), "tolerance": 1e-14}
    ended, count = counted(squares(centre, np.ones(4)), Planes(edges), start, **settings)
    np.testing.assert_allclose(ended.x, np.tile(wanted, (5, 1)), rtol=1e-7)
    np.testing.assert_allclose(ended.value, 0.5 * np.sum((wanted - centre) ** 2), rtol=1e-6)
    assert count <= most
    del settings["tolerance"]
    assert counted(squares(centre, np.ones(4)), Planes(edges), start, **settings)[1] <= count  # 1e-7 by default


def test_a_direction_solves_the_newton_equations():
    """(1) with B = H⁻¹, assembled whole; coordinates on a bound that are pushed against it stay."""
    rng = np.random.default_rng(3)
    rows, size, joints, walls = 3, 2, 3, 4
    half, total = rng.normal(size=(rows, 6, 6)), rng.normal(size=(rows, 6))
    inverse = half @ np.swapaxes(half, 1, 2) + np.eye(6)
    weights, normals = rng.uniform(0.1, 3.0, (rows, size, walls)), rng.normal(size=(rows, size, walls, joints))
    low, high, x = -np.ones(6), np.ones(6), np.zeros((rows, 6))
    x[1, 4] = np.sign(-total[1, 4])
    got = _direction(x, total, inverse, weights, normals, low, high)
    for row in range(rows):
        free = [i for i in range(6) if (row, i) != (1, 4)]
        matrix = np.linalg.inv(inverse[row][np.ix_(free, free)])
        for c in range(size):
            for k in range(walls):
                a = np.zeros(6)
                a[c * joints : (c + 1) * joints] = normals[row, c, k]
                matrix += weights[row, c, k] * np.outer(a[free], a[free])
        expected = np.zeros(6)
        expected[free] = -np.linalg.solve(matrix, total[row, free])
        np.testing.assert_allclose(got[row], expected, rtol=1e-8, atol=1e-12)
    uphill = _direction(x, total, -np.tile(np.eye(6), (rows, 1, 1)), 0.0 * weights, normals, low, high)
    np.testing.assert_allclose(uphill, -np.where(x != 0.0, 0.0, total))  # then it goes down steepest


def test_a_first_step_has_its_length_and_gains_a_share_of_what_the_slope_promises():
    """f = −x has fallen by 0.2 behind a step of 0.2, by less than 10⁻⁴ of that if f soon rises again: then a
    quarter of the step is taken."""

    def straight(x):
        return -x[:, 0], np.tile([-1.0, 0.0, 0.0, 0.0], (len(x), 1))

    def wavy(x):
        return np.where(x[:, 0] > 0.1, -1e-5, -x[:, 0]), straight(x)[1]

    ended, _ = counted(straight, NoWalls([0, 0]), np.zeros((1, 4)), iterations=1)
    np.testing.assert_allclose(ended.x, [[0.2, 0.0, 0.0, 0.0]])
    ended, _ = counted(straight, NoWalls([0, 0]), np.zeros((1, 4)), iterations=1, first_step=1.5)
    np.testing.assert_allclose(ended.x, [[1.0, 0.0, 0.0, 0.0]])  # no longer than the gradient
    ended, count = counted(wavy, NoWalls([0, 0]), np.zeros((1, 4)), iterations=1)
    np.testing.assert_allclose(ended.x, [[0.05, 0.0, 0.0, 0.0]])
    assert (count, ended.evaluations) == (1, 3)
    assert counted(wavy, NoWalls([0, 0]), np.zeros((1, 4)), iterations=3, tolerance=0.0)[1] == 3


def test_a_row_ends_when_it_gains_nothing_twice_or_fails_twice():
    """At the last pressure; where nothing is finite but the start, and one step, a fresh search follows the
    failed one."""
    bowl, start = squares(np.zeros(4), np.ones(4)), np.full((1, 4), 0.5)
    same = {"pressures": (1e-3, 1e-3)}
    assert counted(bowl, NoWalls([0, 0]), start, tolerance=np.inf, **same)[1] == 2
    valley = squares(np.zeros(4), np.array([1.0, 30.0, 2.0, 9.0]))
    falling = {"pressures": (1e-3, 1e-4)}
    assert counted(valley, NoWalls([0, 0]), start, tolerance=np.inf, **falling)[1] == 3 + 2  # 0.4³ < 0.1
    with np.errstate(all="raise"):  # a start at the minimum has no direction
        still, count = counted(bowl, NoWalls([0, 0]), np.zeros((1, 4)), **same)
    assert count == 1 and not still.x.any()
    for good, iterations in ((1, 1), (2, 3)):
        calls = []

        def failing(x, calls=calls, good=good):
            calls.append(0)
            value, gradient = bowl(x)
            return np.where(len(calls) <= good, value, np.inf), gradient

        ended, count = counted(failing, NoWalls([0, 0]), start, **same)
        assert count == iterations and ended.evaluations == len(calls) == good + HALVINGS * (
            (iterations + 1) // 2
        )


# ── the walls of a robot ─────────────────────────────────────────────────────────────────────────────────


def room():
    robot = Robot.load("kuka_kr270")
    constraints = (
        WorkspaceBox([0.3, -2.0, 0.3], [3.0, np.inf, 2.5]),
        TrackerRange(STATION, 1.0, 6.0),
        TrackerElevation(STATION, low=-0.8, high=1.0),
        ReflectorAcceptance(STATION, [1, 0, 0], np.pi / 6),
        MinimumHeight(0.2),
    )
    return robot, Feasibility(robot, constraints)


def test_normals_by_hand():
    """From ∂p/∂q and the joints' axes; the constraints themselves take differences."""
    robot, feasible = room()
    q = feasible.sample(np.random.default_rng(0), 8)
    normals = PlanWalls(feasible, 2).normals(q.reshape(4, -1)).reshape(8, -1, 6)
    by_joint = robot.joint_jacobian(q)  # (N, 3, joints)
    p = robot.positions(q)[:, 0]
    beam = p - STATION
    d = np.linalg.norm(beam, axis=1)[:, None]
    along = np.einsum("ni,nij->nj", beam / d, by_joint)
    box = np.concatenate([by_joint, -by_joint[:, [0, 2]]], axis=1)
    level = np.hypot(beam[:, 0], beam[:, 1])[:, None]
    rise = by_joint[:, 2] / level - beam[:, 2:] / (level * d) * along  # d arcsin(h/d)
    posture = robot.posture(q)
    normal = posture.tip_rotation[:, :, 0]
    turning = np.cross(posture.joint_axes, normal[:, None])  # (N, joints, 3)
    facing = -np.einsum("nji,ni->nj", turning, beam / d) - np.einsum("ni,nij->nj", normal, by_joint) / d
    facing += np.sum(normal * beam, axis=1)[:, None] / d**2 * along
    hand = np.concatenate(
        [box, along[:, None], -along[:, None], rise[:, None], -rise[:, None], facing[:, None]], 1
    )
    np.testing.assert_allclose(normals[:, : hand.shape[1]], hand, atol=2e-5)


def test_steps_end_inside_and_keep_what_the_tangent_promised():
    """A step along the tangent leaves the set by the curvature; it comes back nearly whole."""
    _, feasible = room()
    walls = PlanWalls(feasible, 1)
    q = feasible.sample(np.random.default_rng(1), 300)
    margins, normals = walls.margins(q), walls.normals(q)
    nearest = np.argmin(margins[:, 0], axis=1)
    a = normals[np.arange(300), 0, nearest]
    rng = np.random.default_rng(2)
    d = rng.normal(size=q.shape)
    d -= np.sum(d * a, axis=1)[:, None] / np.sum(a * a, axis=1)[:, None] * a
    low, high = feasible.limits.T
    new = np.clip(q + 0.05 * d, low, high)
    reached, left = walls.step(q, new, margins, normals)
    assert feasible.mask(reached).all()
    np.testing.assert_allclose(left, walls.margins(reached), atol=1e-15)
    outside = ~feasible.mask(new)
    assert outside.sum() > 10
    share = np.linalg.norm(reached - q, axis=1) / np.linalg.norm(new - q, axis=1)
    assert np.median(share[outside]) > 0.8


def test_one_edge_brings_back_and_where_nothing_else_is_allowed_a_configuration_stays():
    robot = Robot.load("planar_2r")
    wall = WorkspaceBox([1.2, -np.inf, -np.inf], [np.inf] * 3)
    walls = PlanWalls(Feasibility(robot, (wall,)), 1)
    q = walls.feasibility.sample(np.random.default_rng(1), 2000)
    q = q[(walls.margins(q)[:, 0, 0] < 0.05) & (np.abs(robot.joint_jacobian(q)[:, 0, 1]) > 0.1)]
    margins, normals = walls.margins(q), walls.normals(q)
    assert margins.shape == (len(q), 1, 1)
    a = normals[:, 0, 0]
    along = np.stack([-a[:, 1], a[:, 0]], axis=1) / np.linalg.norm(a, axis=1)[:, None]
    new = q + 0.2 * along - 0.9 * margins[:, 0] * a / np.sum(a**2, axis=1)[:, None]
    outside = ~walls.feasibility.mask(new)
    reached, _ = walls.step(q, new, margins, normals)
    share = np.linalg.norm(reached - q, axis=1) / np.linalg.norm(new - q, axis=1)
    assert outside.sum() > 5 and np.median(share[outside]) > 0.8
    allowed = q.copy()
    here = Custom("here", lambda rows: (np.abs(rows[:, None] - allowed[None]).max(axis=2) < 1e-12).any(axis=1))
    fixed = PlanWalls(Feasibility(robot, (here,)), 1)
    stayed, _ = fixed.step(q, new, fixed.margins(q), fixed.normals(q))
    np.testing.assert_array_equal(stayed, q)


def test_constraints_give_margins_or_only_masks():
    robot, feasible = room()
    q = feasible.sample(np.random.default_rng(3), 50)
    half = Custom("half", lambda q: q[:, 0] < 0)
    both = Feasibility(robot, (*feasible.constraints, half))
    assert feasible.masks == () and both.masks == (half,)
    ok, margins = both.measured(q)
    np.testing.assert_array_equal(ok, both.mask(q))
    np.testing.assert_array_equal(margins, feasible.margins(q))


@pytest.mark.parametrize("seed", repeats(range(1), range(2)))
def test_plans_along_the_edge(seed):
    """A long search (40 times the starts) reaches LONG, one of 24 starts 1.2 % more at most, of five seeds."""
    robot, feasible = room()
    pose = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])
    search = Search(starts=24, seed=seed)
    found = plan(PlanProblem(robot, pose, 6, constraints=feasible.constraints, search=search))
    assert feasible.mask(found.configurations).all()
    assert found.quality.predicted_accuracy < LONG * 1.015


LONG = 23.79e-6
"""ρ0 of that search [m]."""
