# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The accuracy that a plan promises is the one that the robot shows, whatever is unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import random_configurations
from scipy.stats import ortho_group

from calib_planner import (
    IdentificationProblem,
    InfeasibleError,
    InputError,
    Plan,
    PlanProblem,
    Robot,
    UnknownNameError,
    identify,
    plan,
)
from calib_planner.error_model import ErrorModel, Knowledge, Prior
from calib_planner.measurements import Measurements
from calib_planner.planning import Candidates, Pace, Search, plan_for_accuracy, plan_for_time
from calib_planner.planning.planner import value_of
from calib_planner.robot import Element

SIGMA = 3e-5
POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])
QUICK = Search(starts=2)
UNKNOWNS = ((), ("base",), ("base", "tool"))


def kuka(unknown: tuple[str, ...] = ()) -> Robot:
    return Robot.load("kuka_kr270").with_parameters("lengths+offsets", unknown)


def achieved(robot: Robot, found: Plan, poses: np.ndarray, seed: int) -> float:
    """Root mean square position error at ``poses`` after a true robot was measured and identified [m].

    The draws of the noise are orthogonal to each other, so that their mean square is the expectation itself and
    not an estimate that scatters.
    """
    rng = np.random.default_rng(seed)
    sizes = np.array([3e-4 if p.unit == "m" else 6e-4 for p in robot.parameters])
    truth = robot.with_deviations(
        dict(zip(robot.parameter_names, sizes * rng.standard_normal(len(sizes)), strict=True))
    )
    q = np.repeat(found.configurations, found.repetitions, axis=0)
    at = truth.positions(q)
    squares = []
    for row in ortho_group.rvs(at.size, random_state=rng):
        points = at + SIGMA * np.sqrt(at.size) * row.reshape(at.shape)
        data = Measurements(robot.joint_names, q, points)
        problem = IdentificationProblem(robot, data, error_model=ErrorModel.paper(SIGMA), loss="linear")
        apart = identify(problem).calibrated.positions(poses) - truth.positions(poses)
        squares.append(np.sum(apart**2) / len(poses))
    return float(np.sqrt(np.mean(squares)))


@pytest.mark.parametrize("unknown", UNKNOWNS[::2], ids="-".join)
def test_the_promise_is_what_the_robot_shows(unknown: tuple[str, ...]) -> None:
    robot = kuka(unknown)
    poses = np.stack([POSE, POSE + 0.3])
    found = plan(PlanProblem(robot, poses, 8, search=QUICK))
    assert achieved(robot, found, poses, 1) == pytest.approx(found.quality.predicted_accuracy, rel=0.03)


def test_the_promise_of_unequal_visits_is_what_the_robot_shows() -> None:
    found = plan_for_time(PlanProblem(kuka(), POSE, 1, search=QUICK), Pace(np.full(6, 0.1)), 220.0).plan
    assert found.measurements > len(found.configurations) and len(set(found.repetitions)) > 1
    assert achieved(kuka(), found, POSE[None], 3) == pytest.approx(found.quality.predicted_accuracy, rel=0.03)


@pytest.mark.parametrize("unknown", UNKNOWNS[::2], ids="-".join)
def test_plan_and_knowledge_promise_the_same(unknown: tuple[str, ...]) -> None:
    robot = kuka(unknown)
    poses = random_configurations(robot, 5, 3) / 3
    for frame in ("world", "robot"):
        found = plan(PlanProblem(robot, poses, 8, weights=[1, 2, 0, 1, 1], accuracy_frame=frame, search=QUICK))
        known = Knowledge.of_plan(robot, ErrorModel.paper(SIGMA), found.configurations)
        told = known.accuracy(poses, frame, weights=[1, 2, 0, 1, 1])
        assert found.quality.predicted_accuracy == pytest.approx(told.value, rel=1e-7)
        np.testing.assert_allclose(found.quality.predicted_accuracy_per_test_pose, told.per_pose, rtol=1e-7)
        assert found.quality.lower_bound <= found.quality.predicted_accuracy


def test_a_base_that_nobody_knows_costs_nothing_up_to_a_rigid_motion() -> None:
    """A base error is a rigid motion of all points, which the accuracy ``robot`` takes out."""
    poses = random_configurations(kuka(), 6, 3) / 3
    q = random_configurations(kuka(), 9, 4)
    known, unknown = (PlanProblem(kuka(u), poses, 9, accuracy_frame="robot") for u in UNKNOWNS[:2])
    free = Knowledge.of_plan(kuka(("base",)), ErrorModel.paper(SIGMA), q)
    flat = free.robot.jacobian(poses).reshape(-1, len(free.robot.parameter_names))
    motions = flat[:, [n.startswith("base.") for n in free.robot.parameter_names]]
    left = flat - motions @ np.linalg.lstsq(motions, flat, rcond=None)[0]
    expected = np.sqrt(np.trace(left @ free.covariance @ left.T) / len(poses))
    assert value_of(unknown, q) == pytest.approx(expected, rel=1e-6)
    assert value_of(known, q) < value_of(replace(known, accuracy_frame="world"), q)
    assert value_of(unknown, q) < value_of(replace(unknown, accuracy_frame="world"), q)


