# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Nodes in one process on a simulated clock that waits for them: as fast as they work, and the same every time.

The nodes run as users run them with ``use_sim_time``: their own code, messages, services, actions and DDS between
them. What is replaced is who calls whom when. ``Stage.step`` moves ``/clock`` on by a little, then has everything
done that is to be done at that time: callbacks of what has come, timers that are due, pieces of work that rest
(``ManagedNode.rest``). The time goes on when nothing is left. So that this can be told,

* one thread works at a time: an executor without wait takes what the middleware has, which delivers at once
  within a process; work of an action is a thread of its own, which has the turn until it rests or ends;
* timers of real time (``create_steady_timer``) look at the stage's clock, like all others;
* what a node gives to a thread pool is done at once, in no time.

A stage has a ROS domain of its own, and nothing else may be on it.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import rclpy
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.logging import get_logger_level, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from calib_planner.acquisition import NANO
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.messages import stamp_message
from calib_planner.ros.processes import own_domain

BEGIN = 1_700_000_000 * NANO
"""Where the clock begins [ns]."""
STEP = 0.05
"""Time from one message of the clock to the next [s]: nodes that look at their streams twenty times a second."""
OWN = "describe_parameters get_parameter_types get_parameters list_parameters set_parameters"
LIFECYCLE = "change_state get_available_states get_available_transitions get_state get_transition_graph"
SILENT = {*OWN.split(), *LIFECYCLE.split(), "set_parameters_atomically", "get_type_description"}
"""Services that every node has and nobody calls here: to wait for them would cost more than all the rest."""


class Pool:
    """Stands for a thread pool: what is submitted is done at once."""

    def submit(self, work: Callable[..., Any], *args: Any) -> Future[Any]:
        """The result, or the exception, of ``work(*args)``."""
        result: Future[Any] = Future()
        try:
            result.set_result(work(*args))
        except Exception as error:
            result.set_exception(error)
        return result

    def shutdown(self, **_: Any) -> None:
        """Nothing is under way."""


@dataclass(eq=False)
class Timer:
    """A timer of real time that looks at the stage's clock [ns]."""

    node: object
    due: int
    period: int
    callback: Callable[[], None]


@dataclass(eq=False)
class Resting:
    """A thread that waits: over when its node's ``seconds`` reach ``until``, or ``end`` is set."""

    node: ManagedNode[Any]
    until: float
    end: threading.Event
    turn: threading.Event

    @property
    def over(self) -> bool:
        """Whether it is to go on."""
        return self.end.is_set() or self.node.seconds >= self.until


class Stepped:
    """A node on the stage ``STAGE``: with this before the node's own class, time is the stage's."""

    STAGE: Stage

    def create_timer(self, timer_period_sec: float, callback: Any, *args: Any, **others: Any) -> Any:
        """As the node's, but that real time is the stage's."""
        clock = others.get("clock")
        if clock is None or clock.clock_type != ClockType.STEADY_TIME:
            return super().create_timer(timer_period_sec, callback, *args, **others)  # type: ignore[misc]
        period = round(timer_period_sec * NANO)
        timer = Timer(self, self.STAGE.now + period, max(period, 1), self._safe(callback))  # type: ignore[attr-defined]
        self.STAGE.timers.append(timer)
        return self._destroyed_later(self.destroy_timer, timer)  # type: ignore[attr-defined]

    def destroy_timer(self, timer: Any) -> bool:
        """As the node's."""
        if not isinstance(timer, Timer):
            return bool(super().destroy_timer(timer))  # type: ignore[misc]
        if timer in self.STAGE.timers:
            self.STAGE.timers.remove(timer)
        return True

    def rest(self, seconds: float, end: threading.Event) -> None:
        """Give the turn back until the stage's clock says so."""
        self.STAGE.rest(Resting(self, self.seconds + seconds, end, threading.Event()))  # type: ignore[attr-defined,arg-type]

    def _say(self, error: Exception) -> None:
        """As the node's; the stage notes it."""
        self.STAGE.errors.append("".join(traceback.format_exception(error)))
        super()._say(error)  # type: ignore[misc]

    def activate(self) -> None:
        """As the node's, without threads of its own."""
        super().activate()  # type: ignore[misc]
        if hasattr(self, "_thread"):
            self._thread.shutdown()
            self._thread = Pool()


