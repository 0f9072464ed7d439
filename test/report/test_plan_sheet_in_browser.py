# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The plan sheet in a browser: it remembers ticks and notes, gives them back as CSV, and fits its paper."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, browser
from robots import plan_of, random_configurations

from calib_planner import Robot
from calib_planner.planning import PlanSheet, plan_sheet
from calib_planner.report import write_sheet_page
from calib_planner.tracker import LaserTracker

UR = Path(__file__).resolve().parents[2] / "docs" / "examples" / "ur10e.urdf"


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as made:
        yield made


def sheet_of(visits: int, repetitions: int) -> PlanSheet:
    """Of a robot with long names of joints, and with all that a station tells."""
    robot = Robot.load(str(UR))
    plan = plan_of(robot, random_configurations(robot, visits, 3), repetitions)
    return plan_sheet(plan, robot, (), LaserTracker(station=np.array([4.0, 1.5, 1.2])))


FILL = """
const set = (name, value) => {
  const field = document.querySelector(`[data-field="${name}"]`);
  if (field.type === "checkbox") field.checked = value; else field.value = value;
  field.dispatchEvent(new Event("input", { bubbles: true }));
};
"""


def test_ticks_and_notes_outlive_the_page_and_come_back_as_csv(chromium: Browser, tmp_path: Path) -> None:
    page, sheet = tmp_path / "sheet.html", sheet_of(3, 2)
    write_sheet_page(page, sheet)
    tab = chromium.open(page)
    tab.run(
        FILL
        + """set("1.1", true); set("1.2", true); set("3.2", true); set("2.1", true); set("2.1", false);
        set("2.note", 'dust, "wiped"\\nthen good'); set("operator", "Ada");"""
    )
    assert tab.run("return document.getElementById('count').textContent") == "3 of 6 measured"
    again = chromium.open(page)  # a new tab of the same file
    assert again.run("return document.getElementById('count').textContent") == "3 of 6 measured"
    rows = list(csv.DictReader(again.run("return sheetCsv()").splitlines(keepends=True)))
    assert [(r["visit"], r["measurement"], r["measured"]) for r in rows] == [
        (str(v), str(k), "yes" if (v, k) in {(1, 1), (1, 2), (3, 2)} else "no") for v in (1, 2, 3) for k in (1, 2)
    ]
    assert all(r["plan"] == sheet.identity and r["operator"] == "Ada" for r in rows)
    assert {r["note"] for r in rows if r["visit"] == "2"} == {'dust, "wiped"\nthen good'}
    for r in rows:
        assert bool(re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:.]+Z", r["measured_at"])) == (r["measured"] == "yes")
    saved = again.run(
        """let name = ""; HTMLAnchorElement.prototype.click = function () { name = this.download; };
        document.getElementById("save").click(); return name;"""
    )
    assert saved == f"measured_{sheet.identity}.csv"
    again.run("window.confirm = () => true; document.getElementById('clear').click();")
    assert chromium.open(page).run("return document.getElementById('count').textContent") == "0 of 6 measured"
    assert not tab.problems and not again.problems


def test_another_plan_begins_without_ticks(chromium: Browser, tmp_path: Path) -> None:
    page = tmp_path / "sheet.html"
    write_sheet_page(page, sheet_of(2, 1))
    chromium.open(page).run(FILL + 'set("1.1", true);')
    write_sheet_page(page, sheet_of(4, 1))
    assert chromium.open(page).run("return document.getElementById('count').textContent") == "0 of 4 measured"


def test_thirty_visits_are_three_pages_of_a4(chromium: Browser, tmp_path: Path) -> None:
    page = tmp_path / "sheet.html"
    write_sheet_page(page, sheet_of(30, 2))
    paper = chromium.open(page).paper()
    assert len(re.findall(rb"/Type\s*/Page\b", paper)) == 3


@pytest.mark.parametrize("width", [1280, 1000, 420])
def test_no_word_is_broken_and_nothing_overlaps(chromium: Browser, tmp_path: Path, width: int) -> None:
    """A break within a name comes after its underscore; no cell is narrower than what is in it."""
    page = tmp_path / "sheet.html"
    write_sheet_page(page, sheet_of(3, 2))
    wide = chromium.open(page, width=width).run(
        """const texts = document.querySelectorAll(".joints div, .aim, th, .told p, .sub, label");
        const wide = Array.from(texts).filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => e.textContent);
        if (document.documentElement.scrollWidth > innerWidth) wide.push("page");
        const cut = Array.from(document.querySelectorAll("*"))
          .filter((e) => ["anywhere", "break-all"].includes(getComputedStyle(e).overflowWrap)
            || getComputedStyle(e).wordBreak !== "normal" || getComputedStyle(e).hyphens === "auto");
        return [wide, cut.map((e) => e.tagName)];"""
    )
    assert wide == [[], []]
