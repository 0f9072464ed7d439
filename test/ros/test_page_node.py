# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The page's node: what others publish is shown, what is pressed is called; a real browser looks and clicks."""

from __future__ import annotations

import json
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import CalibrationEstimate, CampaignStatus, Measurement, Residuals
from calib_planner_msgs.srv import SkipConfiguration
from diagnostic_msgs.msg import DiagnosticArray
from page_cases import COUNT, NAMES, Script
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

pytest.importorskip("aiohttp", reason="the page needs aiohttp (extra page)")
sys.path.insert(0, str(Path(__file__).parents[1] / "report"))
from browser import Browser, Tab, browser
from desk import ASKED, IDENTIFIER, SIMULATOR

from calib_planner.ros.nodes.campaign import CampaignNode
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.nodes.page import PageNode
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.parameters import EVENTS, HISTORY, LATCHED, SENSOR_OUT

S = CampaignStatus


class Others(Node):
    """Campaign, identifier and executor, as far as the page sees them: they say what they are told to say."""

    def __init__(self, **options: Any) -> None:
        super().__init__("others", context=options["context"])
        self.calls: list[str] = []
        self.refuse = ""
        self.silent = threading.Event()
        campaign, identifier, executor = NAMES["campaign"], NAMES["identifier"], NAMES["executor"]
        self.status = self.create_publisher(S, f"{campaign}/status", LATCHED)
        self.estimate = self.create_publisher(CalibrationEstimate, f"{identifier}/estimate", LATCHED)
        self.residuals = self.create_publisher(Residuals, f"{identifier}/residuals", LATCHED)
        self.measurements = self.create_publisher(Measurement, f"{identifier}/measurements", HISTORY)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", EVENTS)
        self.joints = self.create_publisher(JointState, "joint_states", SENSOR_OUT)
        kind = ExecutePlan.Impl.FeedbackMessage
        self.feedback = self.create_publisher(kind, f"{executor}/execute_plan/_action/feedback", EVENTS)
        for name in ("start", "pause", "resume", "skip"):
            self._offer(Trigger, f"{campaign}/{name}")
        for name in ("undo", "save", "report"):
            self._offer(Trigger, f"{identifier}/{name}")
        for name in ("stop", "confirm"):
            self._offer(Trigger, f"{executor}/{name}")
        self._offer(SkipConfiguration, f"{campaign}/skip_configuration")

    def _offer(self, kind: Any, name: str) -> None:
        def answer(request: Any, response: Any) -> Any:
            values = "" if kind is Trigger else f" {request.configuration_index} {request.replace}"
            self.calls.append(name + values)
            response.message = self.refuse or f"{name.rpartition('/')[2]} is done"
            if kind is Trigger:
                response.success = not self.refuse
            else:
                response.status = response.UNKNOWN_INDEX if self.refuse else response.SUCCESS
            return response

        self.create_service(kind, name, answer)


def request(url: str, data: Any = None, **headers: str) -> tuple[int, str]:
    """Status and text of an answer; ``data`` is sent as JSON by the page itself."""
    origin = url.rstrip("/").split("/do/")[0].split("/report/")[0]
    usual = {} if data is None else {"Content-Type": "application/json", "Origin": origin}
    body = None if data is None else json.dumps(data).encode()
    sent = urllib.request.Request(url, body, usual | headers)
    try:
        with urllib.request.urlopen(sent, timeout=30) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


@pytest.fixture
def script() -> Script:
    return Script()


@pytest.fixture
def others(bench: Bench) -> Others:
    return bench.start(Others)


@pytest.fixture
def page(bench: Bench, others: Others) -> PageNode:
    node = bench.start(PageNode, port=0)
    bench.wait(lambda: len(node._state.there) == 11)
    return node


def press(page: PageNode, name: str, **values: Any) -> tuple[bool, str]:
    code, text = request(f"{page.url}do/{name}", values)
    answer = json.loads(text)
    assert code == 200, text
    return answer["done"], answer["text"]


