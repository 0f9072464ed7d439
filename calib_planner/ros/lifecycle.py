# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The base of the nodes: a lifecycle node that starts by itself, or says why not, and survives exceptions.

A node implements four hooks: ``configure`` makes everything that the node needs from its parameters, ``activate``
begins its work, ``deactivate`` ends what is under way, ``clean_up`` forgets. If a hook raises, the transition
fails and the reason is logged; the node stays and can be configured again. What is made in ``configure`` or
``activate`` (publishers, subscriptions, services, timers, action servers) is destroyed on the way back, also from
half the way, and takes QoS overrides (see ``qos``); ``undo_with`` adds other things to that list.

With the parameter ``autostart`` (the default) the node goes to *active* as soon as it spins, so that it can be
run without a lifecycle manager; with ``autostart: false`` a manager drives it by ``~/change_state``.

Once in ``diagnostics_period`` a node says on ``/diagnostics`` whether it is active, or why not and what to do,
and what it adds by ``findings``.

An exception in a callback would end the process, whoever sent the message: here it is logged, and a service
answers that it failed.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from calib_planner.acquisition import NANO
from calib_planner.errors import CalibPlannerError, InputError, UnknownNameError
from calib_planner.ros.parameters import EVENTS, QOS, REQUESTS, NodeParameters, overridable, own, parameter
from calib_planner.ros.rclpy_ext.lasting import LastingActionServer, lasting
from calib_planner.ros.rclpy_ext.lifecycle import TidyLifecycleNode, given_parameters
from calib_planner.units import cut

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)


@dataclass(frozen=True)
class Finding:
    """What a part of a node has to say on ``/diagnostics``.

    Attributes:
        part: Name of the part.
        level: ``OK``, ``WARN``, ``ERROR`` or ``STALE``.
        message: What is the case, and what to do.
        values: Further values by name, with units.
    """

    part: str
    level: bytes
    message: str
    values: Mapping[str, object] = field(default_factory=dict)

    def status(self, node: str, robot: str) -> DiagnosticStatus:
        """The message, of a node that works for a robot."""
        pairs = [KeyValue(key=key, value=str(value)) for key, value in self.values.items()]
        message = cut(self.message)
        return DiagnosticStatus(
            name=f"{node}: {self.part}", hardware_id=robot, level=self.level, message=message, values=pairs
        )


JUMP = 3600.0
"""Simulated time goes on by less between two looks; more is another bag, or the clock's first message [s]."""
LOOK = 0.01
"""Real time between two looks at a simulated clock [s]."""


OWN = "calib_planner_msgs"
"""Package of the messages that are this project's own."""


@dataclass(frozen=True)
class LifecycleParameters:
    """The parameters that every node has; those of a node inherit from it."""

    autostart: bool = parameter(True, "go to active without a lifecycle manager", read_only=True)
    diagnostics_period: float = parameter(
        1.0, "time between two messages on /diagnostics", "s", 0.05, 3600.0, read_only=True
    )


class Stopwatch:
    """Seconds that have passed since it was made, as far as anybody has looked.

    Simulated time may jump, back when a bag begins again; what it jumps by has not passed.
    """

    def __init__(self) -> None:
        self._turn, self._before, self._passed = threading.Lock(), (False, 0.0), 0.0

    def at(self, now: float, simulated: bool) -> float:
        """Seconds passed [s] at ``now`` [s], by a simulated clock or by a real one that never jumps."""
        with self._turn:
            before, self._before = self._before, (simulated, now)
            step = now - before[1] if before[0] == simulated else 0.0
            if not simulated or 0.0 <= step < JUMP:
                self._passed += step
            return self._passed


P = TypeVar("P", bound=LifecycleParameters)


