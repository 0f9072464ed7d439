# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Node ``calibration_page``: a web page to watch and steer a campaign, for any browser, also a phone's.

What the other nodes publish becomes a ``PageState`` (``ros/page_state.py``), which the web server shows
(``ros/page_server.py``). What is pressed becomes a call of their services, and the answer is shown. The server
has a thread of its own: the node hands it the newest state and goes on, whatever the browsers do.

The node takes no part in the campaign: it may be started and ended at any time, and several may run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import CalibrationEstimate, CampaignStatus, Measurement, Residuals
from calib_planner_msgs.srv import SkipConfiguration
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from calib_planner.errors import InputError, UnknownNameError
from calib_planner.io import shipped_robots, user_path
from calib_planner.ros import page_state
from calib_planner.ros.lifecycle import OK, Finding, ManagedNode, reason_of
from calib_planner.ros.model import DEFAULT_LEVEL, Model, ModelSource, load_shipped
from calib_planner.ros.page_server import REPORT, Access, Answer, PageServer
from calib_planner.ros.page_state import BUTTONS, PageState
from calib_planner.ros.parameters import EVENTS, HISTORY, LATCHED, NEWEST_IN
from calib_planner.ros.rclpy_ext.polling import Stream, StreamPoller
from calib_planner.ros.rclpy_ext.run import run
from calib_planner.ros.settings import PageParameters
from calib_planner.units import counted, cut

LOOK = 0.5
"""Time between two looks at who is there [s]."""
DRAWN = 0.1
"""Time between two drawings of the robot as it moves [s]."""
STILL = 1e-4
"""Joints that change by less are not drawn anew [rad | m]."""
SILENT = 3.0
"""An executor that says nothing for so long executes nothing [s]; it speaks several times a second."""
PATIENCE, LONG_PATIENCE = 10.0, 120.0
"""Longest wait for an answer [s]; the other one for what settles an estimate and writes files."""
SLOW = ("save", "report")


@dataclass(frozen=True, eq=False)
class Pending:
    """A call that is under way: whose answer it is, and how long it is waited for."""

    name: str
    label: str
    answer: Future[Answer]
    call: Any
    client: Any
    until: float


