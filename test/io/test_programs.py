# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Robot programs: a parser for each maker's text reads every value, visit, repetition and signal back."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots import mixed, plan_of, random_configurations

from calib_planner import Robot
from calib_planner.errors import FileFormatError, InfeasibleError, InputError, UnknownNameError
from calib_planner.io import (
    HANDSHAKES,
    ProgramSettings,
    controller_axes,
    program_formats,
    program_text,
    read_program_format,
)
from calib_planner.planning import JointRange, PlanSheet, person_factors, plan_sheet
from calib_planner.robot import parse_coupling

CLOSE = 1e-9
"""How near the values have to come back [rad]."""
KUKA = Robot.load("kuka_kr270")
REPETITIONS = [1, 3, 2, 1]


def kuka_sheet(robot: Robot = KUKA, visits: int = 4) -> PlanSheet:
    plan = plan_of(robot, random_configurations(robot, visits, 5))
    times = np.array((REPETITIONS * visits)[:visits])
    return plan_sheet(replace(plan, repetitions=times), robot)


# ── one parser for each format ───────────────────────────────────────────────────────────────────────


@dataclass
class Read:
    """What a parser saw: axes [rad], and in order ("move" | "wait" | "text" | "hold" | "out" | "in", value)."""

    axes: list[list[float]] = field(default_factory=list)
    events: list[tuple[str, Any]] = field(default_factory=list)

    def move(self, values: list[float], degrees: bool = True) -> None:
        self.axes.append(np.radians(values).tolist() if degrees else values)
        self.events.append(("move", len(self.axes)))


def numbers(text: str) -> list[float]:
    return [float(word) for word in re.findall(r"[-+]?\d+\.\d+", text)]


Rules = list[tuple[str, Callable[[Read, Any], None]]]


def event(kind: str, value: Any = None) -> Callable[[Read, Any], None]:
    return lambda seen, match: seen.events.append((kind, match[1] if value is None else value))


def by_lines(text: str, rules: Rules, ignored: str, read: Read) -> Read:
    """Every line has to match one of the rules, or be one of ``ignored``."""
    for line in text.splitlines():
        rule = next(((m, act) for pattern, act in rules if (m := re.fullmatch(pattern, line.strip()))), None)
        if rule is None:
            assert re.fullmatch(ignored, line.strip()), line
        else:
            rule[1](read, rule[0])
    return read


def read_urscript(text: str) -> Read:
    assert re.match(r"def [A-Za-z]\w*\(\):\n", text) and text.endswith("\nend\n")
    body = text.split("  end\n  set_standard_digital_out")[-1] if "def measured" in text else text
    if "def measured" in text:  # the handshake is written once
        inside = text.split("def measured(text):\n")[1]
        steps = re.findall(r"digital_out\((\d+), (\w+)\)|digital_in\((\d+)\) == (\w+)", inside)[:4]
        assert [(o or i, v or w) for o, v, i, w in steps] == [
            ("0", "True"),
            ("0", "False"),
            ("0", "False"),
            ("0", "True"),
        ]
    rules: Rules = [
        (r"movej\(\[(.*)\], a=0\.5, v=0\.2094\)", lambda r, m: r.move(numbers(m[1]), degrees=False)),
        (r"sleep\((.*)\)", event("wait")),
        (
            r'popup\("(Visit .*)", title="\w+", blocking=True\)',
            lambda r, m: r.events.extend([("text", m[1]), ("hold", 1)]),
        ),
        (r'measured\("(.*)"\)', lambda r, m: r.events.extend([("text", m[1]), *handshake("0", "0")])),
    ]
    return by_lines(body, rules, r'#.*|def .*|end|\(0, False\)|popup\("All 4 .*', Read())


def handshake(ready: str, done: str) -> list[tuple[str, Any]]:
    return [("out", (ready, 1)), ("in", (done, 1)), ("out", (ready, 0)), ("in", (done, 0))]


