# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The base of the nodes, by a small node of its own: transitions, reasons, overrides, hostile callers."""

from __future__ import annotations

import functools
import gc
from dataclasses import dataclass
from typing import Any

import pytest
from bench import Bench
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import GetAvailableTransitions, GetState
from rcl_interfaces.msg import Log, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

from calib_planner.errors import InputError
from calib_planner.ros.lifecycle import LifecycleParameters, ManagedNode
from calib_planner.ros.nodes.campaign import CampaignNode
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.nodes.planner import PlannerNode
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.parameters import EVENTS, LATCHED, STREAM_IN, parameter


@dataclass(frozen=True)
class SmallParameters(LifecycleParameters):
    """Parameters of the test's node."""

    size: int = parameter(3, "size", low=1, high=9, at_configure=True)
    word: str = parameter("a", "a word", choices=("a", "b"))


class Small(ManagedNode[SmallParameters]):
    """Echoes what it hears; configuring it with size 9 or activating it with word b fails half-way."""

    def __init__(self, **options: Any) -> None:
        self.log: list[str] = []
        super().__init__("small", SmallParameters(), **options)

    def configure(self) -> None:
        self.log.append("configure")
        self.undo_with(self.log.append, "undone")
        self.said = self.create_publisher(String, "~/said", LATCHED)
        self.heard = self.create_subscription(String, "heard", functools.partial(self._echo, "!"), STREAM_IN)
        self.create_service(Trigger, "~/fail", self._fail)
        if self.settings.value.size == 9:
            raise InputError("size", 9, "less than 9 for this test")

    def activate(self) -> None:
        self.log.append("activate")
        if self.settings.value.word == "b":
            raise ZeroDivisionError("made for this test")

    def deactivate(self) -> None:
        self.log.append("deactivate")

    def clean_up(self) -> None:
        self.log.append("clean_up")

    def _echo(self, mark: str, message: String) -> None:
        if message.data == "fail":
            raise ZeroDivisionError("made for this test")
        self.said.publish(String(data=message.data + mark))

    def _fail(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        raise ZeroDivisionError("made for this test")


def change(bench: Bench, which: int, label: str = "") -> bool:
    return bench.change_state("small", which, label)


def endpoints(node: Small) -> int:
    names = [n for n, _ in node.get_publisher_names_and_types_by_node("small", "/")]
    names += [n for n, _ in node.get_subscriber_names_and_types_by_node("small", "/")]
    names += [n for n, _ in node.get_service_names_and_types_by_node("small", "/")]
    return len({"/small/said", "/heard", "/small/fail"} & set(names))


def test_it_starts_by_itself(bench: Bench) -> None:
    node = bench.start(Small)
    assert node.state == "active" and node.log == ["configure", "activate"]
    assert (
        bench.call(GetState, "small/get_state", GetState.Request()).current_state.id == State.PRIMARY_STATE_ACTIVE
    )


def test_a_manager_drives_it(bench: Bench) -> None:
    node = bench.start(Small, autostart=False)
    assert bench.call(GetState, "small/get_state", GetState.Request()).current_state.label == "unconfigured"
    assert node.log == [] and endpoints(node) == 0
    assert change(bench, Transition.TRANSITION_CONFIGURE) and node.state == "inactive"
    bench.wait(lambda: endpoints(node) == 3)
    assert change(bench, 0, "activate") and node.state == "active"
    name = "small/get_available_transitions"
    found = bench.call(GetAvailableTransitions, name, GetAvailableTransitions.Request())
    assert {t.transition.label for t in found.available_transitions} == {"deactivate", "shutdown"}
    assert change(bench, Transition.TRANSITION_DEACTIVATE) and node.state == "inactive"
    assert change(bench, Transition.TRANSITION_CLEANUP) and node.state == "unconfigured"
    bench.wait(lambda: endpoints(node) == 0)
    assert node.log == ["configure", "activate", "deactivate", "clean_up", "undone"]
    assert change(bench, Transition.TRANSITION_CONFIGURE) and change(bench, Transition.TRANSITION_ACTIVATE)
    assert change(bench, Transition.TRANSITION_ACTIVE_SHUTDOWN) and node.state == "finalized"
    assert node.log[5:] == ["configure", "activate", "deactivate", "clean_up", "undone"]


@pytest.mark.parametrize("which", [0, 3, 10, 97, 99, 255, Transition.TRANSITION_CONFIGURE])
def test_an_impossible_transition_is_answered(bench: Bench, which: int) -> None:
    node = bench.start(Small)
    assert not change(bench, which) and not change(bench, which, "no such" * 1000)
    assert node.state == "active"
    assert change(bench, Transition.TRANSITION_DEACTIVATE)


def test_what_cannot_be_configured_says_why_and_stays(bench: Bench) -> None:
    node = bench.start(Small, size=9)
    assert node.state == "unconfigured" and "less than 9 for this test" in node.failure
    assert node.log == ["configure", "undone"]
    bench.wait(lambda: endpoints(node) == 0)
    assert not change(bench, Transition.TRANSITION_CONFIGURE)
    assert set_one(bench, "size", ParameterValue(type=2, integer_value=4)) == ""
    assert change(bench, Transition.TRANSITION_CONFIGURE) and change(bench, Transition.TRANSITION_ACTIVATE)
    assert node.state == "active" and node.failure == ""


def test_what_cannot_be_activated_stays_inactive(bench: Bench) -> None:
    node = bench.start(Small, word="b")
    assert node.state == "inactive" and "ZeroDivisionError: made for this test" in node.failure
    assert set_one(bench, "word", ParameterValue(type=4, string_value="a")) == ""
    assert change(bench, Transition.TRANSITION_ACTIVATE)


def test_an_exception_in_a_callback_is_survived(bench: Bench) -> None:
    node = bench.start(Small)
    heard = bench.hear(String, "small/said", LATCHED)
    publisher = bench.client.create_publisher(String, "heard", 10)
    bench.wait(lambda: publisher.get_subscription_count() and node.said.get_subscription_count())
    publisher.publish(String(data="fail"))
    publisher.publish(String(data="still there"))
    bench.wait(lambda: heard)
    assert heard[0].data == "still there!"
    answer = bench.call(Trigger, "small/fail", Trigger.Request())
    assert not answer.success and "made for this test" in answer.message


def test_a_callback_may_be_at_work_while_what_it_uses_is_destroyed_on_the_way_back(bench: Bench) -> None:
    node = bench.start(Small)
    begun = node.heard.callback
    node.trigger_deactivate()
    node.trigger_cleanup()
    begun(String(data="late"))
    assert not bench.unforeseen
    node.trigger_configure()
    node.said.destroy()
    node.heard.callback(String(data="destroyed by somebody else"))
    assert [type(error).__name__ for error in bench.unforeseen] == ["InvalidHandle"]
    bench.unforeseen.clear()


def set_one(bench: Bench, name: str, value: ParameterValue) -> str:
    """The reason why it was refused; empty if it was not."""
    request = SetParameters.Request(parameters=[ParameterMessage(name=name, value=value)])
    (result,) = bench.call(SetParameters, "small/set_parameters", request).results
    assert result.successful == (not result.reason)
    return str(result.reason)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("siz", ParameterValue(type=2, integer_value=3), "did you mean 'size'"),
        ("x" * 10_000, ParameterValue(type=2), "valid names"),
        ("size", ParameterValue(type=2, integer_value=10), "range"),
        ("size", ParameterValue(type=3, double_value=3.0), "type"),
        ("size", ParameterValue(type=0), "cannot be undeclared"),
        ("size", ParameterValue(type=2, integer_value=4), "deactivate and cleanup"),
        ("word", ParameterValue(type=4, string_value="z" * 100_000), "at most"),
        ("word", ParameterValue(type=4, string_value="z"), "one of: a, b"),
        ("autostart", ParameterValue(type=1), "read-only"),
    ],
)
def test_a_parameter_from_the_wire_is_refused_with_the_reason(
    bench: Bench, name: str, value: ParameterValue, reason: str
) -> None:
    node = bench.start(Small)
    assert reason in set_one(bench, name, value)
    assert node.settings.value == SmallParameters()


