"""Node parameters, declared once from a frozen dataclass: type, default, description, unit, range, choices.

A field is a parameter; ``parameter(...)`` gives it its descriptor. ``NodeParameters`` declares them, refuses
with the reason what is unknown, of another type or out of range, and holds the current values as one
immutable object. ROS itself drops unknown names in silence: a misspelt one would leave its default in place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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

from calib_planner.errors import CalibPlannerError, InputError, UnknownNameError
from calib_planner.ros.rclpy_ext.lifecycle import given_parameters
from calib_planner.units import brief, cut

P = TypeVar("P")

BUILT_IN = ("use_sim_time", "start_type_description_service")
QOS = "qos_overrides."
"""What starts so is declared by rclpy when the topic is created; see ``qos``."""
LONGEST_TEXT, LONGEST_LIST = 4096, 1000
"""A parameter is no place for data: characters of a text and items of a list, at most."""
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
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] = (),
    read_only: bool = False,
    at_configure: bool = False,
) -> Any:
    """A dataclass field that is a node parameter.

    Args:
        default: Its type is the parameter's: bool, int, float, str, or a tuple of str.
        description: For people, without unit and range.
        unit: SI.
        low, high: Smallest and largest value; both or neither.
        choices: The only values of a text.
        read_only: Never changes after start.
        at_configure: Is taken by the transition ``configure`` and cannot be changed while it is in use.
    """
    metadata = {
        "description": description,
        "unit": unit,
        "low": low,
        "high": high,
        "choices": tuple(choices),
        "read_only": read_only,
        "at_configure": at_configure,
    }
    return field(default=default, metadata=metadata)


def constraints_text(item: Field[Any]) -> str:
    """What a field allows besides its type, in words; empty if anything."""
    data, words = item.metadata, []
    if data["low"] is not None:
        words.append(f"{data['low']:g} to {data['high']:.15g}")
    if data["choices"]:
        words.append("one of: " + ", ".join(data["choices"]))
    if data["read_only"]:
        words.append("fixed after start")
    if data["at_configure"]:
        words.append("taken at configure")
    return "; ".join(words)


def descriptor(item: Field[Any]) -> ParameterDescriptor:
    """The ROS descriptor of a dataclass field made with ``parameter``."""
    data = item.metadata
    unit = f" [{data['unit']}]" if data["unit"] else ""
    result = ParameterDescriptor(
        name=item.name,
        description=data["description"] + unit,
        additional_constraints=constraints_text(item),
        read_only=data["read_only"],
    )
    low, high = data["low"], data["high"]
    if low is not None:
        if isinstance(item.default, float):
            span = FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
            result.floating_point_range = [span]
        else:
            span = IntegerRange(from_value=int(low), to_value=int(high), step=0)
            result.integer_range = [span]
    return result


def check_value(item: Field[Any], given: Parameter) -> None:
    """Refuse a value that the field ``item`` cannot take.

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
    if data["choices"] and value not in data["choices"]:
        raise UnknownNameError(item.name, cut(value, 100), data["choices"])


def check_names(given: Mapping[str, Parameter], valid: Sequence[str], declared: Sequence[str]) -> None:
    """Refuse overrides with names that no parameter has; what ROS declares by itself is allowed.

    Raises:
        UnknownNameError: The first such name, with the closest valid one.
    """
    known = {*valid, *declared, *BUILT_IN}
    for name in given:
        if name not in known and not name.startswith(QOS):
            raise UnknownNameError("parameter", cut(name, 100), sorted([*valid, "use_sim_time"]))


class NodeParameters(Generic[P]):
    """Declares the fields of ``defaults`` on ``node`` and follows changes.

    Attributes:
        value: The current values, an instance of the dataclass.
        in_use: Whether the node is configured: then what is taken at configure cannot be changed.

    Raises:
        InputError: A name given at start (file, command line, launch) is unknown, a value of another type or
            out of range, or values do not fit together.
    """

    def __init__(self, node: Node, defaults: P) -> None:
        self._items: dict[str, Field[Any]] = {f.name: f for f in fields(defaults)}  # type: ignore[arg-type]
        self.in_use = False
        given = given_parameters(node)
        check_names(given, list(self._items), list(node.get_parameters_by_prefix("")))
        for name in given.keys() & self._items.keys():
            check_value(self._items[name], given[name])
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
        if item.metadata["at_configure"] and self.in_use and self._own([change])[item.name] != self._now(item):
            advice = "first the transitions deactivate and cleanup, then configure and activate"
            raise InputError(item.name, brief(change.value), "no change while the node is configured", advice)

    def _now(self, item: Field[Any]) -> Any:
        return getattr(self.value, item.name)

    def _follow(self, changes: list[Parameter]) -> None:
        self.value = replace(self.value, **self._own(changes))  # type: ignore[type-var]

    def _own(self, changes: list[Parameter]) -> dict[str, Any]:
        return _plain({c.name: c.value for c in changes if c.name in self._items})


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Sequences from ROS as tuples."""
    scalar = (str, int, float, bool)
    return {k: v if isinstance(v, scalar) else tuple(v) for k, v in values.items()}
