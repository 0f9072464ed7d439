# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Executions as values: what a good robot, a bad one, a deaf one and a person with a stop button make of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arm import GOOD, NEVER, Arm, Cell, Manner
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import plan_of, repeats

from calib_planner import Robot
from calib_planner.errors import InputError
from calib_planner.planning import BACK_OFF, Pace, Trajectory, smooth_trajectory
from calib_planner.ros.execution import (
    Answered,
    Beam,
    Cancel,
    Confirmed,
    Finished,
    Halted,
    Job,
    Joined,
    Looked,
    PlanWay,
    Send,
    View,
    Watch,
    WayPlanned,
    job_of,
)

ROBOT = Robot.load("planar_2r")
Q = np.array([[0.5, -0.3], [-0.4, 0.6]])
HOME = np.array([0.1, 0.2])
PACE = Pace([0.5, 0.5], dwell=0.6, settle=0.4)
STOP = Halted("STOPPED", "somebody called ~/stop")


def cell(manner: Manner = GOOD, times: Any = 1, start: np.ndarray = HOME, **options: Any) -> Cell:
    watch, period = options.pop("watch", Watch()), options.pop("period", 0.02)
    view = View(watch, beams=(Beam("tracker/locked"),))
    job = job_of(plan_of(ROBOT, Q, times), ROBOT, PACE, start, **options)
    return Cell(job, view, Arm(start), manner, period=period)


def ended(it: Cell, seconds: float = 100.0) -> tuple[str, str]:
    it.run(seconds)
    outcome = it.execution.outcome
    assert outcome is not None, it.execution.phase
    return outcome.status, outcome.message


def sends(it: Cell) -> list[Send]:
    return [a for _, a in it.sent if isinstance(a, Send)]


def cancels(it: Cell) -> list[int]:
    return [a.number for _, a in it.sent if isinstance(a, Cancel)]


# ── all is well ──────────────────────────────────────────────────────────────────────────────────────


def test_every_configuration_as_often_as_planned() -> None:
    it = cell(times=[2, 1])
    began = it.now
    assert ended(it) == ("SUCCESS", "every configuration was visited")
    assert it.execution.executed == 3 and not cancels(it)
    first, again, other = sends(it)
    assert np.allclose(first.way.start, HOME) and np.allclose(first.way.goal, Q[0])
    assert np.allclose([again.way.start, again.way.goal], Q[0]) and np.allclose(other.way.goal, Q[1])
    # Away in between, as far as the timetable says.
    assert np.abs(again.way.positions - Q[0]).max() == pytest.approx(BACK_OFF)
    assert it.phases[:4] == ["READYING", "MOVING", "MEASURING", "LEAVING"] or it.phases[0] == "MOVING"
    # What the planner promised, but for what the controller needs to begin: less than 0.1 s each.
    assert it.job.seconds <= it.now - began <= it.job.seconds + 3 * 0.15


def test_where_it_stands_at_first_it_backs_off() -> None:
    it = cell(start=Q[0])
    assert ended(it)[0] == "SUCCESS"
    assert np.abs(sends(it)[0].way.positions - Q[0]).max() == pytest.approx(BACK_OFF)


def test_a_goals_own_dwell() -> None:
    assert cell(dwell=2.5).job.standstill == 2.5 and cell().job.standstill == 1.0


def test_speeds_are_those_of_the_pace() -> None:
    it = cell()
    ended(it)
    for sent in sends(it):
        speed, push = sent.way.fastest()
        assert (speed <= 0.5 * 1.001).all() and (push <= 1.0 * 1.02).all()


def test_the_controllers_word_alone_is_no_arrival() -> None:
    it = cell(Manner(off=0.01))
    status, words = ended(it)
    assert status == "ABORTED" and it.execution.executed == 0
    assert "configuration 0: the robot does not arrive: q" in words and "rad are allowed" in words
    assert "the robot stands" in words


