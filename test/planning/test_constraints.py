# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Each constraint against hand calculation or a plain loop; conflicts are named; plans keep to all of them."""

from __future__ import annotations

import dataclasses
import pickle
from itertools import pairwise

import numpy as np
import pytest
from robots import CASES, mixed, random_configurations

from calib_planner import InfeasibleError, InputError, PlanProblem, Robot, UnknownNameError, plan
from calib_planner.planning import (
    Candidates,
    Feasibility,
    JointRange,
    LineOfSight,
    MinimumHeight,
    ReflectorAcceptance,
    Search,
    TrackerElevation,
    TrackerRange,
    WorkspaceBox,
    feasibility,
)
from calib_planner.planning.constraints import Custom
from calib_planner.robot import Capsules

STATION = np.array([4.0, 1.5, 1.2])
RIGHT, LEFT, UP = [0.0, 0.0], [np.pi, 0.0], [np.pi / 2, 0.0]
TEST_POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])


def planar():
    """Links of 1 m and 0.8 m in the plane z = 0, stretched out along +x, −x or +y by RIGHT, LEFT, UP."""
    return Robot.load("planar_2r")


def allowed(constraint, *rows, robot=None):
    return constraint.allowed(robot or planar(), np.array(rows)).tolist()


# ── by hand, on two links ────────────────────────────────────────────────────────────────────────────


def test_workspace_box():
    reach = planar().positions(RIGHT)[0, 0, 0]
    assert allowed(WorkspaceBox([0, -1, -1], [reach, 1, 1]), RIGHT, LEFT, UP) == [True, False, False]
    assert allowed(WorkspaceBox([0, -1, -1], [reach - 1e-9, 1, 1]), RIGHT) == [False]
    assert allowed(WorkspaceBox([0, -np.inf, -np.inf], [np.inf] * 3), RIGHT, LEFT) == [True, False]
    offset = planar().with_targets([[0, 0, 0.5]])
    box = WorkspaceBox([-3, -3, 0.2], [3, 3, 1])
    assert allowed(box, RIGHT, robot=offset) == [True]
    assert allowed(dataclasses.replace(box, tip=True), RIGHT, robot=offset) == [False]


def test_minimum_height():
    """With up along y the elbow is at 1 m and the tip at 1 + l2 when the arm points up."""
    floor = MinimumHeight(0.9, [0, 2, 0])
    assert allowed(floor, UP, RIGHT, [np.pi / 2, np.pi / 2], [np.pi / 2, -np.pi]) == [True, False, True, False]
    assert allowed(MinimumHeight(0.9, [0, 1, 0], Capsules(0.2)), UP) == [False]
    assert allowed(MinimumHeight(0.9, [0, 1, 0], Capsules([9, 0.05, 0.1])), UP) == [True]
    # The elbow carries the larger of its two radii, the tip that of the last link.
    assert allowed(MinimumHeight(0.9, [0, 1, 0], Capsules([9, 0.05, 0.11])), UP) == [False]
    assert allowed(MinimumHeight(0.9, [0, 1, 0], Capsules([9, 0.11, 0.05])), UP) == [False]
    low_target = planar().with_targets([[0, 0, 0], [-1, 0, 0]])
    assert allowed(floor, UP, robot=low_target) == [False]


def test_a_sliding_first_joint_counts_for_the_height():
    robot = mixed()
    elements = list(robot.elements)
    joints = [i for i, e in enumerate(elements) if e.joint is not None]
    elements[joints[0]] = dataclasses.replace(elements[joints[0]], kind="Tz")
    robot = dataclasses.replace(robot, elements=tuple(elements))
    q = random_configurations(robot, 200)
    heights = robot.posture(q).joint_origins[:, 0, 2]
    assert not MinimumHeight(float(np.median(heights))).allowed(robot, q)[heights < np.median(heights)].any()
    # A ball of the radius of what moves with it, in front of a column that does not.
    margins = MinimumHeight(0.0, capsules=Capsules([0.9, 0.2, 0.0, 0.0, 0.0])).margins(robot, robot.posture(q))
    np.testing.assert_allclose(margins[:, 0], heights - 0.2, atol=1e-15)


