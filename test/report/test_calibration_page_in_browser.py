# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The report in a real browser: no errors, the 3-D view draws and turns, tables sort; screen, phone and paper."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, Tab, browser
from calibration_cases import CASES, Case, hostile, kuka, outliers
from robots import repeats

from calib_planner.error_model import ErrorModel
from calib_planner.report import write_report

ALL = {**CASES, "hostile": lambda: hostile()[0]}
HELP = """
const frame = () => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
const canvas = document.getElementById("canvas-3d"), box = canvas.getBoundingClientRect();
await frame();
const copy = Object.assign(document.createElement("canvas"), { width: canvas.width, height: canvas.height });
const pen = copy.getContext("2d", { willReadFrequently: true });
pen.drawImage(canvas, 0, 0);
const pixels = pen.getImageData(0, 0, copy.width, copy.height).data;
"""


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as running:
        yield running


@pytest.fixture(scope="module")
def case() -> Case:
    """With rejected points and a tracker."""
    return outliers()


@pytest.fixture(scope="module")
def page(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, *case)
    return path


def picture(tab: Tab) -> str:
    """Something that is the same for the same picture only."""
    sum_up = "let sum = 0; pixels.forEach((v, i) => { sum = (sum * 31 + v * (i % 251)) % 1e9; });"
    return str(tab.run(HELP + sum_up + "return sum;"))


def place(tab: Tab, across: float = 0.5, down: float = 0.5) -> tuple[float, float]:
    """Where in the window a point of the canvas is; the page is scrolled to the canvas."""
    tab.run(HELP + "canvas.scrollIntoView();")
    box = tab.run(HELP + "return [box.x, box.y, box.width, box.height];")
    return box[0] + across * box[2], box[1] + down * box[3]


@pytest.mark.parametrize("name", ALL)
def test_it_loads_without_a_complaint_and_draws_every_point(chromium: Browser, tmp_path: Path, name: str) -> None:
    problem, estimate = ALL[name]()
    write_report(tmp_path / "report.html", problem, estimate)
    tab = chromium.open(tmp_path / "report.html")
    seen = tab.run(
        HELP
        + """
        let inked = 0;
        for (let i = 0; i < pixels.length; i += 4) inked += pixels[i] + pixels[i + 1] + pixels[i + 2] < 600;
        return { points: Number(canvas.dataset.points), arrows: Number(canvas.dataset.arrows), inked,
          still: getComputedStyle(document.querySelector(".still")).display, images: document.images.length };
        """
    )
    assert tab.problems == [] and tab.requests == [(tmp_path / "report.html").resolve().as_uri()]
    assert seen["points"] == int(problem.data.seen.sum()) and seen["arrows"] >= estimate.points.used
    assert seen["inked"] > 2000 and seen["still"] == "none" and seen["images"] == 1