def test_what_is_pressed_is_called_and_answered(bench: Bench, others: Others, page: PageNode) -> None:
    for name in ("start", "pause", "resume", "skip", "undo", "save", "report", "confirm", "stop"):
        done, text = press(page, name)
        assert done and text == f"{name} is done" and others.calls[-1].endswith(f"/{name}")
    assert press(page, "skip_configuration", number=7, replace=True)[0]
    assert others.calls[-1].endswith("skip_configuration 7 True")
    others.refuse = "no campaign under way: call ~/start"
    assert press(page, "pause") == (False, others.refuse)
    assert press(page, "skip_configuration", number=1, replace=False) == (False, others.refuse)
    lines = page._state.journal
    assert lines[0].text == "Start: start is done" and lines[-1].kind == "bad" and len(lines) == 12


@pytest.mark.parametrize(
    ("name", "values"),
    [("apply", {}), ("skip_configuration", {}), ("skip_configuration", {"number": -1, "replace": True}),
     ("skip_configuration", {"number": True, "replace": True}),
     ("skip_configuration", {"number": 3, "replace": 1})],
)  # fmt: skip
def test_what_no_button_sends_is_refused(page: PageNode, others: Others, name: str, values: Any) -> None:
    code, text = request(f"{page.url}do/{name}", values)
    assert code == 400 and not json.loads(text)["done"] and not others.calls


def test_without_the_others_every_button_says_so(bench: Bench) -> None:
    page = bench.start(PageNode, port=0, robot="planar_2r")
    done, text = press(page, "stop")
    assert not done and "pause is not there" in text and "robot's own controls" in text
    assert not press(page, "start")[0]


def test_a_node_that_is_not_active_presses_nothing(bench: Bench, others: Others, page: PageNode) -> None:
    page.trigger_deactivate()
    done, text = press(page, "start")
    assert not done and "activate it" in text and not others.calls


def test_an_address_in_use_or_a_weak_token_is_refused(bench: Bench, page: PageNode) -> None:
    again = bench.start(PageNode, port=int(page.url.rstrip("/").rpartition(":")[2]))
    assert again.state == "unconfigured" and "choose another port" in again.failure
    weak = bench.start(PageNode, port=0, host="0.0.0.0", token="secret")
    assert "at least 16" in weak.failure and "secret" not in weak.failure


def test_beyond_this_machine_a_token_is_made(bench: Bench) -> None:
    page = bench.start(PageNode, port=0, host="0.0.0.0")
    address, _, token = page.url.partition("?token=")
    here = f"http://127.0.0.1:{address.rstrip('/').rpartition(':')[2]}/"
    assert len(token) >= 32
    assert request(here)[0] == 403 and request(f"{here}do/start", {})[0] == 403
    assert request(f"{here}?token={token[:-1]}")[0] == 403
    assert request(here, Cookie=f"calib_page_{here.rpartition(':')[2].rstrip('/')}={token}")[0] == 200


def test_reports_of_the_folder_are_shown_in_a_sandbox(bench: Bench, others: Others, tmp_path: Path) -> None:
    (tmp_path / "report_a-fit.html").write_text("<h1>report</h1>")
    (tmp_path / "secret.html").write_text("secret")
    (tmp_path / "report_link.html").symlink_to(tmp_path / "secret.html")
    page = bench.start(PageNode, port=0, report_folder=str(tmp_path))
    assert request(f"{page.url}report/report_a-fit.html") == (200, "<h1>report</h1>")
    for name in (
        "secret.html",
        "report_link.html",
        "report_b.html",
        "..%2fsecret.html",
        "%2e%2e/secret.html",
        "",
    ):
        assert request(f"{page.url}report/{name}")[0] == 404, name
    bench.wait(lambda: len(page._state.there) == 11)
    others.refuse = ""
    page._report_of(f"report written to {tmp_path}/report_a-fit.html")
    assert page._report_of(f"report written to {tmp_path}/report_a-fit.html") == "report_a-fit.html"
    assert not page._report_of("report written to /elsewhere/report_c.html")


def test_a_page_that_comes_late_knows_what_was_measured(bench: Bench, others: Others, script: Script) -> None:
    for i in range(5):
        others.measurements.publish(script.measurement(i))
    others.measurements.publish(script.measurement(5, campaign_id="another"))
    others.status.publish(script.status(S.MEASURING, 5))
    page = bench.start(PageNode, port=0)
    bench.wait(lambda: len(page._state.visits) == 5 and page._state.campaign is not None)
    bench.wait(lambda: page._state.robot is not None and page._state.robot.name == script.robot.name)


# ── with a browser ───────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as running:
        yield running


