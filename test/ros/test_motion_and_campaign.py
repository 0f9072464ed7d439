# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The pure parts below the nodes: how the robot moves, what a campaign makes of standstills."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from calib_planner import Estimate, Plan, PlanProblem, Robot, plan
from calib_planner.acquisition import Standstill, StandstillDetector
from calib_planner.error_model import ErrorModel
from calib_planner.errors import InputError, NotEnoughDataError, UnknownNameError
from calib_planner.io import NamedPlan, SessionStore, StoredModel, open_store
from calib_planner.planning import Search
from calib_planner.ros import session as saving
from calib_planner.ros.session import Matching, Session, TooFew
from calib_planner.simulation import SimulatedCell, make_tour, random_deviations

LIMITS = np.array([[-3.0, 3.0], [-3.0, 3.0]])
HOW = Matching()


def test_tour_is_smooth_and_bounded() -> None:
    q = np.array([[1.0, -2.0], [1.0, -2.0], [-2.9, 2.9]])
    tour = make_tour(np.zeros(2), q, np.array([1, 2, 1]), LIMITS, speed=2.0, dwell=0.5)
    times = np.arange(0.0, tour.seconds, 0.002)
    path = np.array([tour.at(t).joints(t) for t in times])
    assert np.abs(np.diff(path, axis=0)).max() <= 2.0 * 0.002 * 1.001
    assert (np.abs(path) <= 3.0).all()
    assert tour.standstills(tour.seconds) == 4 and tour.standstills(0.0) == 0
    rests = [p for p in tour.phases if p.measuring]
    assert [p.index for p in rests] == [0, 1, 1, 2]
    assert all(np.isclose(p.end - p.begin, 0.5) for p in rests)
    moves = [p for a, b in pairwise(rests) for p in tour.phases if a.end <= p.begin < b.begin]
    assert all(np.abs(p.goal - p.start).max() >= 0.05 - 1e-9 for p in moves)


def test_after_the_end_the_robot_stays() -> None:
    tour = make_tour(np.zeros(2), np.array([[1.0, 1.0]]), np.array([1]), LIMITS, 1.0, 0.1)
    assert tour.at(1e9).joints(1e9).tolist() == [1.0, 1.0]


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.load("planar_2r").with_parameters("lengths+offsets")


@pytest.fixture(scope="module")
def planned(robot: Robot) -> Plan:
    return plan(PlanProblem(robot, [0.3, 0.5], 4, search=Search(starts=4)))


@pytest.fixture
def campaign(robot: Robot, planned: Plan) -> Session:
    made = Session(robot, lambda _: robot, memory(robot))
    assert made.begin("p", planned, HOW.tolerance)
    return made


def memory(robot: Robot) -> SessionStore:
    return open_store("", StoredModel(robot.name, robot.joint_names, len(robot.targets), ""), {}, "")


def standstill(robot: Robot, q: np.ndarray, seed: int = 0) -> Standstill:
    cell = SimulatedCell(robot, random_deviations(robot, 3), 1e-5)
    points = cell.measure([q], 1, seed).p[0]
    start = 2 * seed * 10**9
    return Standstill(start, start + 10**9, q, points, np.full(1, 1e-5), np.array([20]))


def test_from_too_few_to_complete(robot: Robot, planned: Plan, campaign: Session) -> None:
    first = campaign.estimate(HOW)
    assert isinstance(first, TooFew) and first.missing == 2
    for i, q in enumerate(planned.configurations):
        assert not campaign.complete
        decision = campaign.take(standstill(robot, q, i), HOW)
        assert (decision.status, decision.index, decision.repetition) == ("accepted", i, 0)
    assert campaign.complete
    found = campaign.estimate(HOW)
    assert isinstance(found, Estimate) and len(found.accuracy.predicted) == 1
    again = campaign.take(standstill(robot, planned.configurations[2], 9), HOW)
    assert (again.index, again.repetition) == (2, 1)


def test_far_from_the_plan(robot: Robot, planned: Plan, campaign: Session) -> None:
    odd = standstill(robot, planned.configurations[0] + 0.02)
    decision = campaign.take(odd, HOW)
    assert decision.status == "not_in_plan" and "nearest planned configuration" in decision.reason
    assert campaign.rejections == {"not_in_plan": 1} and not campaign.accepted
    assert campaign.take(odd, replace(HOW, accept_unplanned=True)).status == "accepted"


def test_without_a_plan(robot: Robot) -> None:
    campaign = Session(robot, lambda _: robot, memory(robot))
    decision = campaign.take(standstill(robot, np.zeros(2)), HOW)
    assert decision.status == "not_in_plan" and "no plan" in decision.reason


