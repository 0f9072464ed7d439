# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Services and action servers are destroyed while other threads wait for them, take from them, answer by them."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from lifecycle_msgs.msg import Transition
from rclpy.callback_groups import ReentrantCallbackGroup
from std_srvs.srv import Trigger

from calib_planner.ros.lifecycle import LifecycleParameters, ManagedNode

Result = ExecutePlan.Result


class Slow(ManagedNode[LifecycleParameters]):
    """A service and an action that answer when ``go`` is set."""

    THREADS = 4

    def __init__(self, **options: Any) -> None:
        self.go, self.begun = threading.Event(), threading.Semaphore(0)
        super().__init__("slow", LifecycleParameters(), **options)

    def configure(self) -> None:
        group = ReentrantCallbackGroup()
        self.create_service(Trigger, "~/ask", self._ask, callback_group=group)
        self.server = self.create_action_server(ExecutePlan, "~/do", self._do, callback_group=group)

    def _ask(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.begun.release()
        self.go.wait(60.0)
        response.message = "done"
        return response

    def _do(self, goal: Any) -> Result:
        self.begun.release()
        self.go.wait(60.0)
        if goal.is_active:
            goal.succeed()
        return Result(status=Result.ABORTED, message="done")


@pytest.fixture
def hasty() -> Iterator[None]:
    """Threads take turns so often that one interrupts another everywhere."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


def change(bench: Bench, *which: int) -> None:
    for number in which:
        assert bench.change_state("slow", number)


UP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
DOWN = Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP


def test_the_executor_survives_what_goes_while_it_collects(bench: Bench, hasty: None) -> None:
    """Thirty times; without ``lasting`` every second time raised, which ends a process."""
    node = bench.start(Slow, autostart=False)
    node.go.set()
    ended = threading.Event()

    def wake() -> None:
        while not ended.is_set():
            node.executor.wake()
            time.sleep(0.0002)

    waker = threading.Thread(target=wake)
    waker.start()
    try:
        for _ in range(30):
            change(bench, *UP, *DOWN)
    finally:
        ended.set()
        waker.join()
    change(bench, *UP)
    assert bench.call(Trigger, "slow/ask", Trigger.Request()).message == "done"


def test_what_a_service_was_asked_is_answered(bench: Bench) -> None:
    node = bench.start(Slow)
    service = bench.client.create_client(Trigger, "slow/ask")
    bench.wait(service.service_is_ready)
    asked = service.call_async(Trigger.Request())
    assert node.begun.acquire(timeout=60.0)
    change(bench, *DOWN)
    assert not asked.done()
    node.go.set()
    assert bench.future(asked).message == "done"
    begins_anew(bench, node)


def test_a_goal_under_way_gets_its_result(bench: Bench) -> None:
    node = bench.start(Slow)
    action = bench.action(ExecutePlan, "slow/do")
    result = bench.goal(action, ExecutePlan.Goal()).get_result_async()
    assert node.begun.acquire(timeout=60.0)
    # Whoever asks for the result when the server is gone asks nobody.
    bench.wait(lambda: any(f._callbacks for f in node.server._result_futures.values()))
    change(bench, *DOWN)
    assert not result.done()
    node.go.set()
    assert bench.future(result).result.message == "done"
    begins_anew(bench, node)


def begins_anew(bench: Bench, node: Slow) -> None:
    """The old ones have gone, and new ones answer."""
    wanted = {"/slow/ask", "/slow/do/_action/send_goal"}
    bench.wait(lambda: not wanted & {n for n, _ in node.get_service_names_and_types_by_node("slow", "/")})
    change(bench, *UP)
    assert bench.call(Trigger, "slow/ask", Trigger.Request()).message == "done"