def until(bench: Bench, tab: Tab, expression: str, what: Callable[[Any], bool] = bool) -> Any:
    """Until an expression of the page has a value that is wanted; the value."""
    values: list[Any] = []

    def there() -> bool:
        time.sleep(0.05)  # between two looks: each costs the browser, too
        values.append(tab.run(f"return {expression};"))
        return what(values[-1])

    bench.wait(there)
    return values[-1]


def text(name: str) -> str:
    return f"document.getElementById({name!r}).textContent"


def click(tab: Tab, selector: str) -> None:
    tab.run(f"document.querySelector({selector!r}).click();")


def test_a_campaign_by_clicks_alone(
    bench: Bench, others: Others, page: PageNode, script: Script, chromium: Browser
) -> None:
    """Before the start, the plan, measuring, confirming, and the verdict; nothing comes from elsewhere."""
    others.status.publish(S(state=S.IDLE, reason="call ~/start"))
    tab = chromium.open(page.url, 1280, 900)
    assert until(bench, tab, text("badge"), lambda t: t == "ready")
    assert until(bench, tab, text("reason")) == "Press Start"
    assert tab.run("return document.querySelector('[data-do=pause]').getAttribute('aria-disabled');") == "true"
    click(tab, "[data-do=pause]")
    assert tab.run(f"return {text('answer')};") == "Pause: Nothing is under way." and not others.calls
    click(tab, "[data-do=start]")
    assert "way free" in tab.run(f"return {text('sure-text')};") and not others.calls
    click(tab, "#sure-yes")
    until(bench, tab, text("answer"), lambda t: t == "Start: start is done")

    others.status.publish(script.status(S.PAUSED, 0))
    until(bench, tab, text("badge"), lambda t: t == "review")
    until(bench, tab, "document.querySelectorAll('#ahead li[data-key]').length", lambda n: n == COUNT)
    click(tab, "#ahead li:nth-child(3)")
    assert f"Configuration 2, ahead: {script.robot.joint_names[0]}" in tab.run(f"return {text('readout-3d')};")
    click(tab, "#ahead li:nth-child(3) .act:nth-child(2)")
    bench.wait(lambda: others.calls[-1].endswith("skip_configuration 2 True"))
    click(tab, "[data-do=resume]")
    click(tab, "#sure-yes")
    bench.wait(lambda: others.calls[-1].endswith("/resume"))

    others.status.publish(script.status(S.MEASURING, 5))
    for i in range(6):
        others.measurements.publish(script.measurement(i))
    others.estimate.publish(script.estimate(6))
    others.residuals.publish(script.residuals(6))
    others.diagnostics.publish(script.diagnostics())
    others.joints.publish(JointState(name=list(script.robot.joint_names), position=script.q[5].tolist()))
    until(bench, tab, text("title"), lambda t: t == "The robot moves to configuration 5.")
    assert "Configuration 5, now:" in until(bench, tab, text("readout-3d"))
    click(tab, "#ahead li:nth-child(4)")
    others.status.publish(script.status(S.MEASURING, 6))
    until(bench, tab, text("title"), lambda t: t == "The robot moves to configuration 6.")
    assert "Configuration 8, ahead:" in tab.run(f"return {text('readout-3d')};")
    until(bench, tab, "document.getElementById('canvas-3d').dataset.points", lambda n: n == "6")
    until(bench, tab, "document.querySelectorAll('#residuals circle').length", lambda n: n == 5)
    assert "stands still" in until(bench, tab, text("stream-list"))
    assert tab.run("return document.querySelectorAll('#posture svg.posture').length;") == 1
    click(tab, "[data-do=skip]")
    bench.wait(lambda: others.calls[-1].endswith("/skip"))

    message = ExecutePlan.Impl.FeedbackMessage()
    message.feedback.phase = message.feedback.CONFIRMING
    others.feedback.publish(message)
    until(bench, tab, text("badge"), lambda t: t == "confirm")
    click(tab, "[data-do=confirm]")
    bench.wait(lambda: others.calls[-1].endswith("/confirm"))
    click(tab, "#stop")
    bench.wait(lambda: others.calls[-1].endswith("plan_executor/stop"))

    others.status.publish(
        script.status(S.DONE, COUNT, outcome=S.OUTCOME_REACHED, verdict=script.estimate(16).verdict)
    )
    until(bench, tab, text("level"), lambda t: t == "PASS")
    assert "required accuracy is reached" in tab.run(f"return {text('title')};")
    assert tab.problems == []
    own = page.url.rstrip("/")
    assert {u.rpartition(":")[2].partition("/")[0] for u in tab.requests} == {own.rpartition(":")[2]}