def test_undo_and_reset(robot: Robot, planned: Plan, campaign: Session) -> None:
    assert campaign.undo() is None
    for i in range(2):
        campaign.take(standstill(robot, planned.configurations[i]), HOW)
    undone = campaign.undo()
    assert undone is not None and (undone.status, undone.index) == ("undone", 1)
    assert campaign.reset() == 1 and not campaign.accepted


def test_plans_for_others_are_refused(robot: Robot, planned: Plan, campaign: Session) -> None:
    campaign.take(standstill(robot, planned.configurations[0]), HOW)
    with pytest.raises(UnknownNameError):
        campaign.begin("q", replace(planned, robot="other"), 0.01)
    with pytest.raises(InputError):
        campaign.begin("q", replace(planned, joint_names=("q2", "q1")), 0.01)
    assert not campaign.begin("p", planned, 0.01) and len(campaign.accepted) == 1
    assert campaign.begin("q", planned, 0.01) and not campaign.accepted


def test_memory_is_bounded(robot: Robot, planned: Plan, campaign: Session) -> None:
    how = replace(HOW, most=2)
    statuses = [campaign.take(standstill(robot, planned.configurations[0], k), how).status for k in range(4)]
    assert statuses == ["accepted", "accepted", "not_in_plan", "not_in_plan"]


@pytest.mark.parametrize(
    ("sigma", "repeatability", "expected"),
    [(3e-5, 0.0, 3e-5 / 20**0.5), (3e-5, 1e-4, 1.0022e-4), (0.0, 0.0, 1e-5)],
)
def test_weights(
    robot: Robot, planned: Plan, campaign: Session, sigma: float, repeatability: float, expected: float
) -> None:
    how = replace(HOW, sigma=sigma, repeatability=repeatability)
    campaign.take(standstill(robot, planned.configurations[0]), how)
    data = campaign.measurements(how)
    assert data is not None and np.allclose(np.asarray(data.std), expected, rtol=1e-3)


def test_save(tmp_path, robot: Robot, planned: Plan, campaign: Session) -> None:
    with pytest.raises(InputError, match="save_folder"):
        saving.save("", campaign, HOW)
    with pytest.raises(NotEnoughDataError):
        saving.save(str(tmp_path), campaign, HOW)
    campaign.take(standstill(robot, planned.configurations[0]), HOW)
    # One measurement tells something of a robot with tolerances, and too little of one of which nothing is known.
    nothing_known = replace(HOW, error_model=ErrorModel.paper())
    assert [p.name for p in saving.save(str(tmp_path / "new"), campaign, nothing_known)] == ["measurements_p.csv"]
    campaign.plans = (NamedPlan("../../evil/\0" + "x" * 1000, planned),)
    for i in (1, 2, 3):
        campaign.take(standstill(robot, planned.configurations[i], i), HOW)
    paths = saving.save(str(tmp_path), campaign, HOW)
    assert len(paths) == 2 and all(p.parent == tmp_path and p.is_file() for p in paths)
    (tmp_path / "file").write_text("")
    with pytest.raises((InputError, OSError)):
        saving.save(str(tmp_path / "file"), campaign, HOW)


def test_a_simulated_shift_gives_the_truth(robot: Robot, planned: Plan, campaign: Session) -> None:
    """Motion, tracker, standstills and identification together, without ROS: within 4 std, all of them."""
    truth = random_deviations(robot, 5)
    true_robot = robot.with_deviations(truth)
    tour = make_tour(np.zeros(2), planned.configurations, planned.repetitions, robot.joint_limits, 4.0, 0.8)
    rng = np.random.default_rng(5)
    detector = StandstillDetector(2)
    for i in range(int(tour.seconds * 100)):
        t = i / 100
        q = tour.at(t).joints(t)
        found = detector.add_joints(i * 10**7, q)
        if i % 2:
            point = true_robot.positions(q)[0, 0] + 3e-5 * rng.standard_normal(3)
            found += detector.add_point(0, i * 10**7, point)
        for one in found:
            assert isinstance(one, Standstill)
            campaign.take(one, HOW)
    for one in detector.flush():
        campaign.take(one, HOW)  # type: ignore[arg-type]
    estimate = campaign.estimate(HOW)
    assert campaign.complete and isinstance(estimate, Estimate)
    off = estimate.fit.deviations - [truth[n] for n in estimate.fit.parameters]
    assert (np.abs(off) < 4 * estimate.fit.std).all()