@pytest.mark.parametrize("names", [("base.rz", "q1"), ("q1", "base.rz"), ("base.rz",), ("q1",)])
def test_the_promise_does_not_depend_on_which_equivalent_parameter_is_free(names: tuple[str, ...]) -> None:
    rest = [n for n in kuka(("base", "tool")).parameter_names if n not in ("base.rz", "q1")]
    q, poses = random_configurations(kuka(), 9, 4), random_configurations(kuka(), 4, 5)
    reference = value_of(PlanProblem(kuka(("base", "tool")), poses, 9), q)
    robot = kuka().with_parameters([*names, *rest])
    for criterion in ("test_pose", "worst_pose"):
        told = value_of(PlanProblem(robot, poses, 9, criterion=criterion), q)
        assert criterion == "worst_pose" or told == pytest.approx(reference, rel=1e-6)
        assert told >= reference * (1 - 1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_more_knowledge_never_makes_a_promise_worse(seed: int) -> None:
    robot = kuka(("base", "tool"))
    rng = np.random.default_rng(seed)
    q, poses = random_configurations(robot, 14, seed), random_configurations(robot, 3, 10 + seed)
    problem = PlanProblem(robot, poses, 9)
    alone = value_of(problem, q[:9])
    for name in ("q1", "base.rz", *rng.choice(robot.parameter_names, 3)):
        for std in (2e-2, 1e-4):
            known = replace(problem, prior=Prior((str(name),), [0.0], [std]))
            assert value_of(known, q[:9]) <= alone * (1 + 1e-6)
    told = [value_of(replace(problem, configurations=m), q[:m]) for m in range(9, 15)]
    assert (np.diff(told) <= 1e-9).all()
    data = Measurements(robot.joint_names, q[9:], robot.positions(q[9:]))
    assert value_of(replace(problem, measured=data), q[:9]) == pytest.approx(told[-1], rel=1e-6)


def test_what_no_configuration_shows_but_the_test_pose_feels_is_infinite() -> None:
    """The wrist stands still in all candidates: a test pose that turns it feels what they cannot tell."""
    robot = kuka(("base", "tool"))
    rows = random_configurations(robot, 40, 2)
    rows[:, 3:] = 0.2
    for turned, infinite in ((1.0, True), (0.2, False)):
        pose = np.array([*POSE[:3], turned, turned, turned])
        found = plan(PlanProblem(robot, pose, 10, candidates=Candidates(rows), search=QUICK))
        assert np.isinf(found.quality.predicted_accuracy) == infinite
        assert (found.quality.status == "singular") == infinite
        assert ("unlimited" in found.quality.message) == infinite


def test_an_accuracy_that_is_asked_for_is_met_and_one_measurement_fewer_does_not_meet_it() -> None:
    robot, wanted = kuka(("base",)), 1.6e-5
    split = plan_for_accuracy(PlanProblem(robot, POSE, 1, search=QUICK), wanted)
    assert achieved(robot, split.plan, POSE[None], 2) < wanted * 1.005
    assert split.fewest <= split.plan.measurements
    fewer = plan(PlanProblem(robot, POSE, split.plan.measurements - 1, search=QUICK))
    assert fewer.quality.predicted_accuracy > wanted


def test_frames_that_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="accuracy_frame"):
        PlanProblem(kuka(), POSE, 4, accuracy_frame="tool")
    with pytest.raises(InputError, match="at least 4"):
        plan(PlanProblem(kuka(), POSE, 4, accuracy_frame="robot"))


def test_an_accuracy_that_no_parameter_changes_is_refused() -> None:
    """The errors of a gantry are rigid motions of all points, which the accuracy ``robot`` takes out."""
    slides = (Element("T" + axis, 0.5, k, parameter=f"zero {axis}") for k, axis in enumerate("xyz"))
    names, limits = ("x", "y", "z"), np.array([[-1.0, 1.0]] * 3)
    gantry = Robot("gantry", tuple(slides), (), names, limits).with_targets([[0.1, 0.0, 0.2]])
    gantry = gantry.with_parameters("zero x,zero y,zero z")
    poses = random_configurations(gantry, 5)
    problem = PlanProblem(gantry, poses, 4, accuracy_frame="robot", search=QUICK)
    with pytest.raises(InfeasibleError, match="changes the accuracy 'robot' at the test poses"):
        plan(problem)
    assert plan(replace(problem, criterion="d")).quality.predicted_accuracy == 0.0
    world = plan(replace(problem, accuracy_frame="world")).quality
    assert world.predicted_accuracy == pytest.approx(SIGMA * np.sqrt(3 / 4))  # each coordinate by four points