class PageNode(ManagedNode[PageParameters]):
    """The page as a node.

    Attributes:
        url: Where the page is, with its token.
    """

    THREADS = 1

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        self.url = ""
        super().__init__("calibration_page", PageParameters(), context, overrides)

    def configure(self) -> None:
        """Serve the page, listen to the others."""
        chosen = self.settings.value
        names = {part: getattr(chosen, part) for part in ("campaign", "identifier", "executor")}
        self._state = PageState(names=names, namespace=self.get_namespace())
        self._pressed: SimpleQueue[tuple[str, Mapping[str, Any], Future[Answer]]] = SimpleQueue()
        self._calls: list[Pending] = []
        self._joints: dict[str, float] = {}
        self._heard = 0.0
        self._source = ModelSource(chosen)
        if isinstance(self._source.model, Model):
            self._state = replace(self._state, robot=self._source.model.robot)
        self._callers = {name: self._client_of(name) for name in BUTTONS}
        self._listen(chosen)
        self._serve(chosen)
        self.create_steady_timer(LOOK, self._look)

    def _client_of(self, name: str) -> Any:
        button = BUTTONS[name]
        kind = SkipConfiguration if name == "skip_configuration" else Trigger
        return self.create_client(kind, f"{self._state.names[button.part]}/{button.service}")

    def _listen(self, chosen: PageParameters) -> None:
        def follow(kind: Any, topic: str, take: Any, qos: Any) -> None:
            self.create_subscription(kind, topic, partial(self._on, topic, take), qos)

        follow(CampaignStatus, f"{chosen.campaign}/status", page_state.on_status, LATCHED)
        follow(CalibrationEstimate, f"{chosen.identifier}/estimate", page_state.on_estimate, LATCHED)
        follow(Residuals, f"{chosen.identifier}/residuals", page_state.on_residuals, LATCHED)
        follow(Measurement, f"{chosen.identifier}/measurements", page_state.on_measurement, HISTORY)
        follow(DiagnosticArray, "/diagnostics", page_state.on_diagnostics, EVENTS)
        feedback = f"{chosen.executor}/execute_plan/_action/feedback"
        self.create_subscription(ExecutePlan.Impl.FeedbackMessage, feedback, self._on_feedback, EVENTS)
        self._source.follow(self, lambda model: self._set(replace(self._state, robot=model.robot)))
        streams = [Stream(JointState, topic, self._on_joints, lambda _: None) for topic in chosen.joint_topics]
        StreamPoller(self, streams, NEWEST_IN, DRAWN)

    def _serve(self, chosen: PageParameters) -> None:
        folder = user_path(chosen.report_folder) if chosen.report_folder else None
        wake = self.create_guard_condition(self._safe(self._take_pressed))
        self.undo_with(self.destroy_guard_condition, wake)
        self._wake = wake
        server = PageServer(
            page_state.page_text(),
            Access.of(chosen.host, chosen.token),
            page_state.changed,
            self._press,
            folder,
            self.get_logger().warning,
        )
        self.url = server.start(chosen.host, chosen.port)
        self.undo_with(server.close)
        self._server, self._folder = server, folder
        server.show(self._state)
        self.get_logger().info(f"the page is at {self.url}")

    def findings(self) -> Sequence[Finding]:
        """Where the page is, without its token, and how many look at it."""
        chosen = self.settings.value
        words = f"served at {chosen.host}, {counted(self._server.clients, 'browser')} connected"
        return (Finding("page", OK, words),)

    @property
    def robot_name(self) -> str:
        """The robot that is drawn."""
        return "" if self._state.robot is None else self._state.robot.name

    def deactivate(self) -> None:
        """Answer what is pressed with a refusal from now on; the page stays."""
        for pending in self._calls:
            self._answer(pending, Answer(False, "the page's node was deactivated before the answer came"))
        self._calls = []

    # ── what is heard ────────────────────────────────────────────────────────────────────────────────

    def _set(self, state: PageState) -> None:
        if state is not self._state:
            self._state = state
            self._server.show(state)

    def _on(self, topic: str, take: Any, message: Any) -> None:
        try:
            self._set(take(self._state, message))
        except InputError as error:
            self.get_logger().warning(f"{topic} not shown: {cut(error, 500)}", throttle_duration_sec=5.0)
            return
        if take is page_state.on_status:
            self._know_robot(message.robot)

    def _know_robot(self, name: str) -> None:
        """Draw the campaign's robot, if it is a shipped one and no other is told."""
        robot = self._state.robot
        told = isinstance(self._source.model, Model) or (robot is not None and robot.name == name)
        if not told and name in shipped_robots():
            self._set(replace(self._state, robot=load_shipped(name, DEFAULT_LEVEL)))

    def _on_feedback(self, message: Any) -> None:
        self._heard = time.monotonic()
        self._set(page_state.on_feedback(self._state, message.feedback))

    def _on_joints(self, message: JointState) -> None:
        robot = self._state.robot
        if robot is None:
            return
        pairs = zip(message.name, message.position, strict=False)
        self._joints.update((n, p) for n, p in pairs if n in robot.joint_names and math.isfinite(p))
        if not all(n in self._joints for n in robot.joint_names):
            return
        now, before = tuple(self._joints[n] for n in robot.joint_names), self._state.joints
        if len(before) != len(now) or max(abs(a - b) for a, b in zip(now, before, strict=True)) > STILL:
            self._set(replace(self._state, joints=now))

    def _look(self) -> None:
        """See who is there, and who has not answered."""
        ready = (name for name, client in self._callers.items() if client.service_is_ready())
        offered = {page_state.service_name(self._state, name) for name in ready}
        if self.count_publishers(f"{self._state.names['campaign']}/status"):
            offered.add(self._state.names["campaign"])
        state = self._state
        if offered != state.there:
            state = replace(state, there=frozenset(offered))
        if time.monotonic() - self._heard > SILENT:
            state = page_state.on_feedback(state, None)
        self._set(state)
        for pending in [a for a in self._calls if time.monotonic() > a.until]:
            pending.client.remove_pending_request(pending.call)
            text = "no answer came, and nobody knows whether it was done: see what is shown, then try again"
            self._answer(pending, Answer(False, text))

    # ── what is pressed ──────────────────────────────────────────────────────────────────────────────

    def _press(self, name: str, values: Mapping[str, Any]) -> Future[Answer]:
        """Called by the server, in its thread: the node's own thread takes it from here.

        Raises:
            UnknownNameError: No such button.
            InputError: The number or the choice of ``skip_configuration`` is none.
        """
        if name not in BUTTONS:
            raise UnknownNameError("button", name, sorted(BUTTONS))
        if name == "skip_configuration":
            number = values.get("number")
            if type(number) is not int or not 0 <= number < 2**32:
                raise InputError("number", number, "the number of a configuration")
            if type(values.get("replace")) is not bool:
                raise InputError("replace", values.get("replace"), "true or false")
        answer: Future[Answer] = Future()
        self._pressed.put((name, values, answer))
        self._wake.trigger()
        return answer

    def _take_pressed(self) -> None:
        while True:
            try:
                name, values, answer = self._pressed.get_nowait()
            except Empty:
                return
            try:
                self._ask(name, values, answer)
            except Exception as error:
                _tell(answer, Answer(False, reason_of(error)))
                raise

    def _ask(self, name: str, values: Mapping[str, Any], answer: Future[Answer]) -> None:
        """Call the service of a button."""
        state, client = self._state, self._callers[name]
        if name == "stop" and not client.service_is_ready():
            client = self._callers["pause"]
        reason = "" if self.is_active else f"the page's node is {self.state}: activate it"
        if not client.service_is_ready():
            reason = reason or f"{client.srv_name} is not there: use the robot's own controls"
        elif name in state.waiting and name != "stop":
            reason = reason or "the answer of before has not come yet"
        if reason:
            _tell(answer, Answer(False, reason))
            return
        request = Trigger.Request()
        if name == "skip_configuration":
            request = SkipConfiguration.Request(configuration_index=values["number"], replace=values["replace"])
        patience = LONG_PATIENCE if name in SLOW else PATIENCE
        label = "Replace" if values.get("replace") is True else BUTTONS[name].label
        pending = Pending(name, label, answer, client.call_async(request), client, time.monotonic() + patience)
        self._calls.append(pending)
        self._set(replace(state, waiting=state.waiting | {name}))
        pending.call.add_done_callback(lambda _: self._answered(pending))

    def _answered(self, pending: Pending) -> None:
        if pending.answer.done():
            return
        error = pending.call.exception()
        response = pending.call.result() if error is None else None
        if response is None:
            self._answer(pending, Answer(False, f"no answer: {error}"))
            return
        done = response.success if hasattr(response, "success") else response.status == response.SUCCESS
        self._answer(pending, Answer(bool(done), cut(response.message, 500)))

    def _answer(self, pending: Pending, answer: Answer) -> None:
        """Tell who pressed, and everybody's log."""
        if pending in self._calls:
            self._calls.remove(pending)
        state = replace(self._state, waiting=frozenset(a.name for a in self._calls))
        text = f"{pending.label}: {answer.text}"
        if pending.name == "report" and answer.done:
            state = replace(state, report=self._report_of(answer.text))
        self._set(page_state.told(state, "good" if answer.done else "bad", text, time.time()))
        _tell(pending.answer, answer)

    def _report_of(self, text: str) -> str:
        """The name of the report that an answer names, if the page may show it; else empty."""
        name = Path(text.rpartition(" ")[2]).name
        shown = self._folder is not None and REPORT.fullmatch(name) and (self._folder / name).is_file()
        return name if shown else ""


def _tell(waiting: Future[Answer], answer: Answer) -> None:
    """Answer who waits, unless the browser has gone meanwhile."""
    with suppress(InvalidStateError):
        waiting.set_result(answer)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(PageNode, PageNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