def test_tracker_range_and_elevation():
    reach = planar().positions(RIGHT)[0, 0, 0]
    station = [reach + 2.0, 0, 0]
    assert allowed(TrackerRange(station, 1.9, 2.1), RIGHT, LEFT) == [True, False]
    assert allowed(TrackerRange(station, 2.1), RIGHT, LEFT) == [False, True]
    above = [reach, 0.0, 1.0]
    assert allowed(TrackerElevation(above, low=-1.5, high=0), RIGHT, LEFT) == [False, True]
    below = TrackerElevation([reach - 1.0, 0, -1.0], low=np.pi / 4 - 1e-9, high=np.pi / 4 + 1e-9)
    assert allowed(below, RIGHT, LEFT) == [True, False]
    sideways = TrackerElevation([reach - 1.0, 0, -1.0], [1, 0, 0], low=0)
    assert allowed(sideways, RIGHT, LEFT) == [True, False]


def test_reflector_acceptance():
    """The tracker stands 2 m in front of the stretched arm; turning the last link by β tilts the reflector."""
    robot = planar()
    tip = robot.positions(RIGHT)[0, 0]
    for beta, ok in ((0.0, True), (0.2, True), (-0.2, True), (0.7, False)):
        q = [beta, 0.0]
        position = robot.positions(q)[0, 0]
        cone = ReflectorAcceptance(position + np.array([2.0, 0, 0]), [1, 0, 0], 0.21)
        assert allowed(cone, q) == [ok]
    ahead = tip + np.array([2.0, 0, 0])
    behind = ReflectorAcceptance(ahead, [[-3, 0, 0]], np.pi / 6)
    assert allowed(behind, RIGHT) == [False]
    two = robot.with_targets([[0, 0, 0], [0, 0, 0.1]])
    each = ReflectorAcceptance(ahead, [[1, 0, 0], [0, 0, 1]], np.pi / 6)
    assert allowed(each, RIGHT, robot=two) == [False]
    assert allowed(dataclasses.replace(each, normal=[1, 0, 0]), RIGHT, robot=two) == [True]
    with pytest.raises(InputError, match="one, or 2: one per target"):
        allowed(dataclasses.replace(each, normal=np.eye(3)), RIGHT, robot=two)


def test_line_of_sight():
    """The base column stands between the tracker and an arm that points away from it."""
    station = [4.0, 0.0, 0.0]
    assert allowed(LineOfSight(station, Capsules(0.1)), RIGHT, LEFT, UP) == [True, False, True]
    many = planar().with_targets(np.zeros((5, 3)))  # more targets than links
    assert allowed(LineOfSight(station, Capsules(0.1)), RIGHT, LEFT, robot=many) == [True, False]
    # Folded back, the tip hangs 0.2 m beside the base: the first link is in the way of a station behind it.
    folded = [0.0, np.pi]
    assert allowed(LineOfSight([-4.0, 0, 0], Capsules(0.1)), folded) == [False]
    assert allowed(LineOfSight([0.5, 4.0, 0], Capsules(0.1), near=0.3), folded) == [True]
    assert allowed(LineOfSight([0.5, 4.0, 0], Capsules(0.1), near=0.0), folded) == [False]


def test_joint_range():
    part = JointRange({"q2": [0.5, 1.0]})
    assert allowed(part, [3, 0.5], [0, 1.0], [0, 0.4], [0, 1.1]) == [True, True, False, False]
    np.testing.assert_array_equal(part.limits(planar())[1], [0.5, 1.0])
    with pytest.raises(UnknownNameError, match="q1, q2"):
        JointRange({"q3": [0, 1]}).limits(planar())
    with pytest.raises(InfeasibleError, match="degrees"):
        JointRange({"q2": [10, 90]}).limits(planar())
    with pytest.raises(InfeasibleError, match="outside"):  # a single place is no range
        JointRange({"q2": [planar().joint_limits[1, 1], 90]}).limits(planar())
    with pytest.raises(InfeasibleError, match=r"joint range and joint range.*q2"):
        Feasibility(planar(), (part, JointRange({"q2": [1.5, 2]}))).limits


# ── against plain loops, on robots in space ──────────────────────────────────────────────────────────


def plain(robot, q, capsules=None):
    """Per configuration: by how much it keeps the constraints below, one target and link at a time."""
    radii = (capsules or Capsules()).of(robot)
    near = radii[:-1].max()
    for row in q:
        posture = robot.posture(row)
        rotation = posture.tip_rotation[0]
        nodes = [robot.base_pose[1], *posture.joint_origins[0], posture.tip_origin[0]]
        seen, facing, clear = [], [], []
        for p in robot.positions(row)[0]:
            beam = p - STATION
            d = np.linalg.norm(beam)
            elevation = np.arctan2(beam[2], np.hypot(*beam[:2]))
            seen += [d - 2.0, 4.5 - d, elevation + 0.1, 0.4 - elevation]
            facing.append(np.cos(np.arccos(np.clip(rotation[:, 0] @ -beam / d, -1, 1))) - np.cos(1.0))
            share = np.linspace(0, 1, 161)
            on_beam = STATION + share[:, None] * (beam * max(0.0, 1 - near / d))
            for k, (a, b) in enumerate(pairwise(nodes[:-1])):
                on_link = a + share[:, None] * (b - a)
                gap = np.linalg.norm(on_beam[:, None] - on_link[None], axis=2).min()
                clear.append(gap - radii[k])
        yield seen, facing, clear


