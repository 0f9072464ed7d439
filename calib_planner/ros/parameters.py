# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Node parameters, declared once by a frozen dataclass: type, default, description, unit, range, choices.

Each field is a parameter. It is made with ``parameter`` or, in a class of settings of the library, with
``arrays.ranged``; what the library declares is taken by the transition ``configure``. ``NodeParameters`` declares
the parameters, refuses a name that is unknown and a value of another type or out of range, says why, and holds
the current values as one immutable object. ROS itself drops unknown names given at start without a word.

*Qualities of service.* Every publisher and subscription of the nodes takes parameters like

    qos_overrides./tracker/point.subscription.reliability: best_effort

(full topic name; reliability, durability, history, depth). They are read when the node is configured.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Sequence
from dataclasses import Field, field, fields, replace
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from calib_planner.errors import CalibPlannerError, InputError, UnknownNameError
from calib_planner.ros.rclpy_ext.lifecycle import given_parameters
from calib_planner.units import brief, cut

P = TypeVar("P")

BUILT_IN = ("use_sim_time", "start_type_description_service")
QOS = "qos_overrides."
"""rclpy declares parameters that begin so when the topic is created."""
LONGEST_TEXT, LONGEST_LIST = 4096, 1000
"""Characters of a text and items of a list, at most: a parameter is no place for data."""
TYPES = {
    bool: (Parameter.Type.BOOL, "true or false"),
    int: (Parameter.Type.INTEGER, "a whole number"),
    float: (Parameter.Type.DOUBLE, "a number with a decimal point"),
    str: (Parameter.Type.STRING, "a text"),
    tuple: (Parameter.Type.STRING_ARRAY, "a list of texts"),
}


def parameter(
    default: Any,
    description: str,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    *,
    choices: Sequence[str] = (),
    read_only: bool = False,
    at_configure: bool = False,
) -> Any:
    """A dataclass field that is a node parameter.

    Args:
        default: Its type is the parameter's: bool, int, float, str, or a tuple of str.
        description: For people, without unit and range.
        unit: SI unit.
        low, high: Smallest and largest value; both or neither.
        choices: The only values of a text.
        read_only: Whether it never changes after start.
        at_configure: Whether the transition ``configure`` takes it, so that it cannot change while in use.
    """
    metadata = {"description": description, "unit": unit, "low": low, "high": high, "choices": tuple(choices)}
    return field(default=default, metadata=metadata | {"read_only": read_only, "at_configure": at_configure})


at_configure = functools.partial(parameter, at_configure=True)
"""As ``parameter``; taken by the transition ``configure``."""


def constraints_text(item: Field[Any]) -> str:
    """What a field allows besides its type, in words; empty if anything."""
    data, words = item.metadata, []
    if data["low"] is not None:
        words.append(f"{data['low']:g} to {data['high']:.15g}")
    if data.get("choices"):
        words.append("one of: " + ", ".join(filter(None, data["choices"])))
    if data.get("read_only"):
        words.append("fixed after start")
    if taken_at_configure(item):
        words.append("taken at configure")
    return "; ".join(words)


def described(item: Field[Any]) -> str:
    """Description and unit."""
    return item.metadata["description"] + (f" [{item.metadata['unit']}]" if item.metadata["unit"] else "")


def taken_at_configure(item: Field[Any]) -> bool:
    """Whether the transition ``configure`` takes it; so does it with every setting of the library."""
    return bool(item.metadata.get("at_configure", True))


def descriptor(item: Field[Any]) -> ParameterDescriptor:
    """The ROS descriptor of a field."""
    result = ParameterDescriptor(
        name=item.name,
        description=described(item),
        additional_constraints=constraints_text(item),
        read_only=item.metadata.get("read_only", False),
    )
    low, high = item.metadata["low"], item.metadata["high"]
    if low is not None and isinstance(item.default, float):
        result.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)]
    elif low is not None:
        result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
    return result


def check_value(item: Field[Any], given: Parameter) -> None:
    """Refuse a value that the parameter ``item`` cannot take.

    Raises:
        InputError: Another type, out of range, not finite, too long or no valid choice.
    """
    kind, words = TYPES[type(item.default)]
    data, value = item.metadata, given.value
    if given.type_ != kind:
        advice = f"write {value}.0" if type(value) is int and kind == Parameter.Type.DOUBLE else ""
        raise InputError(item.name, f"{brief(value)} ({given.type_.name.lower()})", words, advice)
    low, high = data["low"], data["high"]
    if low is not None and not low <= value <= high:
        unit = f" {data['unit']}" if data["unit"] else ""
        raise InputError(item.name, value, f"{low:g} to {high:.15g}{unit}")
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(item.name, value, "a finite number")
    texts = value if kind == Parameter.Type.STRING_ARRAY else [value] if isinstance(value, str) else []
    if len(texts) > LONGEST_LIST:
        raise InputError(item.name, f"{len(texts)} items", f"at most {LONGEST_LIST}")
    if any(len(text) > LONGEST_TEXT for text in texts):
        raise InputError(item.name, f"{max(map(len, texts))} characters", f"at most {LONGEST_TEXT}")
    if data.get("choices") and value not in data["choices"]:
        raise UnknownNameError(item.name, cut(value, 100), data["choices"])