@pytest.mark.parametrize("kind", [11, 255])
@pytest.mark.parametrize("service", [SetParameters, SetParametersAtomically])
def test_a_parameter_of_no_type_is_survived(bench: Bench, kind: int, service: Any) -> None:
    bench.start(Small)
    request = service.Request(parameters=[ParameterMessage(name="size", value=ParameterValue(type=kind))])
    name = "set_parameters" if service is SetParameters else "set_parameters_atomically"
    answer = bench.call(service, f"small/{name}", request)
    (result,) = answer.results if service is SetParameters else [answer.result]
    assert not result.successful and result.reason
    values = bench.call(GetParameters, "small/get_parameters", GetParameters.Request(names=["size"])).values
    assert values[0].integer_value == 3


def test_qos_is_overridden(bench: Bench) -> None:
    given = {
        "qos_overrides./small/said.publisher.durability": "volatile",
        "qos_overrides./small/said.publisher.depth": 7,
        "qos_overrides./heard.subscription.reliability": "reliable",
    }
    node = bench.start(Small, **given)
    assert node.said.qos_profile.durability == DurabilityPolicy.VOLATILE and node.said.qos_profile.depth == 7
    assert node.heard.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert LATCHED.durability == DurabilityPolicy.TRANSIENT_LOCAL and LATCHED.depth == 1
    assert STREAM_IN.reliability == ReliabilityPolicy.BEST_EFFORT


@pytest.mark.parametrize(
    ("policy", "value"), [("depth", 0), ("depth", 10**12), ("depth", "deep"), ("reliability", "perhaps")]
)
def test_a_bad_override_is_no_crash(bench: Bench, policy: str, value: Any) -> None:
    node = bench.start(Small, **{f"qos_overrides./small/said.publisher.{policy}": value})
    assert node.state == "unconfigured" and (policy in node.failure or str(value) in node.failure)


def test_a_destroyed_node_can_be_asked_for_its_state() -> None:
    with Bench() as bench:
        node = bench.start(Small)
        assert node.is_active
    assert node.state == "finalized" and not node.is_active


def test_closing_ends_everything_once(bench: Bench) -> None:
    node = bench.start(Small)
    assert node.close() and node.close()
    assert node.log == ["configure", "activate", "deactivate", "clean_up", "undone"]


@pytest.mark.parametrize("kind", [Small, PlannerNode, IdentifierNode, SimulatorNode, CampaignNode])
def test_a_node_that_is_gone_does_not_silence_another_one_of_its_name(kind: type[ManagedNode[Any]]) -> None:
    """What keeps a destroyed node alive is destroyed with it, not by the garbage collector later on."""
    before = Bench()
    with before:
        before.start(kind)
    with Bench() as bench:
        node, logs = bench.start(kind), bench.hear(Log, "/rosout", EVENTS)
        del before
        gc.collect()

        def heard() -> bool:
            node.get_logger().warning("hello")  # until the reader is matched
            return any((line.name, line.msg) == (node.get_name(), "hello") for line in logs)

        bench.wait(heard)