class Stage:
    """Where the nodes are.

    Attributes:
        now: What the clock says [ns].
        client: A node for whoever looks on.
        nodes: The nodes by their class.
        errors: Exceptions in callbacks, which the nodes log and survive.
    """

    def __init__(self) -> None:
        self._kept = ExitStack()
        self.context, domain = Context(), self._kept.enter_context(own_domain())
        quiet = ["--ros-args", "--log-level", "fatal"]  # of the process: what was before comes back at the end
        self._kept.callback(set_logger_level, "", get_logger_level(""))
        rclpy.init(args=quiet, context=self.context, domain_id=domain)
        self._executor = SingleThreadedExecutor(context=self.context)
        self.now, self.timers, self.nodes = BEGIN, list[Timer](), dict[type, Any]()
        self.errors: list[str] = []
        self._resting: list[Resting] = []
        self._overlooked: dict[Any, tuple[list[Any], list[Any]]] = {}
        self._back = threading.Event()
        self.client = Node("stage", context=self.context, start_parameter_services=False, enable_rosout=False)
        self._clock = self.client.create_publisher(Clock, "/clock", QoSProfile(depth=1))
        self._executor.add_node(self.client)

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, *_: object) -> None:
        for kind in list(self.nodes):
            self.end(kind)
        self._executor.shutdown()
        self._restore(self.client)
        self.client.destroy_node()
        rclpy.shutdown(context=self.context)
        self._kept.close()

    def start(self, kind: type[ManagedNode[Any]], parameters: Mapping[str, Any]) -> Any:
        """The node, active; its parameters beside ``use_sim_time``."""
        given = [Parameter(k, value=v) for k, v in (dict(parameters) | {"use_sim_time": True}).items()]
        stepped = type(kind.__name__, (Stepped, kind), {"STAGE": self})
        node = self.nodes[kind] = stepped(context=self.context, overrides=given)
        self._executor.add_node(node)
        for _ in range(100):
            self.step()
            if node.autostarted:
                break
        assert node.autostarted and not node.failure, node.failure
        self._overlook(node)
        return node

    def _overlook(self, node: Any) -> None:
        """Have the executor not wait for what never comes here; the node keeps it."""
        silent = [s for s in node._services if s.srv_name.rpartition("/")[2] in SILENT]
        events = [w for w in node._Node__waitables if isinstance(w, EventHandler)]
        before = self._overlooked.get(node, ([], []))
        self._overlooked[node] = (before[0] + silent, before[1] + events)
        for one in silent:
            node._services.remove(one)
        for one in events:
            node._Node__waitables.remove(one)

    def end(self, kind: type) -> None:
        """End a node as its process would."""
        node = self.nodes.pop(kind)
        node.close()
        self.settle()
        self._executor.remove_node(node)
        self._restore(node)
        node.destroy_node()
        self.timers = [t for t in self.timers if t.node is not node]

    def _restore(self, node: Any) -> None:
        """Give back what was overlooked, so that it is destroyed with the node."""
        silent, events = self._overlooked.pop(node, ([], []))
        node._services += silent
        node._Node__waitables += events

    def step(self, seconds: float = STEP) -> None:
        """Time goes on, and everything is done that is to be done then."""
        self.now += round(seconds * NANO)
        self._clock.publish(Clock(clock=stamp_message(self.now)))
        self.settle()
        for timer in [t for t in self.timers if t.due <= self.now]:
            if timer in self.timers:
                timer.due += timer.period * ((self.now - timer.due) // timer.period + 1)
                timer.callback()
        self.settle()
        for resting in [r for r in self._resting if r.over]:
            self._turn(resting)
            self.settle()

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Go on until ``condition``; whether it came true within ``seconds``."""
        last = self.now + round(seconds * NANO)
        while not condition():
            if self.now >= last:
                return False
            self.step()
        return True

    def call(self, client: Any, request: Any) -> Any:
        """The answer of a service."""
        self._overlook(self.client)
        self.settle()
        assert client.service_is_ready(), client.srv_name
        future = client.call_async(request)
        assert self.until(future.done, 1.0), f"{client.srv_name} does not answer"
        return future.result()

    def settle(self) -> None:
        """Do what has come, until nothing is left."""
        while self._once():
            pass

    def _once(self) -> bool:
        """Whether there was anything to do."""
        worked = False
        while True:
            try:
                handler, entity, _ = self._executor.wait_for_ready_callbacks(timeout_sec=0)
            except TimeoutException:
                return worked
            if entity is None and not handler.executing():
                self._by_itself(handler)
            else:
                handler()
            worked |= entity is not None or handler.done()
            if handler.done() and handler.exception() is not None:
                raise handler.exception()

    # ── one thread at a time ─────────────────────────────────────────────────────────────────────────

    def _by_itself(self, work: Callable[[], object]) -> None:
        """Have a thread begin ``work``, until it rests or has ended."""

        def whole() -> None:
            try:
                work()
            finally:
                self._back.set()

        self._back.clear()
        threading.Thread(target=whole, daemon=True).start()
        self._back.wait()

    def rest(self, resting: Resting) -> None:
        """Called by such a thread: it rests."""
        self._resting.append(resting)
        self._back.set()
        while not resting.turn.wait(0.2):
            if resting.end.is_set() and resting in self._resting:  # the node ends, and waits for this
                self._resting.remove(resting)
                return

    def _turn(self, resting: Resting) -> None:
        """Have it go on, until it rests again or has ended."""
        self._resting.remove(resting)
        self._back.clear()
        resting.turn.set()
        self._back.wait()