def test_the_dwell_begins_when_it_stands() -> None:
    """The controller begins half a second late; the standstill is as long all the same."""
    it = cell(replace(GOOD, delay=0.45))
    it.run_to("MEASURING")
    goal = it.execution.goal
    assert goal is not None
    it.run_to("MOVING", 1)
    stood = it.now - (goal.sent + 0.02 + 0.45 + goal.way.seconds)
    assert stood >= 1.0 - 0.15  # its last tenth is within the tolerance of standing still


# ── the robot does not do as it is told ──────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("manner", "status", "words"),
    [
        (Manner(refuse=True), "NOT_READY", "the controller refused the move: is it active"),
        (Manner(answer=NEVER), "ABORTED", "the controller does not answer"),
        (Manner(failure="error -4 path tolerance"), "ABORTED", "error -4 path tolerance"),
        (Manner(rate=0.0), "ABORTED", "q2 is at 0.2000 rad"),
        (Manner(rate=0.5), "ABORTED", "find out why the robot does not follow"),
        (Manner(beyond=0.2), "ABORTED", "find out why"),
        (Manner(off=0.1), "ABORTED", "rad are allowed"),
        (Manner(result=NEVER), "ABORTED", "the controller does not report the end of its move"),
        (Manner(preempted=0.5, result=0.0), "ABORTED", "preempted by a new goal"),
        (Manner(delay=3.0), "ABORTED", "rad are allowed"),
    ],
)
def test_a_bad_controller(manner: Manner, status: str, words: str) -> None:
    it = cell(manner)
    assert ended(it)[0] == status and words in ended(it)[1], ended(it)
    assert it.execution.executed <= 1 and len(sends(it)) == 1
    over = {"refused", "failure", "preempted"} & {k for k, v in vars(manner).items() if v != getattr(GOOD, k)}
    assert set(cancels(it)) == (set() if over or manner.refuse else {sends(it)[0].number})


def test_a_late_answer_is_waited_for() -> None:
    assert ended(cell(replace(GOOD, answer=3.0)))[0] == "SUCCESS"
    assert ended(cell(replace(GOOD, result=3.0)))[0] == "SUCCESS"


def test_who_accepts_after_the_end_is_cancelled() -> None:
    it = cell(Manner(answer=NEVER))
    assert ended(it)[0] == "ABORTED"
    (sent,) = sends(it)
    before = len(cancels(it))
    it.feed(Answered(sent.number, accepted=True))
    assert cancels(it)[before:] == [sent.number]
    it.feed(Answered(sent.number, accepted=False))
    assert len(cancels(it)) == before + 1


def test_who_accepts_while_it_stops_is_cancelled_again() -> None:
    it = cell(replace(GOOD, answer=2.0))
    it.run_to("MOVING")
    it.feed(STOP)
    assert len(cancels(it)) == 1
    assert ended(it)[0] == "STOPPED"
    assert len(cancels(it)) >= 2 and np.allclose(it.arm.joints(it.now), HOME, atol=1e-3)


def test_a_robot_that_does_not_stop_is_said_loudly() -> None:
    it = cell(replace(GOOD, halts=False, rate=0.9), watch=Watch(patience=0.5))
    it.run_to("MOVING")
    it.run(0.5)
    it.feed(STOP)
    status, words = ended(it)
    assert status == "STOPPED" and "THE ROBOT STILL MOVES" in words
    assert it.execution.outcome is not None and it.execution.outcome.alarm


def test_a_controller_that_does_not_confirm_its_end() -> None:
    it = cell(replace(GOOD, confirms=False))
    it.run_to("MOVING")
    it.feed(STOP)
    status, words = ended(it)
    assert status == "STOPPED" and "does not say that its move is over" in words


def test_a_request_to_cancel_that_gets_lost_is_sent_again() -> None:
    it = cell()
    it.run_to("MOVING")
    it.run(0.5)
    it.manner = replace(GOOD, halts=False)  # nobody hears the first one
    it.feed(STOP)
    assert len(cancels(it)) == 1
    it.manner = GOOD
    status, words = ended(it, 10.0)
    assert status == "STOPPED" and "the robot stands, after 0 standstills" in words and len(cancels(it)) == 2


