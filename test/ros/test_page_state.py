# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the page shows, from messages alone: no node, no server, no browser."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import (
    CalibrationEstimate,
    CampaignStatus,
    JointConfiguration,
    Measurement,
    Reason,
    Residuals,
    Verdict,
)
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Vector3
from page_cases import BASE, COUNT, NAMES, Script

from calib_planner import Robot
from calib_planner.errors import InputError
from calib_planner.ros import page_state as ps
from calib_planner.ros.page_state import BUTTONS, PageState

S = CampaignStatus
KINDS = ("before", "review", "running", "confirm", "done", "gone")


@pytest.fixture(scope="module")
def script() -> Script:
    return Script()


def sections(state: PageState, before: PageState | None = None) -> dict[str, Any]:
    """What the browser is sent, as JSON holds it."""
    return {n: json.loads(json.dumps(make(), allow_nan=False)) for n, make in ps.changed(before, state)}


def refused(state: PageState) -> dict[str, str]:
    return {name: ps.refusal(state, name) for name in BUTTONS}


@pytest.mark.parametrize("kind", KINDS)
def test_every_state_has_all_sections(script: Script, kind: str) -> None:
    shown = sections(script.state(kind))
    assert list(shown) == list(ps.SECTIONS)
    assert sections(PageState()).keys() == shown.keys()


def test_a_section_is_made_again_only_when_what_it_shows_has_changed(script: Script) -> None:
    state = script.state("running")
    assert not sections(state, state)
    assert list(sections(ps.told(state, "", "a line"), state)) == ["journal"]
    assert list(sections(replace(state, joints=(0.0,) * 6), state)) == ["here"]
    after = ps.on_diagnostics(state, script.diagnostics())
    assert list(sections(after, state)) == ["streams"]


def test_every_section_names_the_fields_that_it_reads(script: Script) -> None:
    """A field that is changed and not named would leave old news on the screen."""
    states = [script.state(kind) for kind in ("review", "confirm", "done", "gone")]
    for name, (make, fields) in ps.SECTIONS.items():
        for state in states:
            for other in states:
                mixed = replace(other, **{f: getattr(state, f) for f in fields})
                assert json.dumps(ps.plain(make(mixed))) == json.dumps(ps.plain(make(state))), name


# ── what is happening ────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("state", "done", "phase", "word", "title"),
    [(S.IDLE, 0, None, "ready", "Nothing is under way"), (S.PLANNING, 6, None, "planning", "being planned"),
     (S.PAUSED, 0, None, "review", "then press Resume"),
     (S.PAUSED, 5, None, "paused", "until you press Resume"),
     (S.MEASURING, 5, 0, "measuring", "moves to configuration 5"),
     (S.MEASURING, 5, 1, "measuring", "stands still at configuration 5"),
     (S.MEASURING, 5, 2, "confirm", "waits until you confirm the move to configuration 5"),
     (S.MEASURING, 5, 3, "measuring", "The way to configuration 5"),
     (S.VALIDATING, 13, 1, "validating", "configuration 13"), (S.WAITING, 5, None, "waiting", "by itself"),
     (S.DONE, COUNT, None, "done", "Done")],
)  # fmt: skip
def test_it_says_what_happens(
    script: Script, state: int, done: int, phase: int | None, word: str, title: str
) -> None:
    value = replace(
        ps.on_status(PageState(names=NAMES), script.status(state, done)), there=frozenset(NAMES.values())
    )
    feedback = None if phase is None else ExecutePlan.Feedback(phase=phase)
    now = sections(ps.on_feedback(value, feedback))["now"]
    assert now["word"] == word and title in now["title"]


def test_which_visit_of_how_many(script: Script) -> None:
    there = frozenset(NAMES.values())

    def count(state: int, done: int) -> str:
        value = ps.on_status(PageState(names=NAMES, there=there), script.status(state, done))
        return str(sections(value)["now"]["count"])

    assert [count(S.PAUSED, 0), count(S.MEASURING, 0), count(S.MEASURING, 9), count(S.DONE, 16)] == [
        "about 16 visits",
        "visit 1 of about 16",
        "visit 10 of about 16",
        "16 measured",
    ]


def test_services_in_texts_are_the_buttons_of_the_page(script: Script) -> None:
    text = "somebody called ~/stop: call ~/resume; ~/unknown"
    state = ps.on_status(PageState(names=NAMES), script.status(S.PAUSED, 3, reason=text))
    state = replace(state, there=frozenset(NAMES.values()))
    assert sections(state)["now"]["reason"] == "Somebody called STOP: press Resume; ~/unknown"