@pytest.mark.parametrize("case", ["kuka_kr270", "mixed lengths+offsets"])
def test_against_plain_loops(case):
    robot = CASES[case]()
    q = random_configurations(robot, 60, 5)
    posture = robot.posture(q)
    capsules = Capsules(0.15 - 0.02 * np.arange(len(robot.joint_names) + 1))
    seen, facing, clear = (np.array(column) for column in zip(*plain(robot, q, capsules), strict=True))
    range_, elevation = TrackerRange(STATION, 2.0, 4.5), TrackerElevation(STATION, low=-0.1, high=0.4)
    cone, sight = ReflectorAcceptance(STATION, [1, 0, 0], 1.0), LineOfSight(STATION, capsules)
    both = np.concatenate([part.margins(robot, posture) for part in (range_, elevation)], axis=1)
    np.testing.assert_allclose(np.sort(both), np.sort(seen), atol=1e-12)
    np.testing.assert_array_equal(range_.allowed(robot, q) & elevation.allowed(robot, q), (seen >= 0).all(axis=1))
    np.testing.assert_allclose(cone.margins(robot, posture), facing, atol=1e-12)
    np.testing.assert_array_equal(cone.allowed(robot, q), (facing >= 0).all(axis=1))
    over = np.sort(clear) - np.sort(sight.margins(robot, posture))
    assert over.min() > -1e-9 and over.max() < 0.05  # the loop's grid overestimates gaps by less than this
    found, clear = sight.allowed(robot, q), clear.min(axis=1)
    sure = np.abs(clear) > 0.05
    np.testing.assert_array_equal(found[sure], clear[sure] > 0)
    assert 0.1 < found.mean() < 1.0 and sure.mean() > 0.5


@pytest.mark.parametrize("case", ["kuka_kr270", "mixed lengths+offsets"])
def test_margins_of_box_and_floor_are_distances(case):
    robot = CASES[case]()
    q = random_configurations(robot, 20, 6)
    posture, up = robot.posture(q), np.array([0.6, 0.0, 0.8])
    radii = np.arange(1.0, len(robot.joint_names) + 2.0) / 10.0
    box = WorkspaceBox([-1.0, -np.inf, 0.2], [np.inf, 2.0, 1.5], tip=True)
    floor = MinimumHeight(0.3, 2.0 * up, Capsules(radii))
    inside, above = (part.margins(robot, posture) for part in (box, floor))
    assert np.isfinite(inside).all()
    for n in range(len(q)):
        targets, tip = robot.positions(q[n])[0], posture.tip_origin[n]
        sides = [(x + 1.0, 2.0 - y, z - 0.2, 1.5 - z) for x, y, z in (*targets, tip)]
        np.testing.assert_allclose(np.sort(inside[n]), np.sort(np.ravel(sides)), atol=1e-12)
        heights = [up @ target for target in targets]
        for k, origin in enumerate((*posture.joint_origins[n, 1:], tip), 1):  # at the end of capsule k
            heights.append(up @ origin - radii[k : k + 2].max())
        np.testing.assert_allclose(np.sort(above[n]), np.sort(heights) - 0.3, atol=1e-12)


def test_the_frame_is_that_of_positions():
    """Robot and all conditions moved together: the same configurations are allowed."""
    robot = CASES["kuka_kr270"]()
    turn = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    shift = np.array([10.0, -3.0, 0.5])
    moved, station = robot.with_base(turn, shift), turn @ STATION + shift
    q = random_configurations(robot, 500)
    pairs = [
        (MinimumHeight(0.3, capsules=Capsules()), MinimumHeight(0.8, capsules=Capsules())),
        (TrackerRange(STATION, 2, 4), TrackerRange(station, 2, 4)),
        (TrackerElevation(STATION, high=0.1), TrackerElevation(station, high=0.1)),
        (ReflectorAcceptance(STATION, [1, 0, 0]), ReflectorAcceptance(station, [1, 0, 0])),
        (LineOfSight(STATION), LineOfSight(station)),
    ]
    for here, there in pairs:
        np.testing.assert_array_equal(here.allowed(robot, q), there.allowed(moved, q), err_msg=here.name)


