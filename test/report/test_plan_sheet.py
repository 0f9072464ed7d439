# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The page: all numbers of the sheet, nothing from elsewhere, nothing claimed, drawings true to scale."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from robots import changed, mixed, plan_of, random_configurations
from scipy.spatial.transform import Rotation

from calib_planner import Robot
from calib_planner.planning import ReflectorAcceptance, TrackerRange, plan_sheet
from calib_planner.planning.constraints import Custom
from calib_planner.report.plan_sheet import BOXES, posture_drawings, sheet_page
from calib_planner.report.render import svg
from calib_planner.tracker import LaserTracker
from calib_planner.units import duration, length, signed

STATION = np.array([4.0, 1.5, 1.2])
VOID = {"meta", "link", "col", "br", "input", "path", "rect", "circle", "polyline"}


class Page(HTMLParser):
    """Text of each row, all attributes, and whether every element that was opened is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.rows: dict[str, str] = {}
        self.row = ""
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(text.replace("<wbr>", ""))  # where a long name may be broken
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag == "tr":
            self.row = dict(attrs).get("id", "head")
            self.rows[self.row] = self.rows.get(self.row, "")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        self.row = "" if tag == "tr" else self.row

    def handle_data(self, data):
        if self.row:
            self.rows[self.row] += data + " "


def kuka_sheet(*args, **options):
    robot = Robot.load("kuka_kr270")
    return plan_sheet(plan_of(robot, random_configurations(robot, 5, 1), 3), robot, *args, **options)


@pytest.mark.parametrize("make", [lambda: Robot.load("kuka_kr270"), mixed], ids=["kuka", "mixed"])
def test_every_visit_has_its_numbers_and_boxes(make):
    robot = make()
    sheet = plan_sheet(plan_of(robot, random_configurations(robot, 6, 2), 3), robot)
    page = Page(sheet_page(sheet))
    assert [k for k in page.rows if k != "head"] == [f"stop{i}" for i in range(1, 7)]
    for i, q in enumerate(sheet.plan.configurations):
        text = page.rows[f"stop{i + 1}"]
        for name, turns, value in zip(robot.joint_names, robot.joint_is_revolute, q, strict=True):
            big = f"{np.degrees(value):.3f}°" if turns else f"{1e3 * value:.3f} mm"
            assert name in text and big.replace("-", "−") in text and f"{value:.6f}".replace("-", "−") in text
        way = np.degrees(np.abs(sheet.timetable.travel[i][robot.joint_is_revolute]))
        assert (f"by {way.max():.0f}°" in text) == (i > 0)
        for point in robot.positions(q[None])[0]:
            shown = [f"{axis}\u00a0{signed(1e3 * x, 0)}" for axis, x in zip("xyz", point, strict=True)]
            assert " ".join(shown) in text
    ticks = [v for tag, name, v in page.attributes if tag == "input" and name == "aria-label"]
    assert [v for tag, name, v in page.attributes if tag == "textarea" and name == "data-field"][1] == "2.note"
    assert len(ticks) == 18 and ticks[3] == "visit 2, measurement 1"
    for promise in ("20 µm", "15 µm", "75.0 %", "18", sheet.identity, "reduced speed"):
        assert promise in sheet_page(sheet)


def test_the_page_needs_nothing_from_elsewhere():
    text = sheet_page(kuka_sheet())
    page = Page(text)
    assert not [a for a in page.attributes if a[1] in ("src", "href", "xlink:href", "srcset", "action")]
    assert "url(" not in text and "@import" not in text and "http://" not in text and "https://" not in text
    assert "default-src 'none'" in text and "innerHTML" not in text


def test_nothing_is_claimed_that_was_not_checked():
    rows = Page(sheet_page(kuka_sheet())).rows
    assert all("range" not in rows[f"stop{i}"] and "az" not in rows[f"stop{i}"] for i in range(1, 6))
    sheet = kuka_sheet((), LaserTracker(station=STATION))
    known, away = (
        Page(sheet_page(sheet)).rows["stop1"],
        sheet.robot.positions(sheet.plan.configurations)[0, 0] - STATION,
    )
    flat = np.hypot(away[0], away[1])
    angles = np.degrees([np.arctan2(away[1], away[0]), np.arctan2(away[2], flat)])
    shown = [f"{name}\u00a0{signed(a, 1)}°" for name, a in zip(("az", "el"), angles, strict=True)]
    assert ", ".join([*shown, f"range\u00a0{np.linalg.norm(away):.3f}\u00a0m"]) in known
    assert "incidence" not in known and "station at x\u00a04000 y\u00a01500 z\u00a01200 mm" in sheet_page(sheet)
    text = sheet_page(kuka_sheet())
    assert re.search(r"Not checked:</strong> tracker range, .*line of sight, self-collision, other objects", text)
    assert "Not reachable" not in text and "Not visible" not in text


def test_what_is_wrong_is_said_with_its_reason():
    view = (TrackerRange(STATION, 0.0, 0.1), ReflectorAcceptance(STATION, [1.0, 0, 0], np.pi))
    sheet = kuka_sheet((*view, Custom("no <b>room</b>", lambda q: q[:, 0] > q[2, 0])))
    text = sheet_page(sheet)
    page = Page(text)
    assert "<b>room</b>" not in text and "no &lt;b&gt;room&lt;/b&gt;" in text
    for i, (reach, q) in enumerate(zip(sheet.checks.reachable, sheet.plan.configurations, strict=True), 1):
        row = page.rows[f"stop{i}"]
        assert reach == (q[0] > sheet.plan.configurations[2, 0])
        assert ("no <b>room</b>" in row) != reach and "tracker range" in row and "incidence" in row
        assert "Do not go there" in row
    assert "Not visible: visits 1, 2, 3, 4, 5." in text and "Not reachable: visit" in text
    other = replace(sheet, plan=changed(sheet.plan, robot="<another>", status="singular", message="Beware."))
    assert "made for &lt;another&gt;" in sheet_page(other) and "singular: Beware." in sheet_page(other)


def test_many_repetitions_get_one_box():
    robot = Robot.load("planar_2r")
    text = sheet_page(plan_sheet(plan_of(robot, np.zeros((2, 2)), BOXES + 1), robot))
    assert text.count('type="checkbox" data-field') == 2 and f"{BOXES + 1} ×" in text


def test_criteria_without_a_bound_have_none_on_the_page():
    robot = Robot.load("planar_2r")
    nan = float("nan")
    changes = {"criterion": "o3", "value_bound": nan, "lower_bound": nan, "efficiency": nan, "bound": "none"}
    plan = plan_of(robot, np.zeros((1, 2)), **changes, test_poses=np.zeros((0, 2)), weights=np.zeros(0))
    text = sheet_page(plan_sheet(plan, robot))
    assert "this criterion has none" in text and "nan" not in text and "ρ0" not in text


def drawings(*args):
    return list(map(svg, posture_drawings(*args)))


def arms(drawing: str) -> list[np.ndarray]:
    """(points, 2) of every view's polyline, y upwards."""
    found = re.findall(r'class="arm" points="([^"]*)"', drawing)
    return [np.array([float(w) for w in p.split()]).reshape(-1, 2) * [1, -1] for p in found]


