# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The state machine: what follows from what, without a robot."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import SIGMA, planar, world_of

from calib_planner import InputError, Measurements
from calib_planner.campaign import (
    CampaignState,
    Exclusion,
    Finished,
    Measure,
    Paused,
    Replan,
    Validate,
    begin,
    decide,
    from_measurements,
    run_campaign,
)
from calib_planner.campaign.assess import expected
from calib_planner.campaign.problem import WIDEST, AwayFrom, joint_scale, radius_of
from calib_planner.error_model import Prior
from calib_planner.simulation import simulated

PROBLEM = planar()
POINTS = np.array([[0.5, 0.5, 0.0]])


@pytest.fixture(scope="module")
def planned() -> CampaignState:
    state = begin(PROBLEM)
    return state.decided(decide(state))


def head(state: CampaignState) -> Measure:
    assert isinstance(state.action, Measure)
    return state.action


def test_it_begins_with_a_plan(planned):
    assert isinstance(begin(PROBLEM).action, Replan)
    first = head(planned)
    assert first.role == "fit" and first.repetition == 0
    assert len(planned.queue) == sum(s.times for s in planned.configurations) == planned.rounds[0].planned
    assert sum(s.times == 2 for s in planned.configurations) == 4
    assert planned.queue[0] == first.index and planned.left >= len(planned.queue)


def test_a_measurement_takes_its_visit_out_and_a_repetition_is_counted(planned):
    state, seen = planned, []
    while isinstance(state.action, Measure):
        action = state.action
        seen.append((action.index, action.repetition))
        state = state.measured(action.index, action.q, POINTS[0])
    assert len(set(seen)) == len(planned.queue) and isinstance(state.action, Replan)
    assert [r for _, r in seen[-4:]] == [1, 1, 1, 1]
    assert state.spent() == len(state.measurements) == len(seen)


def test_failures_are_tried_again_then_given_up(planned):
    action = head(planned)
    state = planned.failed(action.index, "a beam break")
    assert head(state).index == action.index and not state.exclusions
    state = state.failed(action.index, "a beam break")
    assert action.index not in state.queue
    assert [(e.index, e.reason) for e in state.exclusions] == [(action.index, "a beam break")]
    assert state.spent() == 2 and state.given_up == 1


def test_skipping_costs_nothing_and_is_no_failure(planned):
    action = head(planned)
    state = planned.skipped(action.index)
    assert action.index not in state.queue and state.spent() == 0 and state.given_up == 0
    assert state.exclusions[0].requested
    assert len(planned.exclusions) == 0, "the state before is what it was"


def test_a_stop_measured_once_and_then_unreachable_leaves_no_neighbourhood(planned):
    twice = next(i for i, s in enumerate(planned.configurations) if s.times == 2)
    state = planned.measured(twice, planned.configurations[twice].q, POINTS).unreachable(twice, "blocked")
    assert not state.exclusions and state.dropped == (twice,) and twice not in state.queue


def test_skipping_what_was_measured_once_is_no_failure_either(planned):
    twice = next(i for i, s in enumerate(planned.configurations) if s.times == 2)
    state = planned.measured(twice, planned.configurations[twice].q, POINTS).skipped(twice)
    assert state.dropped == (twice,) and twice not in state.queue and state.given_up == 0
    assert state.unreachable(twice, "blocked").given_up == 0, "it is skipped already"


def test_what_is_ahead_can_be_planned_anew_around_a_configuration(planned):
    """The visit under way stays; a campaign that is paused has none under way."""
    paused = planned.pause()
    assert planned.ahead == planned.queue[1:] and paused.ahead == paused.queue
    under_way, other = planned.queue[0], next(i for i in planned.queue if i != planned.queue[0])
    kept = planned.skipped(other, replan=True)
    assert kept.queue == ((under_way,) if under_way in planned.skipped(other).queue else ()) and not kept.ahead
    for state, index in ((planned, under_way), (paused, under_way), (paused, other)):
        assert not state.skipped(index, replan=True).queue
    again = paused.skipped(other, replan=True)
    step = decide(again)
    allowed = again.constraints[-1].allowed(PROBLEM.robot, np.array([c.q for c in step.configurations]))
    assert step.queue and allowed.all() and again.decided(step).paused


