# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What rclpy does by itself, as ``ros/rclpy_ext`` says: where a test fails, its work-around may go."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

import pytest
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from geometry_msgs.msg import PointStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.waitable import NumberOfEntities, Waitable
from std_srvs.srv import Trigger

from calib_planner.ros.messages import point_message
from calib_planner.ros.parameters import EVENTS
from calib_planner.ros.rclpy_ext.lifecycle import TidyLifecycleNode, given_parameters
from calib_planner.ros.rclpy_ext.run import spin_once


def other(bench: Bench, kind: type = Node, **options: Any) -> tuple[Any, SingleThreadedExecutor]:
    """A node of rclpy and an executor that nobody spins."""
    node = kind("other", context=bench.context, **options)
    bench.nodes.append(node)
    executor = SingleThreadedExecutor(context=bench.context)
    executor.add_node(node)
    return node, executor


class Gone(Waitable):  # type: ignore[misc]
    """A waitable that another thread destroyed after the executor had listed it."""

    def __enter__(self) -> None:
        raise InvalidHandle("gone")

    def __exit__(self, *_: object) -> None:
        return

    def get_num_entities(self) -> NumberOfEntities:
        return NumberOfEntities()

    def add_to_wait_set(self, wait_set: Any) -> None:
        raise InvalidHandle("gone, and used all the same")


def test_lasting_the_executor_uses_a_waitable_that_it_could_not_enter(bench: Bench) -> None:
    """Also why ``run.spin_once`` passes ``InvalidHandle`` over: the executor works again afterwards."""
    node, executor = other(bench)
    waitable = Gone(ReentrantCallbackGroup())
    node.add_waitable(waitable)
    with pytest.raises(InvalidHandle, match="used all the same"):
        executor.spin_once(0.0)
    spin_once(executor, 0.0)
    node.remove_waitable(waitable)
    executor.spin_once(0.0)


def test_lasting_an_action_server_does_not_enter_its_handle(bench: Bench) -> None:
    node, _ = other(bench)
    server = ActionServer(node, ExecutePlan, "do", lambda goal: ExecutePlan.Result())
    server._is_goal_request_ready = True
    server.destroy()
    with pytest.raises(Exception, match="pointer is invalid"):
        server.take_data()


def test_lasting_a_service_does_not_stay_for_its_answer(bench: Bench) -> None:
    node, executor = other(bench)

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        node.destroy_service(service)
        return response

    service = node.create_service(Trigger, "ask", answer)
    client = bench.client.create_client(Trigger, "ask")
    bench.wait(client.service_is_ready)
    client.call_async(Trigger.Request())
    with pytest.raises(InvalidHandle):
        bench.wait(lambda: executor.spin_once(0.1))


def test_polling_the_executor_hands_out_in_turns_not_by_the_stamps(bench: Bench) -> None:
    node, executor = other(bench)
    heard: list[int] = []
    for topic in ("a", "b"):
        node.create_subscription(PointStamped, topic, lambda m: heard.append(m.header.stamp.nanosec), EVENTS)
    a, b = (bench.client.create_publisher(PointStamped, topic, EVENTS) for topic in ("a", "b"))
    bench.wait(lambda: a.get_subscription_count() and b.get_subscription_count())
    for stamp in range(20):
        (b if stamp == 10 else a).publish(point_message([1.0, 0, 0], stamp, ""))
    bench.wait(lambda: executor.spin_once(0.1) or len(heard) == 20)
    assert heard != sorted(heard)


SIGNAL = """
import os, signal, threading, time
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
order = []
if {own}:
    rclpy.init(args=[], domain_id={domain}, signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGINT, lambda *_: order.append("handled"))
else:
    rclpy.init(args=[], domain_id={domain})
node, executor = Node("signalled"), SingleThreadedExecutor()
executor.add_node(node)
def end():
    time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.5)
    order.append("woken")
    executor.wake()
threading.Thread(target=end).start()
try:
    while "woken" not in order and rclpy.ok():
        executor.spin_once(5.0)
except BaseException as error:
    order.append(type(error).__name__)
until = time.monotonic() + 30.0
while not {own} and rclpy.ok() and time.monotonic() < until:
    time.sleep(0.01)  # a thread of rclpy's shuts the context down
print(*order, rclpy.ok())
"""


@pytest.mark.parametrize(("own", "order"), [(True, "woken handled True"), (False, r"\w+ False")])
def test_run_a_signal_is_seen_too_late_or_ends_the_context(bench: Bench, own: bool, order: str) -> None:
    """With a handler of Python the executor sleeps on; with rclpy's the context is gone."""
    command = [sys.executable, "-c", SIGNAL.format(own=own, domain=bench.domain)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert re.fullmatch(order, done.stdout.strip()), (done.stdout, done.stderr)


HELD = """
import ctypes
from calib_planner.ros.rclpy_ext.run import end_after
end_after({seconds})
ctypes.PyDLL(None).sleep({sleep})
raise SystemExit(7)
"""
"""What ``PyDLL`` calls holds the interpreter: no thread of Python could end the process."""


@pytest.mark.skipif(sys.platform != "linux", reason="a timer of Linux")
@pytest.mark.parametrize(("seconds", "sleep", "status"), [(0.5, 600, 0), (600, 0, 7)])
def test_run_a_process_ends_whatever_holds_the_interpreter(seconds: float, sleep: int, status: int) -> None:
    done = subprocess.run([sys.executable, "-c", HELD.format(seconds=seconds, sleep=sleep)], timeout=120)
    assert done.returncode == status


def test_lifecycle_an_impossible_transition_raises(bench: Bench) -> None:
    node, _ = other(bench, LifecycleNode)
    request = ChangeState.Request(transition=Transition(id=99))
    with pytest.raises(Exception, match="not registered"):
        node._service_change_state.callback(request, ChangeState.Response())


def test_lifecycle_the_state_machine_outlives_its_node(bench: Bench) -> None:
    theirs = LifecycleNode("theirs", context=bench.context)
    ours = TidyLifecycleNode("ours", context=bench.context)
    for node in (theirs, ours):
        node.destroy_node()
    with theirs._state_machine:
        pass
    with pytest.raises(InvalidHandle):
        ours._state_machine.__enter__()


def test_lifecycle_no_method_tells_the_state() -> None:
    assert not [n for n in dir(LifecycleNode) if "state" in n and not n.startswith("_")]


def test_lifecycle_what_is_given_and_not_declared_is_dropped(bench: Bench) -> None:
    node, _ = other(bench, parameter_overrides=[Parameter("misspelt", value=1)])
    assert not node.has_parameter("misspelt") and list(given_parameters(node)) == ["misspelt"]
    assert not [n for n in dir(Node) if ("override" in n or "given" in n) and not n.startswith("_")]