def test_the_posture_is_that_of_the_present_configuration(script: Script) -> None:
    posture = sections(script.state("running"))["posture"]
    assert posture["number"] == 9 and len(posture["joints"]) == 6
    name, value = posture["joints"][0]
    assert name == script.robot.joint_names[0]
    assert float(value.rstrip("°").replace("−", "-")) == pytest.approx(np.degrees(script.q[9, 0]), abs=0.01)
    assert {tag for tag, _, _ in posture["shapes"]} <= {"path", "polyline", "circle", "rect", "text"}
    assert sections(script.state("done"))["posture"] is None


def test_facts_have_one_unit(script: Script) -> None:
    rows = {row["label"]: row for row in sections(script.state("done"))["numbers"]}
    assert rows["predicted accuracy"]["value"] == "0.0858 mm" and rows["predicted accuracy"]["kind"] == "good"
    assert rows["predicted accuracy"]["remark"] == "required 0.1000 mm"
    checked = rows["validation, rms"]
    assert (checked["value"], checked["remark"]) == ("0.0582 mm", "predicted 0.0641 mm")
    assert rows["measurements"]["value"] == "16"
    running = {row["label"]: row for row in sections(script.state("running"))["numbers"]}
    assert (
        running["validation, rms"]["value"] == "–" and running["validation, rms"]["remark"] == "0 of 4 measured"
    )


def test_charts(script: Script) -> None:
    shown = sections(script.state("done"))
    chart = shown["accuracy"]
    assert chart["required"] == pytest.approx(0.1) and [n for n, _ in chart["rounds"]] == [6, 10, 14]
    assert [n for n, _ in chart["live"]] == list(range(6, 17))
    assert chart["live"][-1][1] == pytest.approx(1e3 * script.accuracy(16))
    points = shown["residuals"]["points"]
    assert [n for n, _, _ in points] == list(range(1, 17)) and [u for _, _, u in points].count(False) == 1
    assert all(0 < mm < 0.2 for _, mm, _ in points)


def test_the_verdict_is_the_campaigns_in_the_end(script: Script) -> None:
    running, done = (sections(script.state(kind))["verdict"] for kind in ("running", "done"))
    assert "so far" in running["title"] and running["level"] == "WARN"
    assert "campaign" in done["title"] and done["level"] == "PASS" and len(done["reasons"]) == 2
    assert running["reasons"][0]["advice"].startswith("Measure more")
    assert sections(script.state("before"))["verdict"] is None


def test_streams_stand_still_or_move(script: Script) -> None:
    streams = sections(script.state("running"))["streams"]
    assert [s["motion"] for s in streams] == ["stands still, 1.4 s", "moves"]
    assert [s["level"] for s in streams] == ["OK", "WARN"]
    other = DiagnosticArray(status=[DiagnosticStatus(name="somebody: stream x")])
    state = script.state("running")
    assert ps.on_diagnostics(state, other) is state
    odd = DiagnosticStatus(name=f"/{NAMES['identifier']}: stream x", level=b"\7")
    odd.values = [KeyValue(key="standing still [s]", value="nonsense")]
    (shown,) = sections(ps.on_diagnostics(state, DiagnosticArray(status=[odd])))["streams"]
    assert shown == {"name": "x", "level": "STALE", "text": "", "motion": ""}


@pytest.mark.parametrize(
    ("named", "mine"), [("identifier", "left/identifier"), ("/right/identifier", "right/identifier")]
)
def test_streams_of_another_cell_are_not_shown(script: Script, named: str, mine: str) -> None:
    """Both cells speak on one topic."""
    cells = ("identifier", "left/identifier", "right/identifier")
    array = DiagnosticArray(status=[DiagnosticStatus(name=f"{cell}: stream of {cell}") for cell in cells])
    state = PageState(names={"identifier": named}, namespace="/left")
    assert [s.name for s in ps.on_diagnostics(state, array).streams] == [f"of {mine}"]


# ── the scene ────────────────────────────────────────────────────────────────────────────────────────


def test_points_are_drawn_at_the_reflector_of_the_robot_that_is_drawn(script: Script) -> None:
    """The page's robot, placed by the estimate, shows the points where they were measured."""
    scene = sections(script.state("done"))["scene"]
    robots, points = np.array(scene["robots"]), np.array(scene["points"])
    assert len(points) == len(robots) == COUNT and scene["ahead"] == []
    np.testing.assert_allclose(points, robots[:, -1], atol=2e-4)
    turn, place = script.true.base_pose
    np.testing.assert_allclose(scene["tracker"], -place @ turn, atol=1e-4)
    assert scene["states"].count(2) == 1 and scene["states"][3] == 2
    assert len(scene["test_robots"]) == 1