def read_rapid(text: str) -> Read:
    assert re.match(r"MODULE (\w{1,32})\n", text) and text.endswith("ENDMODULE\n")
    assert len(re.findall(r"PROC (\w{1,32})\(\)$", text, re.MULTILINE)) == 1
    assert all(len(t) <= 80 for t in re.findall(r'"(.*?)"', text))
    rules: Rules = [
        (
            r"MoveAbsJ \[\[(.*)\], \[(?:9E9, ){5}9E9\]\]\\NoEOffs, vVisit, fine, tool0;",
            lambda r, m: r.move(numbers(m[1])),
        ),
        (r"WaitTime \\InPos, (.*);", event("wait")),
        (r'TPWrite "(Visit .*)";', event("text")),
        (
            r'TPReadFK nKey, "(.*)"(?:, stEmpty){4}, "OK";',
            lambda r, m: r.events.extend([("text", m[1]), ("hold", 1)]),
        ),
        (r"SetDO doReady, (\d);", lambda r, m: r.events.append(("out", ("doReady", int(m[1]))))),
        (r"WaitDI diDone, (\d);", lambda r, m: r.events.append(("in", ("diDone", int(m[1]))))),
    ]
    declared = r'!.*|(END)?(MODULE|PROC)\b.*|LOCAL .*;|TPErase;|TPWrite "All 4 .*";|'
    return by_lines(text, rules, declared, Read())


def read_krl(text: str) -> Read:
    assert re.search(r"^DEF \w{1,24}\( \)$", text, re.MULTILINE) and text.endswith("END\n")
    assert text.index("DECL INT") < text.index("BAS(#INITMOV,0)") < text.index("PTP {")
    assert "BAS(#VEL_PTP,10)" in text
    assert all(len(t) <= 80 for t in re.findall(r'MSG_TXT\[\] "(.*?)"', text))
    axes = r",".join(rf"A{i} ([-\d.]+)" for i in range(1, 7))
    rules: Rules = [
        (rf"PTP \{{{axes}\}}", lambda r, m: r.move([float(g) for g in m.groups()])),
        (r"WAIT SEC (.*)", event("wait")),
        (r'CP_MSG=\{MODUL\[\] "\w{1,24}",NR \d+,MSG_TXT\[\] "(.*)"\}', event("text")),
        (r"HALT()", event("hold", 1)),
        (r"\$OUT\[(\d+)\]=(\w+)", lambda r, m: r.events.append(("out", (m[1], int(m[2] == "TRUE"))))),
        (r"WAIT FOR (NOT )?\$IN\[(\d+)\]", lambda r, m: r.events.append(("in", (m[2], int(not m[1]))))),
    ]
    ignored = r"&.*|;.*|DEF .*|DECL .*|BAS\(.*\)|CP_(OPT|PAR\[\d\])=\{.*\}|CP_HANDLE=SET_KRLMSG\(.*\)|END"
    return by_lines(text, rules, ignored, Read())


def read_fanuc(text: str) -> Read:
    assert re.match(r"/PROG  [A-Z]\w{0,35}\n/ATTR\n", text) and text.endswith("};\n/END\n")
    head, rest = text.split("/MN\n")
    lines, positions = rest.split("/POS\n")
    numbered = [re.fullmatch(r" *(\d+):(.*) ;", line) for line in lines.splitlines()]
    assert all(numbered) and [int(m[1]) for m in numbered if m] == list(range(1, len(numbered) + 1))
    assert f"LINE_COUNT\t= {len(numbered)};" in head and all(
        len(t) <= 24 for t in re.findall(r"\[(VISIT.*?)\]", text)
    )
    points = {int(n): numbers(block) for n, block in re.findall(r"P\[(\d+)\]\{(.*?)\};", positions, re.DOTALL)}

    def move(seen: Read, match: Any) -> None:
        j = points[int(match[1])]
        seen.move([j[0], j[1], j[2] + j[1], *j[3:]])  # J3 counts from the horizontal

    rules: Rules = [
        (r"J P\[(\d+)\] 10% FINE", move),
        (r"WAIT ([\d.]+)\(sec\)", event("wait")),
        (r"MESSAGE\[(VISIT .*)\]", event("text")),
        (r"PAUSE()", event("hold", 1)),
        (r"DO\[(\d+)\]=(\w+)", lambda r, m: r.events.append(("out", (m[1], int(m[2] == "ON"))))),
        (r"WAIT DI\[(\d+)\]=(\w+)", lambda r, m: r.events.append(("in", (m[1], int(m[2] == "ON"))))),
    ]
    body = "\n".join(m[2].strip() for m in numbered if m)
    return by_lines(body, rules, r"UFRAME_NUM=0|UTOOL_NUM=1|MESSAGE\[ALL .*\]", Read())