def test_a_campaign_of_the_real_nodes_by_clicks_alone(bench: Bench, chromium: Browser, tmp_path: Path) -> None:
    """Start, look at the plan, leave one out, resume, pause, resume; then the verdict and the report."""
    bench.start(SimulatorNode, **(SIMULATOR | {"dwell": 0.6}))  # there is time for clicks while it measures
    bench.start(IdentifierNode, **IDENTIFIER, keep_measurements=True, save_folder=str(tmp_path))
    bench.start(CampaignNode, **(ASKED | {"review": True}))
    page = bench.start(PageNode, port=0, executor="tracker_simulator", report_folder=str(tmp_path))
    tab = chromium.open(page.url, 360, 740)

    def press_in_page(name: str) -> str:
        """Press a button as soon as it can be; the answer."""
        until(
            bench,
            tab,
            f"document.querySelector('[data-do={name}]').getAttribute('aria-disabled')",
            "false".__eq__,
        )
        label = tab.run(f"return document.querySelector('[data-do={name}] b').textContent;")
        click(tab, f"[data-do={name}]")
        if tab.run("return document.getElementById('sure').open;"):
            click(tab, "#sure-yes")
        return str(until(bench, tab, text("answer"), lambda t: t.startswith(f"{label}: ")))

    assert "begun" in press_in_page("start")
    until(bench, tab, text("badge"), "review".__eq__)
    ahead = "[...document.querySelectorAll('#ahead .name')].map((e) => e.textContent)"
    numbers = until(bench, tab, ahead, lambda names: len(names) > 2)
    click(tab, "#ahead li:nth-child(2) .act")
    left = until(bench, tab, ahead, lambda names: numbers[1] not in names)
    assert tab.run(f"return {text('readout-3d')};").startswith(f"Configuration {left[0]}, ahead")
    assert press_in_page("resume").endswith("goes on")
    until(bench, tab, text("badge"), "measuring".__eq__)
    until(bench, tab, "document.querySelectorAll('#residuals circle').length", lambda n: n >= 1)
    assert press_in_page("pause").startswith("Pause: paused")
    until(bench, tab, text("badge"), "paused".__eq__)
    press_in_page("resume")
    until(bench, tab, text("badge"), "done".__eq__)
    assert until(bench, tab, text("level")) in ("PASS", "WARN")
    assert "required accuracy is reached" in tab.run(f"return {text('title')};")
    measured = tab.run("return document.querySelectorAll('#done li[data-key]').length;")
    assert measured == len(page._state.visits) >= 6
    assert "report written" in press_in_page("report")
    link = until(bench, tab, "document.getElementById('report-link').href", lambda href: "/report/" in href)
    assert chromium.open(link).run("return document.title;").startswith("Calibration of planar_2r")
    assert tab.problems == []


def test_texts_from_topics_are_never_markup(
    bench: Bench, others: Others, page: PageNode, script: Script, chromium: Browser
) -> None:
    evil = "<img src=x onerror=alert(1)><script>alert(2)</script>\u202e'\""
    others.status.publish(script.status(S.PAUSED, 3, robot=evil, reason=evil))
    tab = chromium.open(page.url, 360, 740)
    until(bench, tab, text("robot"), lambda t: t == evil)
    assert tab.run("return document.images.length + document.querySelectorAll('script').length;") == 1
    assert tab.run("return document.documentElement.scrollWidth;") <= 360
    assert tab.problems == []


def test_a_page_without_its_node_says_so_and_comes_back(bench: Bench, others: Others, chromium: Browser) -> None:
    first = bench.start(PageNode, port=0, robot="planar_2r")
    port = int(first.url.rstrip("/").rpartition(":")[2])
    tab = chromium.open(first.url)
    until(bench, tab, text("link"), lambda t: t == "live")
    first.trigger_deactivate()
    first.trigger_cleanup()
    assert "STOP neither" in until(bench, tab, text("offline"))
    tab.run("document.getElementById('stop').click();")
    until(bench, tab, text("answer"), lambda t: "nobody knows" in t)
    bench.start(PageNode, port=port, robot="planar_2r")
    until(bench, tab, text("link"), lambda t: t == "live")