def test_a_page_that_breaks_is_noticed(chromium: Browser, page: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.html"
    text = page.read_text(encoding="utf-8").replace("function draw(", "function drawn(", 1)
    broken.write_text(text.replace("<body>", "<body><img src='https://example.com/a.png'>"), encoding="utf-8")
    problems = " ".join(chromium.open(broken).problems)
    assert "draw is not defined" in problems and "Content Security Policy" in problems


def test_the_numbers_on_the_screen_are_those_of_the_json(chromium: Browser, page: Path, case: Case) -> None:
    seen = chromium.open(page).run(
        """
        const json = JSON.parse(document.getElementById("report-data").textContent);
        const shown = Array.from(document.querySelectorAll("data[data-key]"));
        const held = (key) => key.split(".").reduce((at, part) => at[part], json);
        return { count: shown.length, mean: json.estimate.residual_after.mean,
          wrong: shown.filter((d) => Number(d.value) !== held(d.dataset.key)).map((d) => d.dataset.key) };
        """
    )
    assert seen["count"] > 80 and seen["wrong"] == [] and seen["mean"] == case[1].residuals.after.mean


def test_mouse_and_keys_turn_zoom_and_reset(chromium: Browser, page: Path) -> None:
    tab = chromium.open(page)
    x, y = place(tab)
    first = picture(tab)
    tab.run(
        'window.taken = []; addEventListener("wheel", (e) => taken.push(e.defaultPrevented), { passive: false });'
    )
    tab.mouse("mouseWheel", x, y, deltaX=0, deltaY=1)
    assert picture(tab) == first  # not chosen yet: the wheel is the page's
    x, y = place(tab)
    tab.drag((x, y), (x + 60, y + 10), (x + 90, y + 30))
    turned = picture(tab)
    tab.mouse("mouseMoved", x - 50, y)
    assert turned != first and picture(tab) == turned  # released
    tab.mouse("mouseWheel", x, y, deltaX=0, deltaY=-120)
    zoomed = picture(tab)
    assert zoomed != turned and tab.run("return taken;") == [False, True]
    pictures = {zoomed}
    for name in ("ArrowLeft", "ArrowUp", "+", "PageDown"):
        tab.key(name)
        assert picture(tab) not in pictures, name
        pictures.add(picture(tab))
    tab.key("PageUp")
    tab.run('document.querySelector("[data-view=top]").click();')
    assert picture(tab) not in pictures
    tab.key("0")
    home = tab.run("return { yaw: calibrationView.state.yaw, zoom: calibrationView.state.zoom };")
    assert home == tab.run("return { yaw: calibrationView.HOME.yaw, zoom: 1 };") and tab.problems == []


def test_a_double_click_resets(chromium: Browser, page: Path) -> None:
    tab = chromium.open(page)
    x, y = place(tab, 0.02, 0.05)
    tab.drag((x, y))  # nothing there: no point is chosen any more
    first = picture(tab)
    tab.drag((x, y), (x + 200, y + 60))
    assert picture(tab) != first
    for count in (1, 2):
        tab.mouse("mousePressed", x, y, button="left", clickCount=count)
        tab.mouse("mouseReleased", x, y, button="left", clickCount=count)
    assert picture(tab) == first and tab.problems == []


def test_two_fingers_zoom(chromium: Browser, page: Path) -> None:
    tab = chromium.open(page, 360, 740)
    x, y = place(tab)
    tab.touch("touchStart", (x - 30, y), (x + 30, y))
    tab.touch("touchMove", (x - 60, y), (x + 60, y))
    tab.touch("touchEnd")
    assert tab.run("return calibrationView.state.zoom;") == pytest.approx(2.0, rel=0.05)
    tab.touch("touchStart", (x, y))
    tab.touch("touchMove", (x + 40, y))
    tab.touch("touchMove", (x + 80, y))
    tab.touch("touchEnd")
    assert tab.run("return calibrationView.state.yaw < calibrationView.HOME.yaw - 0.3;") and tab.problems == []


def test_sliders_choose_robot_and_magnification(chromium: Browser, page: Path, case: Case) -> None:
    tab = chromium.open(page)
    slide = 'const s = document.getElementById("{}"); s.value = {}; s.dispatchEvent(new Event("input"));'
    words = (
        'return ["row", "factor", "readout", "scale"].map((n) => document.getElementById(n + "-3d").textContent);'
    )
    first = picture(tab)
    tab.run(slide.format("robot-3d", 3))
    moved = picture(tab)
    row, _, readout, _ = tab.run(words)
    angle = f"{np.degrees(case[0].data.q[3, 0]):.2f}°".replace("-", "−")
    assert moved != first and row == "row 3" and angle in readout and "rejected" in readout
    tab.run(slide.format("magnify-3d", 2))
    assert picture(tab) != moved and tab.run(words)[1] == "5"
    tab.run(slide.format("robot-3d", 10))
    length = 1e3 * np.linalg.norm(case[1].residuals.vectors[10, 0])
    readout = tab.run(words)[2]
    assert f"{length:.4f} mm after" in readout and "rejected" not in readout
    tab.run('document.querySelector("[name=when-3d][value=before]").click();')
    _, factor, _, scale = tab.run(words)
    assert scale.startswith("Error before") and "rejected ×" in scale and factor != "5" and tab.problems == []


def test_a_click_on_a_point_chooses_it(chromium: Browser, page: Path) -> None:
    tab = chromium.open(page)
    place(tab)
    for i in (5, 20, 41):
        at = tab.run(
            HELP + f"const at = calibrationView.camera(box.width, box.height)(calibrationView.scene.points[{i}]);"
            "return [box.x + at.x, box.y + at.y];"
        )
        tab.drag(tuple(at))
        chosen = tab.run(
            HELP + "const { state, scene, camera } = calibrationView, at = camera(box.width, box.height)"
            "(scene.points[state.point]); return [box.x + at.x, box.y + at.y, scene.rows[state.point],"
            'document.getElementById("row-3d").textContent];'
        )
        assert chosen[:2] == pytest.approx(at, abs=1.0) and chosen[3] == f"row {chosen[2]}"


def test_the_projection_keeps_right_angles_and_depth(chromium: Browser, page: Path) -> None:
    front, top = chromium.open(page).run(
        """
        const { state, camera } = calibrationView;
        const see = (yaw, pitch) => (p) => {
          Object.assign(state, { yaw, pitch, zoom: 1 });
          return camera(800, 500)(p);
        };
        const corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]];
        return [corners.map(see(0, 0)), corners.map(see(-Math.PI / 2, Math.PI / 2))];
        """
    )
    zero, x, y, z = front  # from the tip of the x axis: y to the right, z up, x towards the eye
    assert y["x"] > zero["x"] and abs(y["y"] - zero["y"]) < 1e-6
    assert z["y"] < zero["y"] and abs(z["x"] - zero["x"]) < 1e-6
    assert x["depth"] < zero["depth"] and x["scale"] > zero["scale"]
    zero, x, y, z = top  # from above: x to the right, y up the screen, z towards the eye
    assert x["x"] > zero["x"] and y["y"] < zero["y"] and abs(x["y"] - zero["y"]) < 1e-6
    assert z["depth"] < zero["depth"]


def test_the_parameter_table_sorts_by_exact_values(chromium: Browser, page: Path, case: Case) -> None:
    tab = chromium.open(page)
    table = 'const t = document.getElementById("parameter-table"), head = t.tHead.rows[0].cells;'
    names = "return Array.from(t.tBodies[0].rows, (row) => row.cells[0].textContent);"
    estimate = case[1]
    known = [(s, n) for s, n in zip(estimate.fit.std, estimate.fit.parameters, strict=True) if np.isfinite(s)]
    ascending = [n for _, n in sorted(known)]
    assert tab.run(table + names) == list(estimate.fit.parameters)
    assert tab.run(table + "head[5].click();" + names)[: len(known)] == ascending
    assert tab.run(table + 'return head[5].getAttribute("aria-sort");') == "ascending"
    tab.run(table + "head[5].focus();")
    tab.key("Enter")
    assert [n for n in tab.run(table + names) if n in ascending] == ascending[::-1]
    assert tab.run(table + "head[0].click();" + names) == list(estimate.fit.parameters)


@pytest.mark.parametrize("width", repeats([360, 1280], [360, 768, 1280]))
@pytest.mark.parametrize("name", ["outliers", "hostile"])
def test_no_width_needs_horizontal_scrolling(chromium: Browser, tmp_path: Path, name: str, width: int) -> None:
    write_report(tmp_path / "report.html", *ALL[name]())
    seen: dict[str, Any] = chromium.open(tmp_path / "report.html", width, 800).run(
        """
        const texts = Array.from(document.querySelectorAll(".two .chart text, .three .chart text"));
        const size = (t) => parseFloat(getComputedStyle(t).fontSize) * t.ownerSVGElement.getScreenCTM().a;
        const wide = document.scrollingElement.scrollWidth;
        return { inner: innerWidth, wide, font: Math.min(...texts.map(size)) };
        """
    )
    assert seen["inner"] == width and seen["wide"] <= width
    assert seen["font"] > 9.0  # charts can be read, on a phone too


def test_paper_gets_a_picture_of_the_view(chromium: Browser, page: Path) -> None:
    tab = chromium.open(page)
    image = 'const image = document.getElementById("snapshot-3d"); await image.decode();'
    assert tab.run(image + "return [image.naturalWidth, image.naturalHeight];") == [1800, 1040]
    first = tab.run(image + "return image.src;")
    tab.run('document.querySelector("[data-view=top]").click(); dispatchEvent(new Event("beforeprint"));')
    assert first.startswith("data:image/png") and tab.run(image + "return image.src;") != first
    paper = tab.paper()
    assert len(re.findall(rb"/Type /Page\b", paper)) in range(4, 9) and b"/Subtype /Image" in paper


def test_without_javascript_there_is_a_drawing(chromium: Browser, page: Path) -> None:
    tab = chromium.open(page, javascript=False)
    seen = tab.run(
        """
        const shown = (id) => getComputedStyle(document.querySelector(id)).display !== "none";
        return { still: shown(".still"), canvas: shown("#canvas-3d"), controls: shown("#controls-3d"),
          note: document.querySelector(".view noscript").textContent };
        """
    )
    assert seen["still"] and not seen["canvas"] and not seen["controls"] and "JavaScript" in seen["note"]


def test_three_thousand_points_are_drawn(chromium: Browser, tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", *kuka(3000, error_model=ErrorModel.paper()))
    tab = chromium.open(tmp_path / "report.html")
    assert tab.run(HELP + "return [canvas.dataset.points, canvas.dataset.arrows];") == ["3000", "400"]
    assert tab.problems == []