# ── the user's own ───────────────────────────────────────────────────────────────────────────────────


def test_custom():
    assert allowed(Custom("left half", lambda q: q[:, 0] < 1), RIGHT, LEFT) == [True, False]

    def spoils(q):
        q[0] = 0
        return q[:, 0] > 0

    bad = {
        "shape": lambda q: np.ones(3, bool),
        "one answer": lambda q: True,
        "numbers": lambda q: q[:, 0],
        "failure": lambda q: {}["key"],
        "writing": spoils,
    }
    for name, function in bad.items():
        with pytest.raises(InputError, match=f"constraint '{name}'.*boolean"):
            allowed(Custom(name, function), RIGHT)
    with pytest.raises(InputError, match="a function"):
        Custom("text", "q1 < 1")


@pytest.mark.parametrize(
    ("make", "needle"),
    [
        (lambda: WorkspaceBox([0, 0, 0], [1, 0, 1]), "low < high"),
        (lambda: WorkspaceBox([0, 0], [1, 1]), "low"),
        (lambda: MinimumHeight(0, [0, 0, 0]), "up"),
        (lambda: MinimumHeight(np.nan), "height"),
        (lambda: TrackerRange([0, 0, 0], 2, 1), "minimum < maximum"),
        (lambda: TrackerRange([0, 0, 0], 2, np.nan), "minimum < maximum"),
        (lambda: TrackerElevation([0, 0, 0], low=-45), "low"),
        (lambda: TrackerElevation([0, 0, 0], low=0.5, high=0.1), "low < high"),
        (lambda: ReflectorAcceptance([0, 0, 0], [0, 0, 0]), "normal"),
        (lambda: ReflectorAcceptance([0, 0, 0], [1, 0, 0], 30), "half_angle"),
        (lambda: LineOfSight([0, 0, np.inf]), "station"),
        (lambda: LineOfSight([0, 0, 0], near=-1), "near"),
        (lambda: JointRange({"q1": [1, 0]}), "range of q1"),
    ],
)
def test_refusals(make, needle):
    with pytest.raises(InputError, match=needle):
        make()


# ── together ─────────────────────────────────────────────────────────────────────────────────────────


def all_constraints():
    return (
        JointRange({"joint_a4": [-np.pi, np.pi], "joint_a6": [-np.pi, np.pi]}),
        WorkspaceBox([0.3, -2.0, 0.3], [3.0, 2.0, 2.5]),
        MinimumHeight(0.2, capsules=Capsules(0.1)),
        TrackerRange(STATION, 1.0, 6.0),
        TrackerElevation(STATION, low=-0.8, high=1.0),
        ReflectorAcceptance(STATION, [1, 0, 0], np.pi / 6),
        LineOfSight(STATION),
        Custom("right of the fence", lambda q: q[:, 0] < 1.5),
    )