def test_rows_of_the_list_are_those_of_the_scene(script: Script) -> None:
    shown = sections(script.state("running"))
    assert [r["row"] for r in shown["visits"]["ahead"]] == shown["scene"]["ahead"] == list(range(9, 15))
    assert [r["number"] for r in shown["visits"]["ahead"]] == list(range(9, 15))
    assert [r["note"] for r in shown["visits"]["ahead"]] == ["now", "", "", "", "", ""]
    assert [r["row"] for r in shown["visits"]["done"]] == list(range(9))[::-1]
    words = {r["number"]: (r["word"], r["kind"]) for r in shown["visits"]["done"]}
    assert words[4] == ("outlier", "bad") and words[1] == ("used", "good")
    np.testing.assert_allclose(np.array(shown["scene"]["q"])[9:], script.q[9:15], atol=1e-5)
    validation = sections(script.state("done"))["visits"]["done"][0]
    assert validation["word"] == "validation"


def test_a_configuration_that_is_measured_several_times_is_one_row(script: Script) -> None:
    numbers = [7, 8, 9, 8, 8]
    rows = [script.joints(i) for i in numbers]
    state = ps.on_status(
        script.state("running"), script.status(S.PAUSED, 6, ahead=numbers, ahead_configurations=rows)
    )
    ahead = sections(state)["visits"]["ahead"]
    assert [(r["number"], r["note"]) for r in ahead] == [(7, ""), (8, "3 times"), (9, "")]


def test_before_an_estimate_no_point_is_drawn(script: Script) -> None:
    state = replace(PageState(robot=script.robot), names=NAMES)
    state = ps.on_measurement(state, script.measurement(0))
    scene = sections(state)["scene"]
    assert scene["points"] == [] and len(scene["robots"]) == 1 and scene["tracker"] is None
    none_yet = ps.on_estimate(state, CalibrationEstimate(status=CalibrationEstimate.STATUS_TOO_FEW_MEASUREMENTS))
    assert sections(none_yet)["scene"]["points"] == []


def test_the_robot_that_moves_is_drawn_as_those_of_the_scene(script: Script) -> None:
    state = replace(script.state("done"), joints=tuple(script.q[5]))
    shown = sections(state)
    np.testing.assert_allclose(shown["here"], shown["scene"]["robots"][5], atol=2e-4)
    assert sections(replace(state, joints=()))["here"] is None
    assert sections(replace(state, robot=None))["scene"] is None


def test_another_robot_is_named_and_not_drawn_with_wrong_joints(script: Script) -> None:
    state = replace(script.state("running"), robot=Robot.load("planar_2r"))
    shown = sections(state)
    assert "draws planar_2r" in shown["page"]["notice"] and shown["posture"] is None
    assert shown["visits"]["ahead"] == [] and shown["here"] is None and shown["scene"]["ahead"] == []
    unknown = sections(replace(state, robot=None))["page"]
    assert unknown["robot"] == "kuka_kr270" and "set its parameter robot" in unknown["notice"]


def test_two_targets_are_drawn(script: Script) -> None:
    state = script.state("done")
    message = script.measurement(0)
    message.points = [*message.points, Point(x=math.nan, y=0.0, z=0.0)]
    scene = sections(ps.on_measurement(state, message))["scene"]
    assert scene["target_count"] == 2 and len(scene["points"]) == COUNT


# ── buttons ──────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("kind", "possible"),
    [("before", "start stop skip_configuration"), ("review", "start resume stop skip_configuration"),
     ("running", "pause skip undo save report stop skip_configuration"),
     ("confirm", "pause skip confirm undo save report stop skip_configuration"),
     ("done", "start undo save report stop skip_configuration"), ("gone", "")],
)  # fmt: skip
def test_which_buttons_make_sense(script: Script, kind: str, possible: str) -> None:
    reasons = refused(script.state(kind))
    assert {name for name, reason in reasons.items() if not reason} == set(possible.split())
    assert all(re.fullmatch(r"[A-Za-z_][^.]*\.", reason) for reason in reasons.values() if reason)


def test_stop_pauses_where_there_is_no_executor(script: Script) -> None:
    state = script.state("running")
    assert ps.service_of(state, "stop") == "plan_executor/stop"
    state = replace(state, there=state.there - {"plan_executor/stop"})
    assert ps.service_of(state, "stop") == "calibration_campaign/pause" and not ps.refusal(state, "stop")


def test_a_button_waits_for_its_answer(script: Script) -> None:
    state = replace(script.state("running"), waiting=frozenset(["pause"]))
    assert ps.refusal(state, "pause") == "The answer has not come yet." and not ps.refusal(state, "skip")
    buttons = sections(state)["buttons"]
    assert buttons["pause"]["waiting"] and not buttons["skip"]["waiting"]