def read_drl(text: str) -> Read:
    """DRL is Python: the program runs, with a controller that writes down what it is told."""
    seen, said = Read(), []

    def log(words: str) -> None:
        said.append(words)
        if words.startswith("Visit"):
            seen.events.append(("text", words))

    controller = {
        "posj": lambda *q: list(q),
        "movej": lambda q, vel, acc: seen.move(q),
        "wait": lambda seconds: seen.events.append(("wait", f"{seconds:.2f}")),
        "tp_popup": lambda words, kind: seen.events.extend([("text", words), ("hold", 1)]),
        "tp_log": log,
        "set_digital_output": lambda n, value: seen.events.append(("out", (str(n), value))),
        "wait_digital_input": lambda n, value: seen.events.append(("in", (str(n), value))),
        **{"DR_PM_MESSAGE": 0, "ON": 1, "OFF": 0},
    }
    exec(compile(text, "program.drl", "exec"), {"__builtins__": {}, **controller})
    assert said[-1] == "All 4 visits are done."
    return seen


def read_kawasaki(text: str) -> Read:
    assert re.match(r"\.PROGRAM \w{1,15}\(\)\n", text) and text.endswith("\n.END\n")
    rules: Rules = [
        (r"JMOVE #\[(.*)\]", lambda r, m: r.move(numbers(m[1]))),
        (r"TWAIT (.*)", event("wait")),
        (r'PRINT "(Visit .*)"', event("text")),
        (r"PAUSE()", event("hold", 1)),
        (r"SIGNAL (-?)(\d+)", lambda r, m: r.events.append(("out", (m[2], int(not m[1]))))),
        (r"SWAIT (-?)(\d+)", lambda r, m: r.events.append(("in", (m[2], int(not m[1]))))),
    ]
    return by_lines(text, rules, r';.*|\.\w+.*|SPEED 10 ALWAYS|ACCURACY 1 ALWAYS|BREAK|PRINT "All 4 .*"', Read())


READERS = {
    "urscript": read_urscript,
    "rapid": read_rapid,
    "krl": read_krl,
    "fanuc": read_fanuc,
    "drl": read_drl,
    "kawasaki": read_kawasaki,
}


def test_every_shipped_format_has_a_reader() -> None:
    assert program_formats() == sorted(READERS)


@pytest.mark.parametrize("handshake_kind", HANDSHAKES)
@pytest.mark.parametrize("name", READERS)
def test_values_order_texts_and_signals_come_back(name: str, handshake_kind: str) -> None:
    sheet, form = kuka_sheet(), read_program_format(name)
    text = program_text(sheet, form, ProgramSettings(handshake=handshake_kind, settle=2.5))
    assert text.isascii() and ("\r\n" in text) == (form.newline == "\r\n")
    assert text.count("\n") == text.count(form.newline)
    read = READERS[name](text.replace("\r\n", "\n"))
    assert not KUKA.beyond_limits(np.array(read.axes)).any()
    ready, done = str(form.ready), str(form.done)
    assert next(e for e in read.events if e != ("out", (ready, 0))) == ("move", 1)
    expected: list[tuple[str, Any]] = [("out", (ready, 0))] if read.events[0][0] == "out" else []
    waits = handshake(ready, done) if handshake_kind == "io" else [("hold", 1)]
    places: list[Any] = []
    for i, times in enumerate(REPETITIONS, 1):
        here = sheet.plan.configurations[i - 1]
        for k in range(1, times + 1):
            for place in (here + inward(here), here)[k == 1 :]:  # off and back, but for the first
                places.append(place)
                expected.append(("move", len(places)))
            expected += [("wait", "2.50"), ("text", (i, k, times)), *waits]
    assert [(kind, understood(value) if kind == "text" else value) for kind, value in read.events] == expected
    np.testing.assert_allclose(read.axes, places, rtol=0, atol=CLOSE)


def inward(q: np.ndarray) -> np.ndarray:
    """(joints,) 0.05 rad of every joint, away from its nearer limit: where the timetable turns round."""
    low, high = KUKA.joint_limits.T
    return np.asarray(np.where(high - q >= q - low, 0.05, -0.05))


def stops(read: Read) -> np.ndarray:
    """(stops, joints) where the robot stands before each text."""
    at = [value for kind, value in read.events if kind in ("move", "text")]
    return np.array([read.axes[a - 1] for a, b in itertools.pairwise(at) if isinstance(b, str)])