def test_a_measurement_that_was_not_heard_of_counts_where_it_was_made(planned):
    q = PROBLEM.test_pose_array[0] + 0.1
    state = planned.adopted("validation", q, POINTS, 9)
    assert state.queue == planned.queue and [r.number for r in state.measurements_of("validation")] == [9]
    assert state.spent("validation") == 1 and state.configurations[-1].q.tolist() == q.tolist()


def test_pause_and_resume_change_nothing_else(planned):
    paused = planned.pause()
    assert isinstance(paused.action, Paused)
    assert dataclasses.replace(paused.resume()).queue == planned.queue
    measured = paused.measured(planned.queue[0], planned.configurations[planned.queue[0]].q, POINTS)
    assert isinstance(measured.action, Paused) and len(measured.measurements) == 1


def test_an_undone_measurement_is_visited_again(planned):
    action = head(planned)
    state = planned.measured(action.index, action.q, POINTS, number=7)
    back = state.withdrawn(7, "an outlier")
    assert not back.measurements and back.queue.count(action.index) == planned.queue.count(action.index)
    assert back.spent() == 1 and back.withdrawn(99, "unknown") is back
    again = back.measured(action.index, action.q, POINTS, number=8).withdrawn(8, "an outlier")
    assert action.index not in again.queue and again.given_up == 1


def test_a_measurement_heard_twice_counts_once(planned):
    action = head(planned)
    once = planned.measured(action.index, action.q, POINTS, number=3)
    twice = once.measured(action.index, action.q, POINTS + 1.0, number=3)
    assert len(twice.measurements) == 1 and twice.queue == once.queue
    np.testing.assert_array_equal(twice.measurements[0].points, POINTS + 1.0)


def test_events_while_a_decision_is_made_are_kept(planned):
    """A configuration undone and a pause, while somebody plans: both are there afterwards."""
    state = planned
    while isinstance(state.action, Measure):
        state = state.measured(state.action.index, state.action.q, world_point(state.action.q))
    decision = decide(state)
    later = state.withdrawn(state.measurements[0].number, "undone").pause().decided(decision)
    assert later.paused and len(later.measurements) == len(state.measurements) - 1
    assert set(decision.queue) <= set(later.queue) and state.measurements[0].index in later.queue


def world_point(q: np.ndarray) -> np.ndarray:
    noise = SIGMA * np.random.default_rng(abs(hash(q.tobytes())) % 2**32).standard_normal((1, 3))
    return PROBLEM.robot.positions(q[None])[0] + noise


@pytest.mark.parametrize(
    ("index", "points", "field"),
    [(99, POINTS, "index"), (-1, POINTS, "index"), (0, np.full((1, 3), np.nan), "points"),
     (0, np.zeros((2, 3)), "points"), (0, "x", "points|float"), (0, np.full((1, 3), np.inf), "points"),
     (0, np.array([[np.nan, 0.0, -1e308]]), "points")],
)  # fmt: skip
def test_nonsense_is_refused(planned, index, points, field):
    with pytest.raises((InputError, ValueError), match=field):
        planned.measured(index, PROBLEM.test_pose_array[0], points)


def test_everything_is_frozen(planned):
    with pytest.raises(dataclasses.FrozenInstanceError):
        planned.paused = True
    with pytest.raises(ValueError, match="read-only"):
        planned.configurations[0].q[0] = 0.0


# ── after a crash ────────────────────────────────────────────────────────────────────────────────────


def run_on(state: CampaignState, seed: int, stop_after: int = 10_000) -> CampaignState:
    measure = simulated(world_of(PROBLEM.robot, 6), seed)
    for _ in range(stop_after):
        action = state.action
        if isinstance(action, Finished):
            break
        if isinstance(action, Measure):
            state = state.measured(action.index, action.q, measure(action))
        else:
            state = state.decided(decide(state))
    return state


@pytest.mark.parametrize("events", [5, 12, 15])
def test_it_goes_on_from_its_measurements(events):
    before = run_on(begin(PROBLEM), 1, events)
    state = from_measurements(PROBLEM, before.data("fit"), before.data("validation"))
    assert len(state.measurements) == len(before.measurements) and isinstance(state.action, Replan)
    assert sorted(s.times for s in state.configurations) == sorted(
        sum(r.index == i for r in before.measurements) for i in {r.index for r in before.measurements}
    )
    after = run_on(state, 2)
    assert after.result.outcome == "reached" and after.result.accuracy <= PROBLEM.required_accuracy
    kept = {tuple(p.ravel()) for p in before.data("fit").p}
    assert kept <= {tuple(p.ravel()) for p in after.result.fit.p}