def test_the_page_has_every_button_once() -> None:
    page = ps.page_text()
    for name in BUTTONS:
        assert page.count(f'data-do="{name}"') == (name != "skip_configuration")
    assert page.count("<script>") == page.count("<style>") == 1 and "http" not in page.replace(
        "http://www.w3.org/2000/svg", ""
    ).replace('"https:"', "")
    assert "innerHTML" not in page and " style=" not in page and "onclick" not in page


# ── what does not fit ────────────────────────────────────────────────────────────────────────────────


def bad(message: Any, **values: Any) -> Any:
    for name, value in values.items():
        setattr(message, name, value)
    return message


@pytest.mark.parametrize(
    "take",
    [
        lambda s, x: ps.on_status(s, x.status(S.PAUSED, 3, configuration=JointConfiguration(positions=[0.0]))),
        lambda s, x: ps.on_status(s, x.status(S.PAUSED, 3, joint_names=["a"])),
        lambda s, x: ps.on_measurement(
            s, x.measurement(3, configuration=JointConfiguration(positions=[math.nan] * 6))
        ),
        lambda s, x: ps.on_measurement(s, x.measurement(3, joint_names=[])),
        lambda s, x: ps.on_estimate(s, bad(x.estimate(9), deviation=[1.0])),
        lambda s, x: ps.on_estimate(s, bad(x.estimate(9), joint_names=["a"])),
        lambda s, x: ps.on_residuals(s, bad(x.residuals(5), used=[True])),
    ],
)
def test_messages_that_do_not_fit_are_refused(
    script: Script, take: Callable[[PageState, Script], PageState]
) -> None:
    with pytest.raises(InputError):
        take(script.state("running"), script)


def test_huge_and_odd_messages_are_bounded(script: Script) -> None:
    long = "x" * 100_000
    state = script.state("running")
    many = [script.joints(0)] * 2000
    state = ps.on_status(
        state,
        script.status(S.PAUSED, 9, reason=long, robot=long, ahead=list(range(2000)), ahead_configurations=many),
    )
    verdict = Verdict(level=9, reasons=[Reason(level=7, text=long, advice=long)] * 500)
    state = ps.on_estimate(state, bad(script.estimate(9), verdict=verdict, predicted_accuracy=[math.inf]))
    for i in range(3):
        state = ps.on_measurement(
            state, script.measurement(i, points=[Point(x=math.inf)] * 500, reason=long, status=99)
        )
    residuals = Residuals(ids=[1], targets=[0], residuals=[Vector3(x=math.nan)], used=[True])
    state = ps.on_residuals(state, residuals)
    shown = sections(state)
    assert len(shown["visits"]["ahead"]) == ps.MOST_AHEAD and len(json.dumps(shown)) < 1_000_000
    assert shown["visits"]["done"][-1]["word"] == "rejected" and shown["residuals"]["points"] == []


def test_only_the_newest_are_kept(script: Script) -> None:
    state, message = PageState(robot=script.robot), script.measurement(0)
    for number in range(1, ps.MOST_VISITS + 51):
        message.id = number
        state = ps.on_measurement(state, message)
    assert len(state.visits) == ps.MOST_VISITS and 50 not in state.visits
    shown = sections(state)["visits"]
    assert len(shown["done"]) == ps.MOST_ROWS and shown["measured"] == ps.MOST_VISITS
    for n in range(100):
        state = ps.told(state, "", f"line {n}")
    assert len(state.journal) == ps.MOST_LINES and sections(state)["journal"][0]["text"] == "line 99"


def test_a_new_campaign_begins_with_an_empty_page(script: Script) -> None:
    state = ps.on_status(script.state("done"), script.status(S.PLANNING, 0, campaign_id="another"))
    assert not state.visits and not state.residuals and not state.history and not state.report
    assert sections(state)["visits"]["measured"] == 0


def test_the_estimate_moves_the_base(script: Script) -> None:
    robot = ps.placed(script.robot, ps.on_estimate(PageState(), script.estimate(9)).estimate, 1)
    np.testing.assert_allclose(robot.base_pose[1], [BASE["base.x"], BASE["base.y"], BASE["base.z"]])


def test_a_standstill_without_a_number_is_said() -> None:
    message = Measurement(status=Measurement.REJECTED_TOO_FEW_SAMPLES, reason="only 4 samples")
    state = ps.on_measurement(PageState(), message)
    assert not state.visits and state.journal[-1].text == "A standstill was not accepted: only 4 samples"