@pytest.mark.parametrize("name", READERS)
def test_the_robot_backs_off_where_the_timetable_says(name: str) -> None:
    """From visit to visit, too, where both are nearly at one place; program and trajectory agree."""
    q = random_configurations(KUKA, 4, 5)
    q[2] = q[1] + 0.4 * inward(q[1])
    sheet = plan_sheet(replace(plan_of(KUKA, q), repetitions=np.array(REPETITIONS)), KUKA)
    read = READERS[name](program_text(sheet, read_program_format(name)).replace("\r\n", "\n"))
    points = [p for p, _ in sheet.timetable.points(q)]  # at rest before and after each measurement, and aside
    ways = [a for a, b in itertools.pairwise([*points, None]) if a != b]
    assert len(ways) == len(read.axes) == 4 + 2 * 3 + 1
    np.testing.assert_allclose(read.axes, ways, rtol=0, atol=CLOSE)
    np.testing.assert_allclose(stops(read), np.repeat(q, REPETITIONS, axis=0), rtol=0, atol=CLOSE)


def understood(words: str) -> tuple[int, ...]:
    """Visit, then measurement and repetitions; four visits in all."""
    visit, visits, *rest = (int(n) for n in re.findall(r"\d+", words))
    assert visits == 4
    return (visit, *rest)


def test_a_speed_a_tool_and_signals_of_the_user() -> None:
    settings = ProgramSettings(speed_share=0.25, ready="17", done="21", tool="3", handshake="io", name="Mine")
    text = program_text(kuka_sheet(), read_program_format("krl"), settings)
    assert "BAS(#VEL_PTP,25)" in text and "BAS(#TOOL,3)" in text and "DEF Mine( )" in text
    assert text.count("$OUT[17]=TRUE") == text.count("WAIT FOR $IN[21]") == sum(REPETITIONS)
    assert "vVisit := [250.0, 125.0," in program_text(
        kuka_sheet(), read_program_format("rapid"), ProgramSettings(speed_share=0.25)
    )


def test_signs_zeros_and_coupling() -> None:
    sheet, form = kuka_sheet(), read_program_format("fanuc")
    signs, zeros = np.array([1, -1, 1, -1, 1, -1]), np.array([0, 0.5, -0.25, 0, 0, 1])
    axes = controller_axes(sheet, form, ProgramSettings(signs=signs, zeros=zeros))
    q = signs * sheet.plan.configurations + zeros
    np.testing.assert_array_equal(axes[:, [0, 1, 3, 4, 5]], q[:, [0, 1, 3, 4, 5]])
    np.testing.assert_array_equal(axes[:, 2], q[:, 2] - q[:, 1])
    alone = controller_axes(sheet, form, ProgramSettings(coupling=0))
    np.testing.assert_array_equal(alone, sheet.plan.configurations)


def test_two_joints_have_no_third_that_could_be_coupled() -> None:
    robot = Robot.load("planar_2r")
    sheet, form = plan_sheet(plan_of(robot, np.zeros((2, 2))), robot), read_program_format("urscript")
    form = replace(form, joints=None)
    assert controller_axes(sheet, form, ProgramSettings(coupling=0)).shape == (2, 2)
    with pytest.raises(InputError, match="coupling: expected 0 for a robot of 2 joints"):
        controller_axes(sheet, form, ProgramSettings(coupling=1.0))


def test_a_robot_that_shows_its_coupling_is_not_coupled_again() -> None:
    coupled = KUKA.with_couplings([parse_coupling("joint_a3-=joint_a2")])
    sheet, form = kuka_sheet(coupled), read_program_format("fanuc")
    np.testing.assert_array_equal(controller_axes(sheet, form, ProgramSettings()), sheet.plan.configurations)
    again = controller_axes(sheet, form, ProgramSettings(coupling=-1.0))
    assert not np.array_equal(again, sheet.plan.configurations)


def test_the_coupling_keeps_the_forearms_inclination() -> None:
    """J2 moves, J3 stays: the forearm of the chain turns back by as much, so the tip only shifts."""
    sheet = kuka_sheet()
    q = np.array([[0.0, -1.2, 1.3, 0, 0.4, 0], [0.0, -1.5, 1.6, 0, 0.4, 0]])
    sheet = plan_sheet(plan_of(KUKA, q), KUKA)
    axes = controller_axes(sheet, read_program_format("fanuc"), ProgramSettings(coupling=1.0))
    assert axes[0, 2] == pytest.approx(axes[1, 2])  # this robot's axes 2 and 3 turn the same way
    turned = KUKA.posture(q).tip_rotation
    np.testing.assert_allclose(turned[0], turned[1], atol=1e-12)