IMPOSSIBLE = {
    "workspace box": WorkspaceBox([9, 9, 9], [10, 10, 10]),
    "minimum height": MinimumHeight(5.0),
    "tracker range": TrackerRange(STATION, 50.0, 60.0),
    "tracker elevation": TrackerElevation(STATION, low=1.5),
    "reflector acceptance": ReflectorAcceptance([0.1, 0, 0.2], [1, 0, 0], 1e-4),
    "line of sight": LineOfSight(STATION, Capsules(5.0)),
    "never": Custom("never", lambda q: np.zeros(len(q), bool)),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_the_constraint_that_empties_the_set_is_named(name):
    wide = WorkspaceBox([-9] * 3, [9] * 3, name="wide box")
    problem = PlanProblem(Robot.load("kuka_kr270"), TEST_POSE, 4, constraints=(wide, IMPOSSIBLE[name]))
    with pytest.raises(InfeasibleError) as caught:
        plan(problem)
    assert caught.value.constraint == name
    assert f"{name} allows 0 %" in str(caught.value)
    assert "wide box allows 1e+02 %" in str(caught.value)


def test_two_that_exclude_each_other_are_named_and_no_others():
    front, back = WorkspaceBox([0.5, -3, 0], [3, 3, 3], name="front"), Custom("back", _behind)
    floor = MinimumHeight(0.1)
    problem = PlanProblem(Robot.load("kuka_kr270"), TEST_POSE, 4, constraints=(floor, front, back))
    with pytest.raises(InfeasibleError, match="each allows some") as caught:
        plan(problem)
    assert caught.value.constraint == "front and back"


def _behind(q):
    return Robot.load("kuka_kr270").positions(q)[:, 0, 0] < 0.4


def test_candidates_that_no_constraint_leaves():
    robot = Robot.load("kuka_kr270")
    pool = random_configurations(robot, 300)
    box = WorkspaceBox([1.0, -3, 0], [3, 3, 3])
    left = int(box.allowed(robot, pool).sum())
    fits = plan(PlanProblem(robot, TEST_POSE, 6, constraints=(box,), candidates=Candidates(pool)))
    assert box.allowed(robot, fits.configurations).all()
    with pytest.raises(InfeasibleError, match=f"{left} of 300.*workspace box allows"):
        plan(PlanProblem(robot, TEST_POSE, left + 1, constraints=(box,), candidates=Candidates(pool)))
    with pytest.raises(InfeasibleError) as caught:
        plan(PlanProblem(robot, TEST_POSE, 4, constraints=(MinimumHeight(5.0),), candidates=Candidates(pool)))
    assert caught.value.constraint == "minimum height"


def test_rare_configurations_are_multiplied():
    """About one configuration in 60 000 is allowed: two are found and their neighbours drawn."""
    robot = Robot.load("kuka_kr270")
    tip = robot.positions(TEST_POSE)[0, 0]
    small = Feasibility(robot, (WorkspaceBox(tip - 0.05, tip + 0.05),))
    q = small.sample(np.random.default_rng(0), 600)
    assert q.shape == (600, 6) and small.mask(q).all()
    assert len(np.unique(q, axis=0)) == 600
    low, high = robot.joint_limits.T
    assert ((low <= q) & (q <= high)).all()


def test_many_configurations_are_uniform_unless_they_are_rare():
    """None is a step from another: steps end at the joint limits, which uniform numbers never hit."""
    robot = Robot.load("kuka_kr270")
    box = Feasibility(robot, (WorkspaceBox([0.8, -1.2, 0.3], [2.4, 1.2, 2.3]),))
    q = box.sample(np.random.default_rng(0), 30_000)
    low, high = robot.joint_limits.T
    assert q.shape == (30_000, 6) and ((low < q) & (q < high)).all()
    fresh = np.random.default_rng(1).uniform(low, high, (400_000, 6))
    fresh = fresh[box.mask(fresh)]
    error = np.hypot(q.std(axis=0) / len(q) ** 0.5, fresh.std(axis=0) / len(fresh) ** 0.5)
    assert (np.abs(q.mean(axis=0) - fresh.mean(axis=0)) < 4.5 * error).all()


def counting(inner):
    """A constraint, and how many configurations it was asked about each time."""
    asked = []

    def function(q):
        asked.append(len(q))
        return inner(q)

    return Feasibility(planar(), (Custom("counting", function),)), asked


def test_no_more_configurations_are_drawn_than_the_share_of_feasible_ones_calls_for(monkeypatch):
    """One draw is enough where half of all is feasible; rejection goes on while one in a hundred is, and ends
    with patience where fewer are."""
    (low, high), rng = planar().joint_limits[0], np.random.default_rng(0)
    monkeypatch.setattr(feasibility, "PATIENCE", 2000)
    half, asked = counting(lambda q: q[:, 0] > 0.5 * (low + high))
    assert len(half.sample(rng, 1000)) == 1000 and len(asked) == 1 and asked[0] <= 5000
    some, asked = counting(lambda q: q[:, 0] > high - 0.02 * (high - low))
    assert len(some.sample(rng, 500)) == 500 and sum(asked) > 0.8 * 500 / 0.02
    few, asked = counting(lambda q: q[:, 0] > high - 0.001 * (high - low))
    assert len(few.sample(rng, 300)) == 300 and sum(asked) < 0.5 * 300 / 0.001


def test_neighbours_are_near_as_far_as_there_is_room_for_them():
    """Steps of a tenth of the range, as long as enough of them are feasible; else as short as they have to be."""
    low, high = planar().joint_limits.T
    middle = 0.5 * (low + high)
    wide, asked = counting(lambda q: np.ones(len(q), bool))
    q = wide._multiplied(np.random.default_rng(0), middle[None], 4000)[1:]
    assert len(asked) == 1
    np.testing.assert_allclose(q.std(axis=0) / (high - low), 0.1, rtol=0.05)
    assert ((low < q) & (q < high)).all()
    tiny, asked = counting(lambda q: (np.abs(q - middle) < 1e-3 * (high - low)).all(axis=1))
    assert len(tiny._multiplied(np.random.default_rng(0), middle[None], 3000)) >= 3000 and len(asked) < 20


def test_joint_ranges_cost_nothing_however_narrow():
    robot = Robot.load("kuka_kr270")
    narrow = JointRange({n: [v - 0.02, v + 0.03] for n, v in zip(robot.joint_names, TEST_POSE, strict=True)})
    q = Feasibility(robot, (narrow,)).sample(np.random.default_rng(0), 100)
    assert (np.abs(q - TEST_POSE) <= 0.03 + 1e-12).all()
    outside = TEST_POSE + np.array([1.0, 0, 0, 0, 0, 0])
    found = plan(PlanProblem(robot, outside, 6, constraints=(narrow,), search=Search(starts=8)))
    assert narrow.allowed(robot, found.configurations).all()


@pytest.fixture(scope="module")
def constrained():
    robot = Robot.load("kuka_kr270")
    return plan(PlanProblem(robot, TEST_POSE, 6, constraints=all_constraints(), search=Search(starts=2)))


def test_a_plan_satisfies_every_constraint(constrained):
    """Checked by the plain loop, and by hand where it has no word."""
    robot, q = Robot.load("kuka_kr270"), constrained.configurations
    assert constrained.quality.status == "ok"
    assert len(q) == 6
    low, high = robot.joint_limits.T
    assert ((low <= q) & (q <= high)).all() and (np.abs(q[:, [3, 5]]) <= np.pi).all() and (q[:, 0] < 1.5).all()
    tips = robot.positions(q)[:, 0]
    assert ((tips >= [0.3, -2, 0.3]) & (tips <= [3, 2, 2.5])).all()
    posture = robot.posture(q)
    assert min(posture.joint_origins[:, 1:, 2].min(), posture.tip_origin[:, 2].min()) - 0.1 >= 0.2
    beams = tips - STATION
    d = np.linalg.norm(beams, axis=1)
    assert ((d >= 1) & (d <= 6)).all()
    elevation = np.arctan2(beams[:, 2], np.hypot(beams[:, 0], beams[:, 1]))
    assert ((elevation >= -0.8) & (elevation <= 1.0)).all()
    facing = np.einsum("ni,ni->n", posture.tip_rotation[:, :, 0], -beams) / d
    assert (facing >= np.cos(np.pi / 6) - 1e-12).all()
    assert all(min(clear) > -1e-9 for _, _, clear in plain(robot, q))


def test_the_bound_holds_for_feasible_plans(constrained):
    robot = Robot.load("kuka_kr270")
    feasible = Feasibility(robot, all_constraints())
    rng = np.random.default_rng(1)
    values = []
    j0 = robot.jacobian(TEST_POSE)[0]
    for rows in feasible.sample(rng, 6 * 300).reshape(300, 6, 6):
        stacked = robot.jacobian(rows).reshape(-1, 9)
        values.append(3e-5 * np.sqrt(np.trace(j0 @ np.linalg.pinv(stacked.T @ stacked) @ j0.T)))
    assert constrained.quality.lower_bound <= constrained.quality.predicted_accuracy < min(values)
    unconstrained = plan(PlanProblem(robot, TEST_POSE, 6, search=Search(starts=8)))
    assert unconstrained.quality.lower_bound <= constrained.quality.lower_bound * (1 + 1e-2)


def test_the_order_of_visit_is_the_shorter_one(constrained):
    robot = Robot.load("kuka_kr270")
    scale = np.diff(robot.joint_limits, axis=1)[:, 0]
    scale[[3, 5]] = 2 * np.pi  # their share of the range asked for

    def travel(rows):
        return np.abs(np.diff(rows / scale, axis=0)).max(axis=1).sum()

    rng = np.random.default_rng(0)
    shuffled = [travel(rng.permutation(constrained.configurations)) for _ in range(200)]
    assert travel(constrained.configurations) < np.quantile(shuffled, 0.2)


def test_constraints_travel_to_other_processes():
    for constraint in all_constraints()[:-1]:
        again = pickle.loads(pickle.dumps(constraint))
        q = random_configurations(Robot.load("kuka_kr270"), 20)
        robot = Robot.load("kuka_kr270")
        np.testing.assert_array_equal(again.allowed(robot, q), constraint.allowed(robot, q))