def test_silence_ends_it() -> None:
    for phase in ("MOVING", "MEASURING"):
        it = cell()
        it.run_to(phase)
        it.deaf = True
        status, words = ended(it)
        assert status == "ABORTED" and "the newest joint state is 0.5" in words
        assert "WHETHER THE ROBOT STANDS IS NOT KNOWN" in words
        assert len(sends(it)) == 1 and it.execution.executed == 0


def test_stamps_of_another_clock() -> None:
    it = cell()
    it.view = replace(it.view, stamp=it.now + 5.0)
    it.deaf = True
    assert "stamped 5.00 s ahead" in it.view.silence(it.now)
    assert ended(it)[0] == "ABORTED"


def test_pushed_away_while_it_is_measured() -> None:
    it = cell()
    it.run_to("MEASURING")
    it.run(0.4)
    it.arm.rest = it.arm.rest + 0.004  # within the tolerance of the arrival
    it.step()
    assert it.execution.phase.name == "MOVING"
    assert ended(it)[0] == "SUCCESS" and it.execution.executed == 2
    it = cell()
    it.run_to("MEASURING")
    it.arm.rest = it.arm.rest + 0.015
    status, words = ended(it)
    assert status == "ABORTED" and "does not arrive" in words


def test_a_clock_that_is_set_back() -> None:
    it = cell()
    it.run_to("MOVING")
    it.now -= 50.0
    it.feed(Looked())
    assert ended(it)[0] == "ABORTED" and "clock was set back" in ended(it)[1]


# ── before it begins ─────────────────────────────────────────────────────────────────────────────────


def test_what_is_missing_is_waited_for_and_then_said() -> None:
    def never_moves(it: Cell, words: str) -> None:
        assert not sends(it)
        status, message = ended(it)
        assert status == "NOT_READY" and words in message and not it.sent, message

    it = Cell(cell().job, View(Watch()), Arm(HOME), deaf=True)
    never_moves(it, "nothing usable was heard on joint_states")
    missing = View(Watch(), missing=("nobody offers the action",))
    never_moves(Cell(cell().job, missing, Arm(HOME)), "nobody offers the action")
    dark = View(Watch(), beams=(Beam("tracker/locked", False, 100.0, 0.0),))
    never_moves(Cell(cell().job, replace(dark, watch=Watch(beam_silence=0.0)), Arm(HOME)), "bring the beam back")
    moving = Arm(HOME)
    moving.follow(smooth_trajectory([HOME, HOME + 3.0], Pace([0.1, 0.1])), 80.0, GOOD)
    never_moves(Cell(cell().job, View(Watch()), moving), "somebody else commands it")
    it = Cell(cell().job, missing, Arm(HOME))
    it.run(2.0)
    it.view = replace(it.view, missing=())
    assert ended(it)[0] == "SUCCESS"


def test_settings_that_contradict_each_other() -> None:
    with pytest.raises(InputError, match="tracking_tolerance"):
        Watch(tracking_tolerance=0.001)


# ── the tracker ──────────────────────────────────────────────────────────────────────────────────────


def test_a_lost_beam_ends_it() -> None:
    for phase in ("MOVING", "MEASURING"):
        it = cell(watch=Watch(beam_silence=0.0))
        it.view = it.view.beam(0, True, it.now)
        it.run_to(phase)
        it.view = it.view.beam(0, False, it.now)
        status, words = ended(it, 5.0)
        assert (
            status == "BEAM_LOST"
            and "tracker/locked: the tracker has lost the reflector; the robot stands" in words
        )
        assert len(sends(it)) == 1 and it.execution.executed == 0


def test_a_short_break_does_not() -> None:
    it = cell(watch=Watch(beam_silence=0.0))
    it.run_to("MEASURING")
    it.view = it.view.beam(0, False, it.now)
    it.run(0.4)
    it.view = it.view.beam(0, True, it.now)
    assert ended(it)[0] == "SUCCESS"


def test_a_tracker_that_falls_silent() -> None:
    it = cell()
    it.view = it.view.beam(0, True, it.now)
    status, words = ended(it)
    assert status == "BEAM_LOST" and "the tracker has said nothing for 2.0 s" in words