def test_a_finished_campaign_is_finished_again():
    done = run_on(begin(PROBLEM), 3).result
    state = from_measurements(PROBLEM, done.fit, done.validation)
    state = state.decided(decide(state))
    assert isinstance(state.action, Finished)
    again = state.action.result
    np.testing.assert_array_equal(again.estimate.fit.deviations, done.estimate.fit.deviations)
    assert again.verdict == done.verdict and again.outcome == done.outcome


def test_measurements_of_another_robot_are_refused():
    with pytest.raises(InputError, match="joint names"):
        from_measurements(PROBLEM, Measurements(("a", "b"), [[0.0, 1.0]], [[[0.0, 0.0, 0.0]]]))


# ── whatever happens, in whatever order ──────────────────────────────────────────────────────────────


EVENTS = ["measure", "fail", "unreachable", "skip", "pause", "resume", "undo"]


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.sampled_from(["measure", "fail", "unreachable", "skip", "pause", "resume", "undo"]), max_size=60)
)
def test_no_sequence_of_events_breaks_it(planned, events):
    state, number = planned, 0
    for event in events:
        index = state.queue[0] if state.queue else 0
        if event == "measure":
            state = state.measured(index, state.configurations[index].q, POINTS, number=number)
            number += 1
        elif event == "undo":
            state = state.withdrawn(number - 1, "undone")
        elif event in ("pause", "resume"):
            state = getattr(state, event)()
        else:
            name = {"fail": "failed", "unreachable": "unreachable", "skip": "skipped"}[event]
            state = getattr(state, name)(index, "why") if name != "skipped" else state.skipped(index)
        gone = {e.index for e in state.exclusions} | set(state.dropped)
        assert not gone & set(state.queue)
        assert isinstance(state.action, Paused if state.paused else (Measure if state.queue else Replan))
        assert all(state.queue.count(i) <= state.configurations[i].times for i in state.queue)
    assert not isinstance(state.action, (Validate, Finished))


# ── neighbourhoods ───────────────────────────────────────────────────────────────────────────────────


def test_failures_side_by_side_widen_their_neighbourhood_up_to_what_was_measured():
    scale = joint_scale(PROBLEM.robot)
    q = np.array([0.5, 0.5])
    nothing = np.empty((0, 2))
    first = radius_of(q, (), nothing, scale, 0.05)
    found = [Exclusion(0, q, first, "")]
    for k in range(1, 6):
        found.append(Exclusion(k, q, radius_of(q, found, nothing, scale, 0.05), ""))
    assert [e.radius for e in found] == pytest.approx([0.05, 0.1, 0.2, WIDEST, WIDEST, WIDEST])
    measured = q + np.array([0.1, 0.0]) / scale
    radius = radius_of(q, found, measured[None], scale, 0.05)
    assert radius == pytest.approx(0.09)
    out = AwayFrom((Exclusion(9, q, radius, ""),), scale)
    assert out.allowed(PROBLEM.robot, np.array([q, measured])).tolist() == [False, True]


def test_a_joint_that_moves_nothing_is_no_way_out():
    from calib_planner import Robot

    robot = Robot.load("kuka_kr270")
    scale = joint_scale(robot)
    assert scale[5] == 0.0 and (scale[:5] > 0).all()
    q = robot.joint_limits.mean(axis=1)
    turned = q.copy()
    turned[5] += 2.0
    out = AwayFrom((Exclusion(0, q, 0.05, ""),), scale)
    assert not out.allowed(robot, turned[None])[0]


def test_a_paused_campaign_waits_for_somebody_to_resume_it(planned):
    with pytest.raises(InputError, match=r"state: expected a campaign that runs, got paused; use state\.resume"):
        run_campaign(planned.pause(), lambda _: POINTS[0])


def test_a_stated_prior_is_part_of_what_is_expected():
    prior = Prior(PROBLEM.robot.parameter_names[:1], [0.0], [1e-4])
    told = expected(dataclasses.replace(PROBLEM, identification={**PROBLEM.identification, "prior": prior}))
    assert told.placement.stated is prior and expected(PROBLEM).placement.stated is None