class NodeParameters(Generic[P]):
    """Declares the fields of ``defaults`` on ``node`` and follows changes.

    Attributes:
        value: The current values, an instance of the dataclass.
        in_use: Whether the node is configured: then what is taken at configure cannot be changed.

    Raises:
        UnknownNameError: A name given at start (file, command line, launch) is unknown.
        InputError: A value given at start is of another type or out of range, or values do not fit together.
    """

    def __init__(self, node: Node, defaults: P) -> None:
        self._items: dict[str, Field[Any]] = {f.name: f for f in fields(defaults)}  # type: ignore[arg-type]
        self.in_use = False
        for name, given in given_parameters(node).items():
            if name in self._items:
                check_value(self._items[name], given)
            elif not (name.startswith(QOS) or name in BUILT_IN or node.has_parameter(name)):
                raise UnknownNameError("parameter", cut(name, 100), sorted([*self._items, "use_sim_time"]))
        values = {
            name: node.declare_parameter(name, getattr(defaults, name), descriptor(item)).value
            for name, item in self._items.items()
        }
        self.value: P = replace(defaults, **_plain(values))  # type: ignore[type-var]
        node.add_on_set_parameters_callback(self._refuse)
        node.add_post_set_parameters_callback(self._follow)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self._items)

    def _refuse(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            for change in changes:
                if change.name in self._items:
                    self._check_change(self._items[change.name], change)
            replace(self.value, **self._own(changes))  # type: ignore[type-var]
        except CalibPlannerError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _check_change(self, item: Field[Any], change: Parameter) -> None:
        check_value(item, change)
        before, after = getattr(self.value, item.name), self._own([change])[item.name]
        if self.in_use and taken_at_configure(item) and before != after:
            advice = "first the transitions deactivate and cleanup, then configure and activate"
            raise InputError(item.name, brief(change.value), "no change while the node is configured", advice)

    def _follow(self, changes: list[Parameter]) -> None:
        self.value = replace(self.value, **self._own(changes))  # type: ignore[type-var]

    def _own(self, changes: list[Parameter]) -> dict[str, Any]:
        return _plain({c.name: c.value for c in changes if c.name in self._items})


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Sequences from ROS as tuples."""
    scalar = (str, int, float, bool)
    return {k: v if isinstance(v, scalar) else tuple(v) for k, v in values.items()}


# ── qualities of service ─────────────────────────────────────────────────────────────────────────────

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Results: a subscriber that comes late gets the newest."""

EVENTS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""Measurements, of which none may be lost."""

HISTORY = QoSProfile(
    depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""Measurements as their publisher keeps them: who comes late and asks for it gets the newest thousand."""

SENSOR_OUT = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)
"""Streams that the nodes publish."""

STREAM_IN = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Streams that the nodes subscribe to: best effort matches every publisher, reliable or not, and the queue holds
five seconds at 1 kHz."""

NEWEST_IN = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Streams of which only the newest message counts."""

REQUESTS = QoSProfile(depth=100)
"""Requests: rclpy's depth of 10 loses some of a burst, whose clients then wait for ever."""

DEEPEST = 100_000
"""Largest depth of a queue in an override."""

POLICIES = (QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY, QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH)


def overridable(entity_id: str | None = None) -> QoSOverridingOptions:
    """The option that makes a publisher or subscription take overrides.

    Args:
        entity_id: Tells two publishers or subscriptions of one topic in one node apart.
    """
    return QoSOverridingOptions(POLICIES, callback=_check_depth, entity_id=entity_id)


def own(qos: QoSProfile | int) -> QoSProfile:
    """A copy, since rclpy writes overrides into the profile that it gets."""
    return QoSProfile(depth=qos) if isinstance(qos, int) else copy.copy(qos)


def _check_depth(profile: QoSProfile) -> SetParametersResult:
    if not 1 <= profile.depth <= DEEPEST:
        return SetParametersResult(successful=False, reason=f"depth {profile.depth}, valid is 1 to {DEEPEST}")
    return SetParametersResult(successful=True)