# ── people ───────────────────────────────────────────────────────────────────────────────────────────


def test_step_by_step() -> None:
    it = cell(step=True, times=[2, 1])
    it.confirming = False
    for number in range(3):
        it.run_to("CONFIRMING", number)
        before = len(sends(it))
        it.run(5.0)
        assert len(sends(it)) == before == number
        it.feed(Confirmed())
    assert ended(it)[0] == "SUCCESS"


def test_nobody_confirms() -> None:
    it = cell(step=True, watch=Watch(confirm_patience=10.0))
    it.confirming = False
    assert ended(it) == ("STOPPED", "nobody called ~/confirm for 10 s; send the rest of the plan")
    assert not it.sent


def test_a_confirmation_that_nothing_waits_for() -> None:
    it = cell()
    it.run_to("MOVING")
    assert "nothing waits" in it.execution.refused_confirmation()
    it.feed(Confirmed())
    assert it.execution.phase.name == "MOVING"


def test_no_confirmation_without_a_beam() -> None:
    it = cell(step=True, watch=Watch(beam_silence=0.0))
    it.confirming = False
    it.run_to("CONFIRMING")
    it.view = it.view.beam(0, False, it.now)
    it.run(1.0)
    it.feed(Confirmed())
    assert it.execution.phase.name == "CONFIRMING" and "lost" in it.execution.refused_confirmation()


@pytest.mark.parametrize("phase", ["MOVING", "MEASURING", "LEAVING", "CONFIRMING"])
def test_stopped_in_every_phase(phase: str) -> None:
    it = cell(replace(GOOD, result=2.0), step=True)
    it.confirming = phase != "CONFIRMING"
    it.run_to(phase)
    count = len(sends(it))
    it.feed(STOP)
    it.feed(Halted("CANCELLED", "later"))
    it.feed(Confirmed())
    status, words = ended(it)
    assert status == "STOPPED" and "somebody called" in words and len(sends(it)) == count


# ── ways that are planned ────────────────────────────────────────────────────────────────────────────


class PlannedCell(Cell):
    """Whose ways make a detour."""

    def planned(self, action: PlanWay) -> None:
        middle = 0.5 * (action.start + action.goal) + 0.1
        way = smooth_trajectory([action.start, middle, action.goal], Pace([5.0, 5.0]))
        self._due.append((self.now + 0.2, WayPlanned(action.number, way)))


def planned(kind: type[Cell], **options: Any) -> Cell:
    job = job_of(plan_of(ROBOT, Q, [2, 1]), ROBOT, PACE, HOME, planning_time=5.0, **options)
    return kind(job, View(Watch()), Arm(HOME))


def test_planned_ways_are_followed_no_faster_than_allowed() -> None:
    it = planned(PlannedCell)
    assert ended(it)[0] == "SUCCESS" and it.execution.executed == 3
    assert sum(isinstance(a, PlanWay) for _, a in it.sent) == 4  # there, aside, back, to the other
    for sent in sends(it):
        speed, push = sent.way.fastest()
        assert (speed <= 0.5 + 1e-9).all() and (push <= 1.0 + 1e-9).all()
    assert sends(it)[0].way.between(0.0, 99.0)[1][0] > 0.35, "the detour"


def test_a_way_that_is_not_planned() -> None:
    class None_(PlannedCell):
        def planned(self, action: PlanWay) -> None:
            self._due.append((self.now + 0.2, WayPlanned(action.number, None, "-31 no IK")))

    status, words = ended(planned(None_))
    assert status == "ABORTED" and words == "configuration 0: no way there was planned: -31 no IK"

    class Silent(PlannedCell):
        def planned(self, action: PlanWay) -> None:
            """No answer."""

    assert "planner of ways does not answer" in ended(planned(Silent))[1]