@pytest.mark.parametrize("name", READERS)
def test_names_cannot_end_a_comment_or_a_text(name: str) -> None:
    """The readers refuse every line that they do not expect."""
    evil = replace(KUKA, name='x";\nHALT\n*/ ]] end\r\n{{ 7 * 7 }} é')
    text = program_text(kuka_sheet(evil), read_program_format(name))
    assert len(READERS[name](text.replace("\r\n", "\n")).axes) == 10
    assert text.isascii() and (name == "fanuc" or "x___HALT_" in text)


def test_nothing_is_written_to_where_the_robot_cannot_go() -> None:
    q = np.vstack([random_configurations(KUKA, 2, 1), KUKA.joint_limits[:, 1] + 0.01])
    with pytest.raises(InfeasibleError, match="visit 3 of the plan breaks it; no program goes there"):
        program_text(plan_sheet(plan_of(KUKA, q), KUKA), read_program_format("krl"))
    narrow = JointRange({"joint_a1": (-0.01, 0.01)})
    with pytest.raises(InfeasibleError, match="visit 1"):
        program_text(plan_sheet(plan_of(KUKA, q[:2]), KUKA, [narrow]), read_program_format("krl"))


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("krl", {"name": "a" * 25}, "at most 24 characters"),
        ("krl", {"name": "1a"}, "a letter, then letters"),
        ("krl", {"ready": "doReady"}, "a whole number, such as 1"),
        ("rapid", {"done": "7"}, "a name of letters"),
        ("urscript", {"tool": "1"}, "the template names none"),
        ("krl", {"signs": [1, 1, 1, 1, 1, 0]}, "1 or -1"),
        ("krl", {"zeros": [0.0]}, "zeros"),
        ("krl", {"speed_share": 0.0}, "speed_share"),
        ("krl", {"speed_share": 1.5}, "speed_share"),
        ("krl", {"settle": -1.0}, "settle"),
        ("krl", {"handshake": "shout"}, "one of: pause, io"),
    ],
)
def test_settings_that_do_not_fit_are_refused(name: str, settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        program_text(kuka_sheet(), read_program_format(name), ProgramSettings(**settings))


def test_a_robot_of_other_joints_needs_a_template_of_its_own(tmp_path: Path) -> None:
    robot = mixed()
    sheet = plan_sheet(plan_of(robot, random_configurations(robot, 3, 1)), robot)
    with pytest.raises(InputError, match="6 joints for KUKA"):
        program_text(sheet, read_program_format("krl"))
    path = tmp_path / "own.j2"
    path.write_text(
        "{#---\ntitle: Own\nsuffix: .txt\nname_length: 9\nready: 1\ndone: 2\n---#}\n"
        "{% for v in visits %}{% for p in (v, v.aside) %}{{ p.radians|join(' ') }} | {{ p.degrees|join(' ') }}\n"
        "{% endfor %}{% endfor %}"
    )
    lines = program_text(sheet, read_program_format(str(path))).splitlines()
    si, shown = (np.array([numbers(line.split("|")[k]) for line in lines]) for k in (0, 1))
    np.testing.assert_allclose(si[::2], sheet.plan.configurations, rtol=1e-12)
    np.testing.assert_allclose(si[1::2], sheet.timetable.aside, rtol=1e-12)
    np.testing.assert_allclose(shown[::2], sheet.degrees, rtol=1e-12)
    np.testing.assert_allclose(shown[1::2], sheet.timetable.aside * person_factors(robot), rtol=1e-12)


HEAD = "{#---\ntitle: T\nsuffix: .t\nname_length: 9\nready: 1\ndone: 1\n---#}\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("no head", "first line"),
        (HEAD.replace("title: T\n", ""), "title"),
        (HEAD.replace("ready: 1", "ready: 'a;b'"), "ready"),
        (HEAD.replace("title", "titel"), "titel"),
        (HEAD + "a\n{{ missing }}\n", "line 9: .*missing"),
        (HEAD + "a\nb\n{% if %}", "line 10"),
        (HEAD + "{{ visits.__class__ }}", "line 8: .*unsafe"),
        (HEAD + "{{ 1 / 0 }}", "line 8: .*zero"),
    ],
)
def test_a_template_with_a_mistake_names_its_line(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "my.j2"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=words):
        program_text(kuka_sheet(), read_program_format(str(path)))


def test_an_unknown_format_names_those_that_are_there() -> None:
    with pytest.raises(UnknownNameError, match=r"krl.*rapid"):
        read_program_format("rapidd")