def test_the_drawing_of_a_planar_arm_is_the_arm():
    robot = Robot.load("planar_2r")
    q = random_configurations(robot, 8, 3)
    for (q1, q2), drawing in zip(q, drawings(robot, q), strict=True):
        (arm,) = arms(drawing)  # from above only
        base, elbow, tip = arm[0], arm[-2], arm[-1]
        upper, fore = complex(*(elbow - base)), complex(*(tip - elbow))
        assert abs(upper) / abs(fore) == pytest.approx(1.0 / 0.8, abs=0.01)
        assert np.exp(1j * np.angle(upper)) == pytest.approx(np.exp(1j * q1), abs=0.01)
        assert np.exp(1j * np.angle(fore / upper)) == pytest.approx(np.exp(1j * q2), abs=0.01)


def test_the_side_view_shows_the_height_and_the_reach_of_the_tip():
    robot = Robot.load("kuka_kr270")
    q = random_configurations(robot, 12, 4)
    tips = robot.positions(q)[:, 0]
    scale = None
    for tip, drawing in zip(tips, drawings(robot, q), strict=True):
        side, top = arms(drawing)
        out, up = side[-1] - side[0]
        x, y = top[-1] - top[0]
        scale = np.hypot(x, y) / np.hypot(*tip[:2]) if scale is None else scale
        assert np.array([x, y, up, out]) / scale == pytest.approx([*tip, np.hypot(*tip[:2])], abs=0.2 / scale)
        box = np.array([float(w) for w in re.findall(r'viewBox="0 0 (\S+) (\S+)"', drawing)[0]])
        for view in (side, top):
            assert (view * [1, -1] >= 0).all() and (view * [1, -1] <= box).all()
        assert ">side<" in drawing and ">top<" in drawing


def test_drawings_are_in_the_axes_of_the_base():
    robot = Robot.load("kuka_kr270")
    placed = robot.with_base(Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix(), [0.5, -1.0, 0.3])
    q = random_configurations(robot, 4, 5)
    moved = placed.base_pose[0] @ STATION + placed.base_pose[1]
    pairs = zip(drawings(robot, q, STATION), drawings(placed, q, moved), strict=True)
    for here, there in pairs:
        assert here.count("beam") == 1
        a, b = (np.array([float(w) for w in re.findall(r"-?\d+\.\d", d)]) for d in (here, there))
        np.testing.assert_allclose(a, b, rtol=0, atol=0.11)  # one decimal is drawn


def test_quantities():
    assert length(1.234e-5) == "12.3 µm" and length(0.0123456) == "12.35 mm" and length(np.inf) == "unlimited"
    assert duration(42.4) == "42 s" and duration(600) == "10 min" and duration(7500) == "2 h 05 min"
    assert signed(-1.5, 1) == "−1.5" and signed(-1e-9, 3) == "0.000" and signed(-0.0, 3) == "0.000"