@pytest.mark.parametrize(("rows", "words"), [([HOME + 0.1, Q[0]], "begin"), ([HOME, Q[0] + 0.1], "end")])
def test_a_way_that_leads_elsewhere(rows: list[np.ndarray], words: str) -> None:
    class Elsewhere(PlannedCell):
        def planned(self, action: PlanWay) -> None:
            self._due.append((self.now, WayPlanned(action.number, smooth_trajectory(rows, PACE))))

    it = planned(Elsewhere)
    status, message = ended(it)
    assert status == "ABORTED" and f"does not {words} where it should: q" in message and not sends(it)


def test_moved_by_hand_between_planning_and_confirmation() -> None:
    it = planned(PlannedCell, step=True)
    it.confirming = False
    it.run_to("CONFIRMING")
    it.arm.rest = it.arm.rest + 0.02
    it.run(1.0)
    it.feed(Confirmed())
    assert "has left the place where the planned way begins" in ended(it)[1] and not sends(it)


# ── whatever happens ─────────────────────────────────────────────────────────────────────────────────


MANNERS = st.builds(
    Manner,
    answer=st.sampled_from([0.0, 0.02, 1.0, 4.0, 8.0, NEVER]),
    delay=st.sampled_from([0.0, 0.1, 2.0]),
    refuse=st.sampled_from([False, False, False, True]),
    result=st.sampled_from([0.0, 0.05, 1.0, 8.0, NEVER]),
    failure=st.sampled_from(["", "", "", "error -5"]),
    rate=st.sampled_from([1.0, 1.0, 1.0, 0.3, 0.0]),
    beyond=st.sampled_from([0.0, 0.0, 0.3]),
    off=st.sampled_from([0.0, 0.0, 0.003, 0.01]),
    halts=st.booleans(),
    confirms=st.booleans(),
    preempted=st.sampled_from([NEVER, NEVER, 0.4]),
)
HAPPENINGS = st.lists(
    st.tuples(
        st.integers(0, 400),
        st.sampled_from(
            ["halt", "cancel", "confirm", "dark", "light", "deaf", "hears", "push", "stray answer", "stray end"]
        ),
        st.integers(0, 3),
    ),
    max_size=8,
)


@settings(max_examples=repeats(30, 400), deadline=None, derandomize=True)
@given(
    manners=st.lists(MANNERS, min_size=1, max_size=4),
    happenings=HAPPENINGS,
    step=st.booleans(),
    good=st.booleans(),
)
def test_it_always_ends_and_never_moves_after_it_was_stopped(
    manners: list[Manner], happenings: list[tuple[int, str, int]], step: bool, good: bool
) -> None:
    watch = Watch(patience=2.0, confirm_patience=3.0, beam_silence=0.0)
    it = cell(times=[1, 2], step=step, watch=watch, period=0.05)
    manners = [GOOD] * 3 if good else manners
    at: dict[int, list[tuple[str, int]]] = {}
    for tick, what, which in happenings:
        at.setdefault(tick, []).append((what, which))
    halted_at: float | None = None
    for tick in range(4000):
        it.manner = manners[len(sends(it)) % len(manners)] if it._waiting is None else it.manner
        for what, which in at.get(tick, []):
            if what in ("halt", "cancel"):
                it.feed(STOP if what == "halt" else Halted("CANCELLED", "cancelled"))
                halted_at = it.now if halted_at is None else halted_at
            elif what == "confirm":
                it.feed(Confirmed())
            elif what in ("dark", "light"):
                it.view = it.view.beam(0, what == "light", it.now)
            elif what in ("deaf", "hears"):
                it.deaf = what == "deaf"
            elif what == "push":
                it.arm.rest = it.arm.rest + 0.003 * which
            elif what == "stray answer":
                it.feed(Answered(which, accepted=True))
            else:
                it.feed(Finished(which, succeeded=which > 1))
        before = it.execution
        it.step()
        new = [a for t, a in it.sent if t == it.now and isinstance(a, Send)]
        if it.execution.executed > before.executed:
            stood = [q for t, q in it.been if t > it.now - it.job.standstill]
            goal = it.job.visits[before.visit].waypoints[-1]
            assert max(np.abs(q - goal).max() for q in stood) <= watch.arrival_tolerance, "counted, but not stood"
        assert not (new and before.ending), "it moves after its end was decided"
        if new:
            assert it.view.stands and not it.view.silence(it.now) and not it.view.dark(it.now)
            others = {s.number for s in sends(it)} - {s.number for s in new}
            assert others <= {e.number for e in it.events if isinstance(e, Finished)}, "one goal at a time"
        if it.execution.ended:
            break
    execution = it.execution
    assert execution.ended, execution.phase
    assert not [a for t, a in it.sent if halted_at is not None and t > halted_at and not isinstance(a, Cancel)]
    visits = len(it.job.visits)
    assert execution.executed <= min(len(sends(it)), visits)
    assert execution.outcome is not None
    assert (execution.outcome.status == "SUCCESS") == (execution.executed == visits and execution.ending is None)
    if execution.goal is not None and execution.goal.over is None:
        assert execution.goal.number in cancels(it), "nothing is left running"
        assert execution.outcome.alarm
    if good and not happenings:
        assert execution.outcome.status == "SUCCESS"