class ManagedNode(TidyLifecycleNode, Generic[P]):
    """A node with hooks.

    Args:
        name: Name of the node.
        defaults: Its parameters.
        context: ROS context; by default the global one.
        overrides: Parameter values that win over those of files and the command line.

    Attributes:
        settings: The parameters; ``settings.value`` is the current dataclass.
        failure: Why the last transition failed; empty if it did not.
        newest: What the newest piece of work came to.
        diagnostics: Publisher of ``/diagnostics``.
        autostarted: Whether the node has tried to start by itself, with or without success.

    Raises:
        InputError: A parameter given at start is unknown or has an unusable value.
    """

    THREADS = 1

    def __init__(
        self, name: str, defaults: P, context: Context | None = None, overrides: Sequence[Parameter] = ()
    ) -> None:
        self._made: list[ExitStack] = []  # before rclpy makes its own services, by our methods
        self._stopwatch = Stopwatch()
        self.failure, self.autostarted, self._ending = "", False, False
        super().__init__(name, context=context, parameter_overrides=list(overrides))
        self.guard_change_state(self._safe_service)
        try:
            self.settings: NodeParameters[P] = NodeParameters(self, defaults)
        except Exception:
            self.destroy_node()
            raise
        self._fault, self.newest = "", tuple[Finding, ...]()
        self.diagnostics = super().create_publisher(
            DiagnosticArray, "/diagnostics", own(EVENTS), qos_overriding_options=overridable()
        )
        self.create_steady_timer(self.settings.value.diagnostics_period, self.publish_findings)
        self._first: Timer | None = None
        if self.settings.value.autostart:
            self._first = self.create_steady_timer(0.0, self._autostart)

    # ── what a node says about itself ────────────────────────────────────────────────────────────────

    def configure(self) -> None:
        """Make everything from ``self.settings.value``; an exception refuses the transition."""

    def activate(self) -> None:
        """Begin; an exception refuses the transition."""

    def deactivate(self) -> None:
        """End what is under way."""

    def clean_up(self) -> None:
        """Forget what ``configure`` made, besides publishers, services and so on."""

    def findings(self) -> Sequence[Finding]:
        """What the node has to say on ``/diagnostics`` while it is configured, besides its state."""
        return self.newest

    def outcome(self, part: str, level: bytes, text: str) -> None:
        """Keep what the newest piece of work came to, for ``/diagnostics``."""
        seconds = f"{self.now / NANO:.1f}"
        self.newest = (Finding(part, level, text, {"ended at [s]": seconds}),)

    @property
    def robot_name(self) -> str:
        """The robot that the configured node works for; empty while there is none."""
        return ""

    def undo_with(self, callback: Callable[..., Any], *args: Any) -> None:
        """In ``configure`` or ``activate``: call ``callback(*args)`` on the way back, the last one first."""
        self._made[-1].callback(callback, *args)

    @contextmanager
    def as_configured(self) -> Iterator[None]:
        """What is made in this context stays until ``clean_up``, as if ``configure`` had made it."""
        later, self._made = self._made[1:], self._made[:1]
        try:
            yield
        finally:
            self._made += later

    @property
    def is_active(self) -> bool:
        """Whether the state is *active*."""
        return self.state == "active"

    def check_active(self) -> None:
        """Refuse if the node is not active.

        Raises:
            InputError: It is not.
        """
        if not self.is_active:
            raise InputError("node", self.state, "active", "activate it")

    @property
    def now(self) -> int:
        """The node's time [ns]."""
        return int(self.get_clock().now().nanoseconds)

    @property
    def seconds(self) -> float:
        """Time that only goes on [s], to tell how long something lasts and when it has lasted too long.

        With ``use_sim_time`` it is simulated time: what waits for others waits as long as they do.
        """
        simulated = self.get_clock().ros_time_is_active
        return self._stopwatch.at(self.now / NANO if simulated else time.monotonic(), simulated)

    def rest(self, seconds: float, end: threading.Event) -> None:
        """In a thread of its own: wait for ``seconds`` more, as the property of that name counts, or ``end``."""
        until = self.seconds + seconds
        while not end.is_set() and (left := until - self.seconds) > 0.0:
            end.wait(min(left, LOOK) if self.get_clock().ros_time_is_active else left)

    def close(self) -> bool:
        """End everything when the process ends; returns whether nothing is under way any more.

        Publishers and services stay, since a thread may be about to use them; they are destroyed with the node.
        """
        self._ending = True
        self._leave_all()
        return True

    def publish_findings(self) -> None:
        """Say on ``/diagnostics`` how the node is."""
        name, made = self.get_fully_qualified_name().strip("/"), bool(self._made)
        every = [self._own_state(), *(self.findings() if made else ())]
        robot = self.robot_name if made else ""
        message = DiagnosticArray(status=[finding.status(name, robot) for finding in every])
        message.header.stamp = self.get_clock().now().to_msg()
        self.diagnostics.publish(message)

    def _own_state(self) -> Finding:
        """Whether the node is active, or why not and what to do."""
        state, values = self.state, {"state": self.state, "newest fault in a callback": self._fault}
        if state == "active":
            return Finding("node", OK, state, values)
        steps = "activate" if state == "inactive" else "configure, and activate"
        advice = f"ros2 lifecycle set {self.get_fully_qualified_name()} {steps}"
        if self.failure:
            return Finding("node", ERROR, f"{state}: {self.failure}; remedy it, then: {advice}", values)
        return Finding("node", WARN, f"{state}: {advice}", values)

    # ── transitions, called by rclpy ─────────────────────────────────────────────────────────────────

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run ``configure``; from now on what is taken at configure cannot be changed."""
        self.settings.in_use = True
        result = self._enter("configure")
        self.settings.in_use = result == SUCCESS
        if result == SUCCESS:
            self._report_unused_overrides()
        return result

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run ``activate``."""
        return self._enter("activate")

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run ``deactivate``."""
        self._leave("deactivate")
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run whatever is left of ``deactivate`` and ``clean_up``."""
        self._leave_all()
        self.settings.in_use = False
        return SUCCESS

    on_shutdown = on_error = on_cleanup

    def _leave_all(self) -> None:
        while self._made:
            self._leave("deactivate" if len(self._made) == 2 else "clean_up")

    def _enter(self, hook: str) -> TransitionCallbackReturn:
        """Run ``configure`` or ``activate``; undo it if it raises."""
        self.failure = ""
        self._made.append(ExitStack())
        try:
            getattr(self, hook)()
        except Exception as error:
            self.failure = reason_of(error)
            if self.context.ok():  # else the process is ending, which is no fault
                self.get_logger().error(f"cannot {hook}: {self.failure}")
            self._attempt(self._made.pop().close)
            return FAILURE
        return SUCCESS

    def _leave(self, hook: str) -> None:
        """Run ``deactivate`` or ``clean_up``, and destroy what was made, whatever raises."""
        self._attempt(getattr(self, hook))
        self._attempt(self._made.pop().close)

    def _attempt(self, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception as error:
            self._say(error)

    def _autostart(self) -> None:
        if self._first is not None:
            self.destroy_timer(self._first)
            self._first = None
        if self.state == "unconfigured" and self.trigger_configure() == SUCCESS:
            self.trigger_activate()
        if self.failure and self.context.ok():
            name = self.get_fully_qualified_name()
            advice = f"remedy it, then: ros2 lifecycle set {name} configure, and activate"
            self.get_logger().error(f"not started; {advice}")
        self.autostarted = True

    def _report_unused_overrides(self) -> None:
        for name in given_parameters(self):
            if name.startswith(QOS) and not self.has_parameter(name) and "/parameter_events" not in name:
                valid = sorted(n for n in self.get_parameters_by_prefix("") if n.startswith(QOS))
                self.get_logger().warning(f"{UnknownNameError('parameter', cut(name, 200), valid)}")

    # ── what is made in a transition is destroyed on the way back ────────────────────────────────────

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **others: Any) -> Publisher:
        """As rclpy's, with QoS overrides."""
        if not self._made:
            return super().create_publisher(msg_type, topic, qos_profile, **others)
        others.setdefault("qos_overriding_options", overridable())
        made = super().create_publisher(msg_type, topic, own(qos_profile), **others)
        return self._destroyed_later(self.destroy_publisher, made)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: Any, **others: Any
    ) -> Subscription:
        """As rclpy's, with QoS overrides; an exception in the callback is logged.

        Messages of this package are taken as bytes: those of another version, as an old bag plays them, have the
        same name, and rclpy drops them without a word that a callback hears.
        """
        if not self._made:
            return super().create_subscription(msg_type, topic, callback, qos_profile, **others)
        others.setdefault("qos_overriding_options", overridable())
        if msg_type.__module__.startswith(f"{OWN}."):
            callback, others["raw"] = _decoded(msg_type, topic, callback), True
        made = super().create_subscription(msg_type, topic, self._safe(callback), own(qos_profile), **others)
        return self._destroyed_later(self.destroy_subscription, made)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **others: Any
    ) -> Service:
        """As rclpy's; an exception in the callback is logged and answered."""
        others.setdefault("qos_profile", REQUESTS)
        made = super().create_service(srv_type, srv_name, self._safe_service(callback), **others)
        return self._destroyed_later(self.destroy_service, lasting(made) if self._made else made)

    def create_trigger(self, name: str, action: Callable[[], str], **others: Any) -> None:
        """A service Trigger that answers with the text of ``action``, or with why it is refused."""

        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                self.check_active()
                response.message, response.success = action(), True
            except CalibPlannerError as error:
                response.message, response.success = cut(error), False
            return response

        self.create_service(Trigger, name, answer, **others)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], None], *args: Any, **others: Any
    ) -> Timer:
        """As rclpy's; an exception in the callback is logged."""
        made = super().create_timer(timer_period_sec, self._safe(callback), *args, **others)
        return self._destroyed_later(self.destroy_timer, made)

    def create_steady_timer(self, period: float, callback: Callable[[], None]) -> Timer:
        """A timer of real time, with ``period`` [s], to look at what has come; simulated time may stand still.

        How long something may last is told by ``seconds``.
        """
        return self.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def create_client(self, *args: Any, **others: Any) -> Any:
        """As rclpy's."""
        return self._destroyed_later(self.destroy_client, super().create_client(*args, **others))

    def create_action_server(
        self, kind: Any, name: str, execute: Callable[..., Any], **others: Any
    ) -> ActionServer:
        """An action server whose goals may be cancelled; ``execute`` answers its own faults in its own words."""
        usual = {f"{part}_service_qos_profile": REQUESTS for part in ("goal", "cancel", "result")}
        usual |= {"callback_group": ReentrantCallbackGroup(), "cancel_callback": lambda _: CancelResponse.ACCEPT}
        made = LastingActionServer(self, kind, name, execute, **(usual | others))
        return self._destroyed_later(lambda server: server.destroy(), made)

    def create_action_client(self, kind: Any, name: str) -> ActionClient:
        """A client of an action, in the node's own callback group."""
        return self._destroyed_later(lambda client: client.destroy(), ActionClient(self, kind, name))

    def _destroyed_later(self, destroy: Callable[[Any], Any], made: Any) -> Any:
        if self._made:
            self.undo_with(lambda: None if self._ending else destroy(made))
        return made

    # ── callbacks that do not end the process ────────────────────────────────────────────────────────

    def _safe(self, callback: Callable[..., None]) -> Callable[..., None]:
        level = self._level()

        @functools.wraps(callback)
        def safe(*args: Any) -> None:
            try:
                callback(*args)
            except Exception as error:
                self._say_unless_left(error, level)

        return safe

    def _safe_service(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        level = self._level()

        @functools.wraps(callback)
        def safe(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:
                self._say_unless_left(error, level)
                return failed(type(response), reason_of(error))

        return safe

    def _level(self) -> ExitStack | None:
        """What the transition under way makes; ``None`` before the first."""
        return self._made[-1] if self._made else None

    def _say_unless_left(self, error: Exception, level: ExitStack | None) -> None:
        """Say what a callback raised, which was made at a level.

        In a node of several threads one may destroy, on the way back, what another one's callback is using.
        """
        if not (isinstance(error, InvalidHandle) and level is not None and level not in self._made):
            self._say(error)

    def _say(self, error: Exception) -> None:
        self._fault = reason_of(error)
        # Without a context the process is ending, and nothing can be logged.
        if self.context.ok():
            self.get_logger().error(reason_of(error), throttle_duration_sec=1.0)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """As rclpy's, which raises for an unknown name: here it is refused with the closest valid one."""
        for given in parameter_list:
            if not self.has_parameter(given.name):
                error = UnknownNameError("parameter", cut(given.name, 100), self.settings.names)
                return SetParametersResult(successful=False, reason=str(error))
        return super().set_parameters_atomically(parameter_list)


class OneAtATime:
    """Work that takes long, of which one piece is done at a time, in a thread of its own."""

    def __init__(self) -> None:
        self._busy, self.closing = threading.Lock(), threading.Event()

    @contextmanager
    def turn(self) -> Iterator[bool]:
        """Whether nothing else is under way; then this is, until the context is left."""
        mine = self._busy.acquire(blocking=False)
        try:
            yield mine
        finally:
            if mine:
                self._busy.release()

    def end(self, patience: float) -> None:
        """Set ``closing``, at which the work looks, and wait for its end, at most ``patience`` [s]."""
        self.closing.set()
        if self._busy.acquire(timeout=patience):
            self._busy.release()

    @property
    def ended(self) -> bool:
        """Whether nothing is under way."""
        return not self._busy.locked()


def _decoded(kind: Any, topic: str, callback: Callable[..., None]) -> Callable[[bytes], None]:
    """What makes a message of ``kind`` out of bytes, for ``callback``; it refuses those of another version."""

    def decoded(data: bytes) -> None:
        try:
            message = deserialize_message(data, kind)
        except Exception:
            name = f"{OWN}/{kind.__name__}"
            advice = "leave this topic out when a bag from before 1.0 is played; see docs/migration.md"
            raise InputError(topic, f"another version of {name}", f"{name} as it is now", advice) from None
        callback(message)

    return decoded


def failed(kind: Any, reason: str) -> Any:
    """A response of type ``kind`` that says that the service failed."""
    response = kind()
    if hasattr(response, "message"):
        response.message = reason
    if hasattr(kind, "INTERNAL_ERROR"):
        response.status = kind.INTERNAL_ERROR
    if hasattr(response, "results"):
        response.results = [SetParametersResult(successful=False, reason=reason)]
    elif isinstance(getattr(response, "result", None), SetParametersResult):
        response.result = SetParametersResult(successful=False, reason=reason)
    return response


def reason_of(error: Exception) -> str:
    """Why something failed: the text of an error of the library, which explains itself, or kind and text."""
    return cut(str(error) if isinstance(error, CalibPlannerError) else f"{type(error).__name__}: {error}")