# ── what a controller gets ───────────────────────────────────────────────────────────────────────────


def test_the_way_in_points() -> None:
    way = smooth_trajectory([HOME, Q[0], Q[1]], PACE)
    turn = float(PACE.times(np.abs(Q[0] - HOME)))
    assert way.seconds == pytest.approx(turn + float(PACE.times(np.abs(Q[1] - Q[0]))))
    assert np.allclose(way.at([-1.0, 0.0, turn, way.seconds, 99.0]), [HOME, HOME, Q[0], Q[1], Q[1]])
    assert np.allclose(way.velocities[[0, -1]], 0.0) and np.diff(way.times).max() <= 0.1 + 1e-9
    t = np.linspace(0.0, turn, 1001)
    tau = t / turn
    exact = HOME + np.outer(10 * tau**3 - 15 * tau**4 + 6 * tau**5, Q[0] - HOME)
    assert np.abs(way.at(t) - exact).max() < 1e-4 * np.abs(Q[0] - HOME).max()
    low, high = way.between(0.0, way.seconds)
    assert np.allclose(low, np.min([HOME, Q[0], Q[1]], axis=0)) and np.allclose(high, np.max([HOME, *Q], axis=0))


def test_velocities_are_the_derivative() -> None:
    way = smooth_trajectory([HOME, Q[0]], PACE)
    step = 1e-6
    inner = way.times[1:-1]
    slopes = (way.at(inner + step) - way.at(inner - step)) / (2 * step)
    assert np.allclose(slopes, way.velocities[1:-1], atol=1e-6)
    fine = np.linspace(0, way.seconds, 20001)
    speed = np.abs(np.diff(way.at(fine), axis=0)).max(axis=0) / np.diff(fine)[0]
    assert np.allclose(way.fastest()[0], speed, rtol=1e-3)


@pytest.mark.parametrize(
    ("times", "words"), [([0.0, 1.0, 1.0], "ascend"), ([0.1, 1.0, 2.0], "from 0"), ([0.0], "at least two")]
)
def test_what_is_no_trajectory(times: list[float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Trajectory(np.array(times), np.zeros((len(times), 2)), np.zeros((len(times), 2)))


def test_a_job_of_a_robot_that_slides_names_its_units() -> None:
    job: Job = cell().job
    assert job.units == ("rad", "rad") and job.joint_names == ("q1", "q2")


def test_joints_in_parts_are_put_together_once_each_has_come() -> None:
    view, joined = View(Watch()), Joined.of(2)
    for stamp, columns, values in [
        (1.0, (1,), [7.0]),
        (1.1, (1,), [8.0]),
        (1.2, (0,), [3.0]),
        (1.3, (0,), [4.0]),
    ]:
        joined, whole = joined.part(stamp, columns, np.array(values))
        view = view if whole is None else view.seen(whole, joined.joints)
    assert view.stamp == 1.1 and view.joints.tolist() == [3.0, 8.0]
    joined, whole = joined.part(1.4, None, np.array([5.0, 6.0]))
    assert whole == 1.4 and joined.joints.tolist() == [5.0, 6.0]
